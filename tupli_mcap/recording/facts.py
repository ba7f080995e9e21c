"""What the rows of a step channel say of their episodes, as arrays, a batch of rows at a time."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.chunks import ChunkStore
from tupli_mcap.recording.headers import message_headers

__all__ = ["StepFacts", "step_facts"]

Array = np.ndarray[Any, Any]


class StepFacts(NamedTuple):
    """One entry a row: episode and step number, sum of the reward, flags (bytes as stored), times (ns).

    `bad` maps the rows that are no step of the layout to why.
    """

    episode: Array
    step: Array
    reward: Array
    terminal: Array
    timeout: Array
    time: Array
    bad: dict[int, str]


def step_facts(
    store: ChunkStore, layout: StepLayout, channel: int, first: int, count: int
) -> Iterator[StepFacts]:
    """The facts of rows `first:first + count`, a chunk at a time.

    Raises:
        FormatError: a chunk is damaged, or holds rows of another size.
    """
    for span in store.spans(channel, first, count):
        if layout.constant:
            rows = store.rows(span.chunk, layout.step_message.dtype, keep=False)[span.begin : span.end]
            yield _constant(rows, layout)
        else:
            yield _variable(memoryview(store.load(span.chunk, keep=False)), layout, span.begin, span.end)


def _constant(rows: Array, layout: StepLayout) -> StepFacts:
    total = np.zeros(len(rows))
    with np.errstate(invalid="ignore", over="ignore"):
        for leaf in layout.reward:
            if leaf.size:
                total = total + rows[leaf.name].reshape(len(rows), -1).sum(axis=1, dtype=np.float64)
    flags = rows["terminal"].view(np.uint8), rows["timeout"].view(np.uint8)
    return StepFacts(rows["episode"], rows["step"], total, *flags, rows["#log_time"].astype(np.int64), {})


def _variable(data: memoryview, layout: StepLayout, begin: int, end: int) -> StepFacts:
    headers = message_headers(data)[begin:end]
    n = len(headers)
    numbers = np.zeros((n, 2), np.uint32)
    flags = np.zeros((n, 2), np.uint8)
    total = np.zeros(n)
    bad: dict[int, str] = {}
    decoder = MessageDecoder(layout)
    names = [leaf.name for leaf in layout.reward if leaf.kind != "variable" and leaf.size]
    for i, (start, length) in enumerate(
        zip(headers["#offset"].tolist(), headers["#length"].tolist(), strict=True)
    ):
        body = data[start + BODY : start + 9 + length]
        try:
            values = decoder.step(body)
        except FormatError as err:
            bad[i] = str(err)
            continue
        numbers[i] = values["episode"], values["step"]
        flags[i] = body[-2], body[-1]
        total[i] = float(sum(np.sum(values[name], dtype=np.float64) for name in names))
    time = headers["#log_time"].astype(np.int64)
    return StepFacts(numbers[:, 0], numbers[:, 1], total, flags[:, 0], flags[:, 1], time, bad)
