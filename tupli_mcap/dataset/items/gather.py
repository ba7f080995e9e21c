"""Columns of any rows, out of chunks: kept decoded where all of them fit into memory, else chunk by chunk."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.segments import Piece, Segments
from tupli_mcap.dataset.items.steps import following, pick, pick_runs, rows_of_runs
from tupli_mcap.messages.batches import LOG_TIME, Decode
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.runs import items, items_dtype, put
from tupli_mcap.recording.columns.threads import do_all
from tupli_mcap.recording.limits import check_bools
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["TIME", "Column", "ConstantRows", "DecodedRows", "RowFormat", "Rows"]

TIME = LOG_TIME  # the column of times (uint64, ns)

# Threads that decode small chunks take the interpreter from each other at every one: for so few, one thread is quicker.
_FEW_CHUNKS = 128
_LARGE_CHUNK = 1 << 20  # bytes


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
    """How a file holds the rows: the dtype of a Message record, and the field of each column in it.

    `turned`: the image leaf whose frames lie first in these rows, and last in its values; None for all others.
    """

    store: ChunkStore
    dtype: np.dtype[Any]
    fields: dict[str, str]
    turned: Leaf | None = None

    def values(self, rows: Array, column: str) -> Array:
        """A column of rows of this dtype."""
        found: Array = rows[self.fields.get(column, column)]
        return found if self.turned is None else self.turned.as_values(found)


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

    A row is copied from decoded columns where `hold` says so (they fill as chunks are read), else from the chunks that
    the stores' cache keeps. Safe from several threads: two may read the same chunk, with the same result.
    """

    def __init__(self, segments: Segments, formats: Sequence[RowFormat], columns: dict[str, Column]) -> None:
        self.segments = segments
        self.columns = columns
        self._formats = formats
        self._items = [_items_of(source, columns) for source in formats]
        self._held: _HeldColumns | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_held": None}

    def hold(self, names: Iterable[str]) -> None:
        """Keeps these columns decoded, in `nbytes` of memory as far as they have been read; none: not any more."""
        chosen = set(names)
        if not chosen:
            self._held = None
        elif self._held is None or self._held.columns.keys() != chosen:
            self._held = _HeldColumns(
                self.segments, {name: self.columns[name].empty(self.segments.total) for name in chosen}
            )

    def nbytes(self, names: Iterable[str]) -> int:
        """Bytes of some columns of all rows, decoded."""
        return self.segments.total * sum(self.columns[name].nbytes for name in names)

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        held = self._held
        if held is None or not held.columns.keys() >= set(names):
            return self._read_chunks(names, rows, threads)
        if not held.whole:
            self._fill(held, rows, threads)
        where = following(rows, self.segments.total)
        return {name: pick(held.columns[name], where) for name in names}

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        held = self._held
        if held is None or not held.columns.keys() >= set(names):
            return self._read_chunks(names, rows_of_runs(starts, length), threads)
        if not held.whole:
            self._fill(held, rows_of_runs(starts, length), threads)
        return {name: pick_runs(held.columns[name], starts, length) for name in names}

    def _read_chunks(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        out = {name: self.columns[name].empty(len(rows)) for name in names}
        filled = [name for name in names if out[name].size]
        pieces = self.segments.pieces(rows) if filled else []
        do_all([partial(self._copy, piece, filled, out) for piece in pieces], threads)
        return out

    def _copy(self, piece: Piece, names: Sequence[str], out: dict[str, Any]) -> None:
        source = self._formats[int(self.segments.file_of[piece.unit])]
        chunk = source.store.rows(int(self.segments.chunk_of[piece.unit]), source.dtype)
        for name in names:
            out[name][piece.out] = _shaped(source.values(chunk, name)[piece.rows], out[name])
            check_bools(out[name][piece.out], name, source.store.name)

    def _fill(self, held: _HeldColumns, rows: Array, threads: int) -> None:
        missing = held.missing(rows)
        if len(missing) <= _FEW_CHUNKS and self._stored(missing) < len(missing) * _LARGE_CHUNK:
            threads = 1
        do_all([partial(self._fill_unit, held, unit) for unit in missing], threads)
        if missing:
            held.whole = bool(held.there.all())

    def _stored(self, units: list[int]) -> int:
        """Bytes of the chunks once they are decompressed."""
        places = zip(self.segments.file_of[units], self.segments.chunk_of[units], strict=True)
        return sum(int(self._formats[file].store.table["uncompressed"][chunk]) for file, chunk in places)

    def _fill_unit(self, held: _HeldColumns, unit: int) -> None:
        file, chunk = int(self.segments.file_of[unit]), int(self.segments.chunk_of[unit])
        source, as_items = self._formats[file], self._items[file]
        rows = source.store.rows(chunk, source.dtype if as_items is None else as_items, keep=False)
        held.put(unit, rows, source, as_items=as_items is not None)


class _HeldColumns:
    """Decoded columns of all rows. `there` says which units are in them, `whole` that all are."""

    def __init__(self, segments: Segments, columns: dict[str, Array]) -> None:
        self.columns = columns
        self._items = {name: items(column) for name, column in columns.items() if column.size}
        self.there = np.zeros(len(segments.chunk_of), np.bool_)
        self.whole = not self._items
        self._segments = segments
        self._order = np.argsort(segments.units, kind="stable")  # by unit
        counts = np.bincount(segments.units, minlength=len(self.there))
        self._ends = np.concatenate([[0], np.cumsum(counts)])

    def missing(self, rows: Array) -> list[int]:
        """The units that rows lie in and that are not there."""
        wanted = np.zeros(len(self.there), np.bool_)
        wanted[self._segments.units[self._segments.of(rows)]] = True
        return np.flatnonzero(wanted & ~self.there).tolist()

    def put(self, unit: int, chunk: Array, source: RowFormat, *, as_items: bool) -> None:
        """Copies the rows of a chunk, or these as items, to where they belong."""
        chosen = self._order[self._ends[unit] : self._ends[unit + 1]]
        begins, starts = self._segments.begins[chosen], self._segments.starts[chosen]
        lengths = np.append(self._segments.starts[1:], self._segments.total)[chosen] - starts
        if len(chosen) == 1:
            which: Any = slice(begins[0], begins[0] + lengths[0])
            place: Any = slice(starts[0], starts[0] + lengths[0])
        else:
            within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
            which, place = np.repeat(begins, lengths) + within, np.repeat(starts, lengths) + within
        for name, target in self._items.items():
            values = source.values(chunk, name)[which]
            if as_items:
                target[place] = values
            else:
                self.columns[name][place] = _shaped(values, self.columns[name])
            check_bools(self.columns[name][place], name, source.store.name)
        self.there[unit] = True  # last: another thread may be looking


class DecodedRows:
    """Rows of variable size, decoded message by message each time they are read, so that nobody shares their values.

    Args:
        stores: one a file.
        decoders: one a file; gives columns of the messages whose records begin and end at places of a buffer.
    """

    def __init__(
        self,
        segments: Segments,
        stores: Sequence[ChunkStore],
        decoders: Sequence[Decode],
        columns: dict[str, Column],
    ) -> None:
        self.segments = segments
        self.columns = columns
        self._stores = stores
        self._decoders = decoders

    def read(self, names: Sequence[str], rows: Array, threads: int) -> dict[str, Any]:
        out = {name: self.columns[name].empty(len(rows)) for name in names}
        for piece in self.segments.pieces(rows):
            file, chunk = int(self.segments.file_of[piece.unit]), int(self.segments.chunk_of[piece.unit])
            data, records = self._stores[file].records(chunk)
            for name, values in self._decoders[file](data, records[piece.rows], names).items():
                put(out[name], piece.out, values)
        return out

    def read_runs(self, names: Sequence[str], starts: Array, length: int, threads: int) -> dict[str, Any]:
        return self.read(names, rows_of_runs(starts, length), threads)


def _items_of(source: RowFormat, columns: Mapping[str, Column]) -> np.dtype[Any] | None:
    """The dtype of the rows as items, which are copied faster; None where columns hold the values in another dtype, or
    in another order."""
    if source.turned is not None:
        return None
    fields: Mapping[str, Any] = source.dtype.fields or {}
    own = {source.fields.get(name, name): column.dtype for name, column in columns.items()}
    # there is no field for an array of no elements
    same = all(fields[name][0].base == dtype for name, dtype in own.items() if name in fields)
    return items_dtype(source.dtype) if same else None


def _shaped(values: Array, target: Array) -> Array:
    """One-element dimensions of a structured field may be folded; the target's shape says what is meant."""
    return (
        values if values.shape[1:] == target.shape[1:] else values.reshape((len(values), *target.shape[1:]))
    )
