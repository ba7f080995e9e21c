"""Columns of any rows, out of chunks: kept decoded where all of them fit into memory, else chunk by chunk."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from tupli_mcap.messages.layout import BODY
from tupli_mcap.recording.chunks import ChunkStore
from tupli_mcap.sampling.segments import Piece, Segments
from tupli_mcap.sampling.steps import pick_runs, rows_of_runs

__all__ = ["TIME", "Column", "ConstantRows", "DecodedRows", "RowFormat", "Rows"]

TIME = "#log_time"  # the column of times (uint64, ns), named as in the records
_TIME_STRUCT, _TIME_OFFSET = struct.Struct("<Q"), 15

Array = np.ndarray[Any, Any]
_FEW_CHUNKS = 4  # fewer are read before a thread pool has started


class Column(NamedTuple):
    """What one row of a column is: an array or a number; a value of variable size where `dtype` is None."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None

    def empty(self, rows: int) -> Any:
        return [None] * rows if self.dtype is None else np.empty((rows, *self.shape), self.dtype)

    @property
    def nbytes(self) -> int:
        """Bytes of one row in memory."""
        return 0 if self.dtype is None else int(np.prod(self.shape, dtype=np.int64)) * self.dtype.itemsize


class RowFormat(NamedTuple):
    """How a file holds the rows: the dtype of a Message record, and the field of each column in it."""

    store: ChunkStore
    dtype: np.dtype[Any]
    fields: dict[str, str]


class Rows(Protocol):
    """Columns that lie in the same rows."""

    columns: dict[str, Column]
    segments: Segments

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        """Columns of the rows (int64, any order), by name."""
        ...

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        """Columns of the rows `start` to `start + length - 1` for each of `starts`, one run after the other."""
        ...


