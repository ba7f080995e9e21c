"""Finds the chunks that hold any rows of several recordings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.recording.columns.runs import ChunkPart


class Segments(NamedTuple):
    """Rows 0 to n - 1 that lie in chunks of several recordings.

    Segment i holds the rows from `starts[i]` (int64, ascending) up to the next start: they are the rows of unit
    `units[i]` from its row `begins[i]` on. A unit is the chunk `chunk_of` of the file `file_of`.
    """

    total: int
    starts: Array
    units: Array
    begins: Array
    file_of: Array
    chunk_of: Array

    def of(self, rows: Array) -> Array:
        """The segment of each row."""
        found: Array = np.searchsorted(self.starts, rows, side="right") - 1
        return found

    def parts(self, rows: Array) -> list[ChunkPart]:
        """The parts of rows in any order, one for each chunk."""
        if not len(rows):
            return []
        at = self.of(rows)
        places, units = self.begins[at] + (rows - self.starts[at]), self.units[at]
        return [
            ChunkPart(int(self.file_of[unit]), int(self.chunk_of[unit]), places[out], None, out)
            for unit, out in _by_value(units)
        ]


def _by_value(values: Array) -> list[tuple[int, Array]]:
    """The different values, ascending, and the places of each."""
    if (values == values[0]).all():
        return [(int(values[0]), np.arange(len(values)))]
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    cuts = np.flatnonzero(ordered[1:] != ordered[:-1]) + 1
    firsts = ordered[np.concatenate([[0], cuts])].tolist()
    return list(zip(firsts, np.split(order, cuts), strict=True))


class SegmentsBuilder:
    """Collects the segments of one file after the other."""

    def __init__(self) -> None:
        self._total = 0
        self._parts: list[tuple[Array, Array, Array, Array]] = []  # starts, file, chunk, begin

    def add(self, file: int, chunks: Array, begins: Array, steps: Array) -> None:
        """Appends pieces of a file's chunks in their order: `steps[i]` rows of `chunks[i]` from `begins[i]` on."""
        starts = self._total + np.cumsum(steps) - steps
        self._parts.append((starts, np.full(len(chunks), file), chunks, begins))
        self._total += int(steps.sum())

    def build(self) -> Segments:
        parts = [np.concatenate([np.empty(0, np.int64), *part]) for part in zip(*self._parts, strict=True)]
        starts, files, chunks, begins = parts or [np.empty(0, np.int64)] * 4
        # a piece that continues the one before in the same chunk belongs to its segment
        new = (np.diff(files, prepend=-1) != 0) | (np.diff(chunks, prepend=-1) != 0)
        new[1:] |= np.diff(begins) != np.diff(starts)
        starts, files, chunks, begins = (each[new] for each in (starts, files, chunks, begins))
        kinds, units = np.unique(files << 32 | chunks, return_inverse=True)
        return Segments(self._total, starts, units.reshape(-1), begins, kinds >> 32, kinds & 0xFFFFFFFF)
