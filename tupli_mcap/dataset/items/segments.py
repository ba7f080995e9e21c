"""Where rows lie: segments of consecutive rows in one chunk."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array

__all__ = ["Piece", "Segments", "SegmentsBuilder", "by_value"]


class Piece(NamedTuple):
    """Rows of one chunk: `rows` are their places in the chunk, `out` their places in what is asked for."""

    unit: int
    rows: Array
    out: Array


class Segments(NamedTuple):
    """Rows 0 to n - 1 that lie in chunks of several recordings.

    Segment i holds the rows from `starts[i]` (int64, ascending, the next one ends it) on, which are those of chunk
    `units[i]` from `begins[i]` on. A unit is a chunk of a file: `file_of` and `chunk_of` say which.
    """

    total: int
    starts: Array
    units: Array
    begins: Array
    file_of: Array
    chunk_of: Array

    def of(self, rows: Array) -> Array:
        """The segments that rows lie in."""
        found: Array = np.searchsorted(self.starts, rows, side="right") - 1
        return found

    def pieces(self, rows: Array) -> list[Piece]:
        """Rows, in any order, by the chunk they lie in."""
        if not len(rows):
            return []
        at = self.of(rows)
        places = self.begins[at] + (rows - self.starts[at])
        return [Piece(unit, places[out], out) for unit, out in by_value(self.units[at])]


def by_value(values: Array) -> list[tuple[int, Array]]:
    """The different values, ascending, and where each of them is."""
    if not len(values):
        return []
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
        self.total = 0
        self._parts: list[tuple[Array, Array, Array, Array]] = []  # starts, file, chunk, begin

    def add(self, file: int, chunks: Array, begins: Array, steps: Array) -> None:
        """Appends pieces of a file's chunks, each of `steps` rows, in their order."""
        if not len(chunks):
            return
        starts = self.total + np.cumsum(steps) - steps
        self._parts.append((starts, np.full(len(chunks), file), chunks, begins))
        self.total += int(steps.sum())

    def build(self) -> Segments:
        if not self._parts:
            none = np.empty(0, np.int64)
            return Segments(0, none, none, none, none, none)
        starts, files, chunks, begins = (
            np.concatenate(part).astype(np.int64) for part in zip(*self._parts, strict=True)
        )
        joined = _joined(starts, files, chunks, begins)
        starts, files, chunks, begins = starts[joined], files[joined], chunks[joined], begins[joined]
        keys = files << 32 | chunks
        kinds, units = np.unique(keys, return_inverse=True)
        return Segments(self.total, starts, units.reshape(-1), begins, kinds >> 32, kinds & 0xFFFFFFFF)


def _joined(starts: Array, files: Array, chunks: Array, begins: Array) -> Array:
    """Which pieces begin a segment: the others continue the one before, in the same chunk."""
    same = (files[1:] == files[:-1]) & (chunks[1:] == chunks[:-1])
    same &= begins[1:] - begins[:-1] == starts[1:] - starts[:-1]
    return np.concatenate([[0], np.flatnonzero(~same) + 1])
