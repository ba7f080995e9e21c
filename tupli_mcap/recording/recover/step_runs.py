"""What the rows of a step channel say of their episodes, as arrays, a batch of rows at a time."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore

__all__ = ["Run", "StepFacts", "runs", "runs_in", "step_facts", "sum_up"]

_TIME, _BEFORE_TIME = struct.Struct("<q"), 15  # of a Message record


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
    store: ChunkStore, layout: StepLayout, channel: int, first: int, count: int, *, keep: bool = False
) -> Iterator[StepFacts]:
    """The facts of rows `first:first + count`, a chunk at a time; chunks are cached with `keep`.

    Raises:
        FormatError: a chunk is damaged, or holds rows of another size, or with times that no index can hold.
    """
    for span in store.spans(channel, first, count):
        if layout.constant:
            rows = store.rows(span.chunk, layout.step_message.dtype, keep=keep)[span.begin : span.end]
            facts = _constant(rows, layout)
        else:
            data, places = store.records(span.chunk, keep=keep)
            facts = _variable(memoryview(data), layout, places[span.begin : span.end])
        if (facts.time < 0).any():
            late = int(facts.time.astype(np.uint64).max())
            raise FormatError(
                f"expected steps with times before 2^63 ns, found {late}: a clock was set wrong"
            )
        yield facts


class Run(NamedTuple):
    """Consecutive rows of one episode, up to a flag: their first one, how many, their rewards, times in ns."""

    row: int
    steps: int
    episode: int
    total: float
    terminal: bool
    timeout: bool
    first_time: int
    last_time: int


def runs(
    store: ChunkStore, layout: StepLayout, channel: int, first: int, count: int, *, keep: bool = False
) -> Iterator[Run]:
    """The runs of the rows `first:first + count`, in their order; chunks are cached with `keep`.

    Raises:
        FormatError: as `step_facts`, or a row is no step of the layout.
    """
    last: Run | None = None
    row = first
    for facts in step_facts(store, layout, channel, first, count, keep=keep):
        if facts.bad:
            raise FormatError(next(iter(facts.bad.values())))
        for run in runs_in(facts, row, last):
            if last is not None and run.row != last.row:
                yield last
            last = run
        row += len(facts.episode)
    if last is not None:
        yield last


def runs_in(facts: StepFacts, row: int, last: Run | None) -> Iterator[Run]:
    """The runs of one batch of rows, which starts at `row`; the first one may go on with the last one before."""
    n = len(facts.episode)
    if not n:
        return
    flagged = (facts.terminal != 0) | (facts.timeout != 0)
    begins = np.flatnonzero((facts.episode[1:] != facts.episode[:-1]) | flagged[:-1]) + 1
    edges = [0, *begins.tolist(), n]
    begin, end = np.array(edges[:-1]), np.array(edges[1:]) - 1
    found = zip(
        itertools.pairwise(edges),
        facts.episode[begin].tolist(),
        (facts.terminal[end] != 0).tolist(),
        (facts.timeout[end] != 0).tolist(),
        facts.time[begin].tolist(),
        facts.time[end].tolist(),
        strict=True,
    )
    for (low, high), episode, terminal, timeout, first_time, last_time in found:
        at, steps, total = row + low, high - low, 0.0
        if low == 0 and last is not None and last.episode == episode and not (last.terminal or last.timeout):
            at, steps, total, first_time = last.row, last.steps + steps, last.total, last.first_time
        total = sum_up(facts.reward[low:high], total)
        yield Run(at, steps, episode, total, terminal, timeout, first_time, last_time)


def sum_up(rewards: Array, total: float = 0.0) -> float:
    """`total` and the rewards, added one after another as a recorder does."""
    with np.errstate(invalid="ignore", over="ignore"):
        return float(np.cumsum(np.concatenate(((total,), rewards)))[-1])


def _constant(rows: Array, layout: StepLayout) -> StepFacts:
    total = np.zeros(len(rows))
    with np.errstate(invalid="ignore", over="ignore"):
        for leaf in layout.reward:
            if leaf.size:
                total = total + rows[leaf.name].reshape(len(rows), -1).sum(axis=1, dtype=np.float64)
    flags = rows["terminal"].view(np.uint8), rows["timeout"].view(np.uint8)
    return StepFacts(rows["episode"], rows["step"], total, *flags, rows["#log_time"].astype(np.int64), {})


def _variable(data: memoryview, layout: StepLayout, places: Array) -> StepFacts:
    """`places`: where the record of each row begins and ends (int64)."""
    n = len(places)
    numbers = np.zeros((n, 2), np.uint32)
    flags = np.zeros((n, 2), np.uint8)
    total = np.zeros(n)
    bad: dict[int, str] = {}
    decoder = MessageDecoder(layout)
    names = [leaf.name for leaf in layout.reward if leaf.kind != "variable" and leaf.size]
    time = np.zeros(n, np.int64)
    for i, (start, end) in enumerate(places.tolist()):
        body = data[start + BODY : end]
        (time[i],) = _TIME.unpack_from(data, start + _BEFORE_TIME)
        try:
            values = decoder.step(body)
        except FormatError as err:
            bad[i] = str(err)
            continue
        numbers[i] = values["episode"], values["step"]
        flags[i] = body[-2], body[-1]
        total[i] = float(sum(np.sum(values[name], dtype=np.float64) for name in names))
    return StepFacts(numbers[:, 0], numbers[:, 1], total, flags[:, 0], flags[:, 1], time, bad)
