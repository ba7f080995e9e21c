"""Rows by number, in any order: from decoded columns if all fit into memory, else chunk by chunk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.segments import Segments
from tupli_mcap.dataset.items.steps import pick, pick_runs, rows_of_runs
from tupli_mcap.recording.columns.gather import Column, GatheredRows, do_all
from tupli_mcap.recording.columns.runs import ChunkPart

# Threads that decode small chunks contend for the interpreter lock at each one: for few chunks, one thread is faster.
_FEW_CHUNKS = 128
_LARGE_CHUNK = 1 << 20  # bytes


class NumberedRows:
    """The rows of one kind, by number.

    Columns that `hold` names are kept decoded and fill as chunks are read; other rows are copied from the chunks in
    the stores' cache. Values of variable size are decoded at each read, so that nobody shares them. Thread-safe: two
    threads may read the same chunk, with the same result.
    """

    def __init__(self, rows: GatheredRows, segments: Segments) -> None:
        self._rows, self._segments = rows, segments
        self._held: _HeldColumns | None = None

    @property
    def columns(self) -> Mapping[str, Column]:
        return self._rows.columns

    def hold(self, names: Iterable[str]) -> None:
        """Keeps these columns decoded, and no others, in `nbytes` of memory once all rows have been read."""
        chosen = set(names) if self._rows.constant else set()
        if not chosen:
            self._held = None
        elif self._held is None or self._held.columns.keys() != chosen:
            total = self._segments.total
            self._held = _HeldColumns(
                self._segments, {name: self.columns[name].empty(total) for name in chosen}
            )

    def nbytes(self, names: Iterable[str]) -> int:
        """Bytes of some decoded columns of all rows; 0 if they cannot be kept decoded."""
        return self._segments.total * sum(self.columns[name].nbytes for name in names if self._rows.constant)

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        """Columns of the rows (int64, any order), by name."""
        held = self._held
        if held is None or not held.columns.keys() >= set(names):
            if not self._rows.constant:  # decoding holds the interpreter lock
                threads = 1
            return self._rows.read(names, self._segments.parts(rows), len(rows), threads)
        if not held.whole:
            self._fill(held, rows, threads)
        return {name: pick(held.columns[name], rows) for name in names}

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        """Columns of the rows `start` to `start + length - 1` for each of `starts`, one run after the other."""
        held = self._held
        if held is None or not held.columns.keys() >= set(names):
            return self.read(names, rows_of_runs(starts, length), threads)
        if not held.whole:
            self._fill(held, rows_of_runs(starts, length), threads)
        return {name: pick_runs(held.columns[name], starts, length) for name in names}

    def _fill(self, held: _HeldColumns, rows: Array, threads: int) -> None:
        units = held.missing(rows)
        parts = [held.part(unit) for unit in units]
        if len(parts) <= _FEW_CHUNKS and self._rows.bytes_of(parts) < len(parts) * _LARGE_CHUNK:
            threads = 1
        tasks = self._rows.tasks(held.columns, parts, keep=False)
        self._rows.fetch(parts)

        def fill(unit: int, part: ChunkPart, task: Callable[[], None]) -> None:
            task()
            self._rows.check(held.columns, [part], whole=False)
            held.there[unit] = True  # last, since another thread may read it

        do_all([partial(fill, *each) for each in zip(units, parts, tasks, strict=True)], threads)
        if units:
            held.whole = bool(held.there.all())


class _HeldColumns:
    """Decoded columns of all rows. `there` marks the units that are filled, `whole` says that all are."""

    def __init__(self, segments: Segments, columns: dict[str, Array]) -> None:
        self.columns = columns
        self.there = np.zeros(len(segments.chunk_of), np.bool_)
        self.whole = not any(column.size for column in columns.values())
        self._segments = segments
        self._order = np.argsort(segments.units, kind="stable")  # by unit
        counts = np.bincount(segments.units, minlength=len(self.there))
        self._ends = np.concatenate([[0], np.cumsum(counts)])

    def missing(self, rows: Array) -> list[int]:
        """The units of rows that are not filled."""
        wanted = np.zeros(len(self.there), np.bool_)
        wanted[self._segments.units[self._segments.of(rows)]] = True
        return np.flatnonzero(wanted & ~self.there).tolist()

    def part(self, unit: int) -> ChunkPart:
        """The rows of a unit, and their places."""
        chosen = self._order[self._ends[unit] : self._ends[unit + 1]]
        begins, starts = self._segments.begins[chosen], self._segments.starts[chosen]
        steps = np.append(self._segments.starts[1:], self._segments.total)[chosen] - starts
        return ChunkPart(
            int(self._segments.file_of[unit]), int(self._segments.chunk_of[unit]), begins, steps, starts
        )
