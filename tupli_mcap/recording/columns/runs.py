"""Finds the chunks that hold runs of a channel's rows, and cuts the runs at the chunks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.recording.columns.chunk_store import ChunkStore

_FEW = 4  # up to this many pieces are copied one by one
Numbers = Array | Sequence[int]


class ChunkPart(NamedTuple):
    """Rows of one chunk: `steps[i]` rows from row `begin[i]` on go to the places from `out[i]` on.

    These are int64 arrays, or lists if they are short. Without `steps`, each is one row. `file` is the number of the
    file among several.
    """

    file: int
    chunk: int
    begin: Numbers
    steps: Numbers | None
    out: Numbers

    def indexes(self) -> tuple[slice | Array, slice | Array]:
        """The rows in the chunk, and their places in the columns."""
        begin, out = np.asarray(self.begin), np.asarray(self.out)
        if self.steps is None:
            return begin, out
        steps = np.asarray(self.steps)
        return _indexes(begin, steps), _indexes(out, steps)

    def copy(self, rows: Array, targets: Sequence[tuple[str, Array]]) -> None:
        """Copies fields of the chunk's rows to columns."""
        if self.steps is not None and len(self.begin) <= _FEW:
            for begin, steps, out in zip(self.begin, self.steps, self.out, strict=True):
                for name, target in targets:
                    target[out : out + steps] = rows[name][begin : begin + steps]
            return
        source, places = self.indexes()
        if isinstance(source, slice) or len(targets) == 1:
            for name, target in targets:
                target[places] = rows[name][source]
            return
        picked = rows.take(source)  # whole rows: one pass over the chunk instead of one for each field
        for name, target in targets:
            target[places] = picked[name]


def _indexes(begin: Array, steps: Array) -> slice | Array:
    """The rows of some pieces, one after the other."""
    if (begin[1:] == begin[:-1] + steps[:-1]).all():
        return slice(int(begin[0]), int(begin[-1] + steps[-1]))
    before = np.cumsum(steps) - steps
    found: Array = np.repeat(begin - before, steps) + np.arange(int(steps.sum()))
    return found


# ---- of one file


class Runs(NamedTuple):
    """Runs of consecutive rows of a channel, which go to the columns one after the other; int64 arrays, or lists."""

    channels: Numbers
    first: Numbers
    steps: Numbers


def runs_of(episodes: Array, channels: Sequence[int]) -> Runs:
    """The runs of episodes (index rows, checked) in their order; runs that follow each other in the file are joined.

    `channels` are those of the sub-environments.
    """
    env, first, lengths = (episodes[name].astype(np.int64) for name in ("env", "first_row", "length"))
    return _joined(np.array(channels, np.int64)[env], first, lengths)


def final_runs(episodes: Array, channel: int) -> Runs:
    """The runs in `/final_state` of the final states of episodes (index rows)."""
    rows = episodes["final_row"].astype(np.int64)
    return _joined(np.full_like(rows, channel), rows, np.ones_like(rows))


def _joined(channels: Array, first: Array, steps: Array) -> Runs:
    if not len(first):
        return Runs(channels, first, steps)
    breaks = (channels[1:] != channels[:-1]) | (first[1:] != first[:-1] + steps[:-1])
    starts = np.concatenate([[0], np.flatnonzero(breaks) + 1])
    return Runs(channels[starts], first[starts], np.add.reduceat(steps, starts))


def parts_of(runs: Runs, store: ChunkStore) -> list[ChunkPart]:
    """The parts of some runs, one for each chunk; raises FormatError if the recording has no such rows."""
    if len(runs.first) <= _FEW:  # a window or an episode: array operations take longer
        return _of_few(runs, store)
    channels, first, steps = map(np.asarray, runs)
    chunks, begin, counts = store.locate(channels, first, steps)
    return by_chunk(np.zeros_like(chunks), chunks, begin, counts, np.cumsum(counts) - counts)


def _of_few(runs: Runs, store: ChunkStore) -> list[ChunkPart]:
    found: dict[int, tuple[list[int], list[int], list[int]]] = {}
    out = 0
    for channel, first, steps in zip(*map(_listed, runs), strict=True):
        for chunk, begin, end in store.spans(channel, first, steps):
            parts = found.setdefault(chunk, ([], [], []))
            for part, value in zip(parts, (begin, end - begin, out), strict=True):
                part.append(value)
            out += end - begin
    return [ChunkPart(0, chunk, *parts) for chunk, parts in found.items()]


def _listed(part: Numbers) -> Sequence[int]:
    return part.tolist() if isinstance(part, np.ndarray) else part


def by_chunk(files: Array, chunks: Array, begin: Array, steps: Array, out: Array) -> list[ChunkPart]:
    """Pieces of chunks of files, as a part for each chunk, in the order of files and chunks."""
    order = np.lexsort((begin, chunks, files))
    files, chunks, begin, steps, out = (each[order] for each in (files, chunks, begin, steps, out))
    firsts = np.flatnonzero((np.diff(chunks, prepend=-1) != 0) | (np.diff(files, prepend=-1) != 0))
    ends = np.append(firsts[1:], len(chunks))
    return [
        ChunkPart(int(files[a]), int(chunks[a]), begin[a:b], steps[a:b], out[a:b])
        for a, b in zip(firsts.tolist(), ends.tolist(), strict=True)
    ]