class ConstantRows:
    """Rows of constant size, in chunks of several files.

    A row is copied from the decoded columns once `hold` was called (they fill as chunks are read), else from the
    chunks that the stores' cache keeps. Safe from several threads: two may read the same chunk, with the same result.
    """

    def __init__(self, segments: Segments, formats: Sequence[RowFormat], columns: dict[str, Column]) -> None:
        self.segments = segments
        self.columns = columns
        self._formats = formats
        self._held = False
        self._forget()

    def _forget(self) -> None:
        self._decoded: dict[str, Array] = {}
        self._there: dict[str, Array] = {}  # column -> which units are decoded
        self._whole: set[str] = set()
        self._of_unit: tuple[Array, Array] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_decoded": {}, "_there": {}, "_whole": set(), "_of_unit": None}

    def hold(self, held: bool) -> None:
        """Whether columns are kept decoded: `nbytes` of memory, as far as they have been read."""
        if not held:
            self._forget()
        self._held = held

    def nbytes(self, names: Iterable[str]) -> int:
        """Bytes of some columns of all rows, decoded."""
        return self.segments.total * sum(self.columns[name].nbytes for name in names)

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        if self._held:
            self._decode(names, rows, threads)
            return {name: self._decoded[name].take(rows, axis=0) for name in names}
        return self._read_chunks(names, rows, threads)

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        if not self._held:
            return self._read_chunks(names, rows_of_runs(starts, length), threads)
        if not self._whole.issuperset(names):
            self._decode(names, rows_of_runs(starts, length), threads)
        return {name: pick_runs(self._decoded[name], starts, length) for name in names}

    def _read_chunks(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        out = {name: self.columns[name].empty(len(rows)) for name in names}
        filled = [name for name in names if out[name].size]
        pieces = self.segments.pieces(rows) if filled else []
        run([partial(self._copy, piece, filled, out) for piece in pieces], threads)
        return out

    def _copy(self, piece: Piece, names: Sequence[str], out: dict[str, Any]) -> None:
        chunk, fields = self._open(piece.unit, keep=True)
        for name in names:
            out[name][piece.out] = _shaped(chunk[fields.get(name, name)][piece.rows], out[name])

    def _open(self, unit: int, *, keep: bool) -> tuple[Array, dict[str, str]]:
        source = self._formats[int(self.segments.file_of[unit])]
        chunk = source.store.rows(int(self.segments.chunk_of[unit]), source.dtype, keep=keep)
        return chunk, source.fields

    # ---- decoded columns

    def _decode(self, names: Sequence[str], rows: Array, threads: int) -> None:
        """Sees to it that the columns hold the rows."""
        missing = [name for name in names if name not in self._whole]
        for name in missing:
            self._prepare(name)
        missing = [name for name in missing if name not in self._whole]
        if not missing:
            return
        wanted = np.zeros(len(self.segments.chunk_of), np.bool_)
        wanted[self.segments.units[self.segments.of(rows)]] = True
        lacking = [
            (u, [n for n in missing if not self._there[n][u]]) for u in np.flatnonzero(wanted).tolist()
        ]
        tasks = [partial(self._fill, unit, lacks) for unit, lacks in lacking if lacks]
        run(tasks, threads)
        if tasks:
            self._whole.update(name for name in missing if self._there[name].all())

    def _prepare(self, name: str) -> None:
        if name not in self._decoded:
            self._there[name] = np.zeros(len(self.segments.chunk_of), np.bool_)
            self._decoded[name] = self.columns[name].empty(self.segments.total)
        if not self._decoded[name].size:
            self._whole.add(name)

    def _fill(self, unit: int, names: Sequence[str]) -> None:
        chunk, fields = self._open(unit, keep=False)
        starts, begins, lengths = self._segments_of(unit)
        if len(starts) <= 4:
            for start, begin, steps in zip(starts.tolist(), begins.tolist(), lengths.tolist(), strict=True):
                for name in names:
                    target = self._decoded[name]
                    part = chunk[fields.get(name, name)][begin : begin + steps]
                    target[start : start + steps] = _shaped(part, target)
        else:
            within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
            source, place = np.repeat(begins, lengths) + within, np.repeat(starts, lengths) + within
            for name in names:
                target = self._decoded[name]
                target[place] = _shaped(chunk[fields.get(name, name)][source], target)
        for name in names:
            self._there[name][unit] = True  # last: another thread may be looking

    def _segments_of(self, unit: int) -> tuple[Array, Array, Array]:
        if self._of_unit is None:
            order = np.argsort(self.segments.units, kind="stable")
            counts = np.bincount(self.segments.units, minlength=len(self.segments.chunk_of))
            self._of_unit = order, np.concatenate([[0], np.cumsum(counts)])
        order, ends = self._of_unit
        chosen = order[ends[unit] : ends[unit + 1]]
        starts = self.segments.starts[chosen]
        after = np.append(self.segments.starts[1:], self.segments.total)[chosen]
        return starts, self.segments.begins[chosen], after - starts


class DecodedRows:
    """Rows of variable size, decoded message by message each time they are read, so that nobody shares their values.

    Args:
        stores: one a file.
        decoders: one a file; gives the values in the body of a message, by name of the column.
    """

    def __init__(
        self,
        segments: Segments,
        stores: Sequence[ChunkStore],
        decoders: Sequence[Callable[[memoryview], dict[str, Any]]],
        columns: dict[str, Column],
    ) -> None:
        self.segments = segments
        self.columns = columns
        self._stores = stores
        self._decoders = decoders

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        out = {name: self.columns[name].empty(len(rows)) for name in names}
        for piece in self.segments.pieces(rows):
            self._copy(piece, [name for name in names if name != TIME], out)
        return out

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        return self.read(names, rows_of_runs(starts, length), threads)

    def _copy(self, piece: Piece, names: Sequence[str], out: dict[str, Any]) -> None:
        file, chunk = int(self.segments.file_of[piece.unit]), int(self.segments.chunk_of[piece.unit])
        data, spans = memoryview(self._stores[file].load(chunk)), self._stores[file].messages(chunk)
        decode = self._decoders[file]
        for row, place in zip(piece.rows.tolist(), piece.out.tolist(), strict=True):
            start, end = spans[row]
            if TIME in out:
                (out[TIME][place],) = _TIME_STRUCT.unpack_from(data, start + _TIME_OFFSET)
            values = decode(data[start + BODY : end]) if names else {}
            for name in names:
                if name in values:  # an array of no elements is not in the message
                    out[name][place] = values[name]


def run(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Does all of it, in threads where there is much to do."""
    if threads > 1 and len(tasks) > _FEW_CHUNKS:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda task: task(), tasks))
    else:
        for task in tasks:
            task()


def _shaped(values: Array, target: Array) -> Array:
    """One-element dimensions of a structured field may be folded; the target's shape says what is meant."""
    return (
        values if values.shape[1:] == target.shape[1:] else values.reshape((len(values), *target.shape[1:]))
    )
