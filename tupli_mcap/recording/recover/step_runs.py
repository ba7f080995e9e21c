"""Reads numbers, flags and rewards from the rows of a step channel, and finds runs of consecutive steps in them."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import headers_at
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore, RecordedChannels


class StepFacts(NamedTuple):
    """Arrays with one entry for each row: episode, step, sum of the reward, flags (bytes as stored), time (ns).

    `bad` maps rows that are no step of the layout to the reason.
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
    """The facts of rows `first:first + count`, for one chunk after the other; with `keep`, chunks are cached.
    FormatError if a chunk is damaged, or has rows of another size, or times that the index cannot hold."""
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


class StepRun(NamedTuple):
    """Consecutive rows with consecutive steps of one episode, up to a flag; times in ns.

    `closed` says that the row after it was found and belongs to another episode.
    """

    env: int
    row: int
    steps: int
    episode: int
    step: int
    total: float
    terminal: bool
    timeout: bool
    first_time: int
    last_time: int
    closed: bool

    @property
    def stop(self) -> int:
        """The row after the last one."""
        return self.row + self.steps


Ranges = list[tuple[int, int]]


def intersection(a: Ranges, b: Ranges) -> Ranges:
    """The intersection of two lists of ranges."""
    common: Ranges = []
    i = j = 0
    while i < len(a) and j < len(b):
        low, high = max(a[i][0], b[j][0]), min(a[i][1], b[j][1])
        if low < high:
            common.append((low, high))
        if a[i][1] < b[j][1]:
            i += 1
        else:
            j += 1
    return common


def step_runs(
    evidence: Evidence, store: PackedStore, layout: StepLayout, channels: RecordedChannels
) -> Iterator[StepRun]:
    """The runs of all sub-environments in the order of their rows; a step without all of its images is left out.
    FormatError as `step_facts`; with `evidence.strict`, if a row is no step of the layout."""
    for env, channel in enumerate(channels.steps):
        ranges = evidence.ranges(channel)
        for ids in channels.images.values():
            image = ids[env]
            ranges = intersection(ranges, [] if image is None else evidence.ranges(image))
        for first, stop in ranges:
            last: StepRun | None = None
            row, at = first, store.packed(channel, first)
            # with `keep`, since a chunk may hold many of the ranges
            for facts in step_facts(store, layout, channel, at, stop - first, keep=not evidence.strict):
                if facts.bad and evidence.strict:
                    raise FormatError(next(iter(facts.bad.values())))
                for run in runs_in(facts, env, row, last):
                    if last is not None and run.row != last.row:
                        yield last._replace(closed=last.stop == run.row)
                    last = run
                row += len(facts.episode)
            if last is not None:
                yield last


def runs_in(facts: StepFacts, env: int, row: int, last: StepRun | None) -> Iterator[StepRun]:
    """The runs of one batch of rows, which starts at `row`; the first one may continue `last`, the one before."""
    episode, step = facts.episode.astype(np.int64), facts.step.astype(np.int64)
    flagged = (facts.terminal != 0) | (facts.timeout != 0)
    breaks = (episode[1:] != episode[:-1]) | (step[1:] != step[:-1] + 1) | flagged[:-1]
    edges = {0, len(episode), *(np.flatnonzero(breaks) + 1).tolist()}
    edges |= set(facts.bad) | {i + 1 for i in facts.bad}
    for begin, end in itertools.pairwise(sorted(edges)):
        if begin in facts.bad:
            continue
        run = StepRun(
            env, row + begin, end - begin, int(episode[begin]), int(step[begin]), 0.0,
            bool(facts.terminal[end - 1]), bool(facts.timeout[end - 1]),
            int(facts.time[begin]), int(facts.time[end - 1]), False,
        )  # fmt: skip
        if last is not None and _goes_on(last, run):
            run = run._replace(
                row=last.row, steps=last.steps + run.steps, step=last.step,
                total=last.total, first_time=last.first_time,
            )  # fmt: skip
        yield run._replace(total=sum_up(facts.reward[begin:end], run.total))


def _goes_on(run: StepRun, following: StepRun) -> bool:
    """Whether `following` begins with the next step of `run`."""
    next_one = run.stop, run.episode, run.step + run.steps
    together = next_one == (following.row, following.episode, following.step)
    return together and not (run.terminal or run.timeout)


def sum_up(rewards: Array, total: float) -> float:
    """`total` plus the rewards, added in order, as a recorder adds them."""
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
    time = headers_at(data)["#log_time"][places[:, 0]].astype(np.int64)
    for i, (start, end) in enumerate(places.tolist()):
        body = data[start + BODY : end]
        try:
            values = decoder.step(body)
        except FormatError as err:
            bad[i] = str(err)
            continue
        numbers[i] = values["episode"], values["step"]
        flags[i] = body[-2], body[-1]
        total[i] = float(sum(np.sum(values[name], dtype=np.float64) for name in names))
    return StepFacts(numbers[:, 0], numbers[:, 1], total, flags[:, 0], flags[:, 1], time, bad)
