"""Copies rows of chunks into columns, from one file or many, of one layout or several.

There are three kinds of rows: steps, images of a leaf, final states. A `RowFormat` turns rows of one kind and layout
into columns, a `GatheredRows` reads one kind from all files, and a `Plan` makes the fields of steps from several kinds.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.messages.decoder import LOG_TIME, BatchDecoder, Decode
from tupli_mcap.messages.shared_dtypes import common_dtype, field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.runs import ChunkPart
from tupli_mcap.spaces.leaves import Leaf

EPISODE = "episode"  # the column with the episode's number in rows of final states
_BOOL, _U32, _U64 = np.dtype(np.bool_), np.dtype(np.uint32), np.dtype(np.uint64)
_FEW = 2048  # bytes
_FEW_TASKS = 4  # up to this many tasks take less time than to start a thread
_PLAIN = {"terminals": "terminal", "timeouts": "timeout", "times": LOG_TIME}
_LITTLE = sys.byteorder == "little"  # the byte order of rows
_MANY_ROWS = 1000  # from this many rows on, `_items_dtype` pays


class Column(NamedTuple):
    """The type of one row of a column: an array or a number; a value of variable size if `dtype` is None."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any] | None

    def empty(self, rows: int) -> Any:
        return [None] * rows if self.dtype is None else np.empty((rows, *self.shape), self.dtype)

    @property
    def nbytes(self) -> int:
        """Bytes of one row in memory."""
        return 0 if self.dtype is None else math.prod(self.shape) * self.dtype.itemsize


class RowFormat:
    """Turns rows of one kind into columns, in files of one layout.

    Args:
        columns: the columns, in dtypes for the values of all layouts.
        dtype: of a Message record; None for rows of variable size.
        decode: for rows of variable size, returns columns of the messages whose records are at some places of a buffer.
        fields: the name of a column in these rows, if it differs.
        turned: a stack whose frames come first in these rows and last in its values; None for all others.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        dtype: np.dtype[Any] | None,
        decode: Decode | None,
        fields: Mapping[str, str],
        turned: Leaf | None = None,
    ) -> None:
        self._dtype, self._decode, self._turned = dtype, decode, turned
        self._fields = {name: fields.get(name, name) for name in columns}
        self._items: np.dtype[Any] | None = None
        if dtype is not None and turned is None:
            stored: Mapping[str, Any] = dtype.fields or {}  # there is none for an array of no elements
            same = [
                column.dtype == stored[self._fields[name]][0].base
                for name, column in columns.items()
                if self._fields[name] in stored
            ]
            self._items = _items_dtype(dtype) if all(same) else None

    def reader(self, columns: Mapping[str, Any]) -> Callable[[ChunkStore, ChunkPart, bool], None]:
        """A function that reads a chunk and copies rows of it into columns."""
        if self._decode is not None:
            targets = {self._fields[name]: column for name, column in columns.items()}
            return partial(self._read_decoded, self._decode, targets)
        pairs = [(self._fields[name], column) for name, column in columns.items()]
        if self._items is None or len(pairs[0][1]) < _MANY_ROWS:
            return partial(self._read, self._dtype, pairs)
        return partial(self._read, self._items, [(field, _as_items(column)) for field, column in pairs])

    def _read(
        self, dtype: Any, targets: Sequence[tuple[str, Array]], store: ChunkStore, part: ChunkPart, keep: bool
    ) -> None:
        rows: Any = store.rows(part.chunk, dtype, keep=keep)
        if self._turned is not None:
            rows = {field: self._turned.as_values(rows[field]) for field, _ in targets}
        part.copy(rows, targets)

    def _read_decoded(
        self, decode: Decode, targets: Mapping[str, Any], store: ChunkStore, part: ChunkPart, keep: bool
    ) -> None:
        data, records = store.records(part.chunk, keep=keep)
        rows, places = part.indexes()
        for field, values in decode(data, records[rows], targets).items():
            put(targets[field], places, values)


class Files(NamedTuple):
    """Recordings: the different layouts, the layout of each file, and the chunks of each file."""

    layouts: Sequence[StepLayout]
    layout_of: Sequence[int]
    stores: Sequence[ChunkStore]


class GatheredRows:
    """The rows of one kind in some files, and their columns."""

    def __init__(self, files: Files, columns: Mapping[str, Column], formats: Sequence[RowFormat]) -> None:
        self.columns = columns
        self._bools = [name for name, column in columns.items() if column.dtype == _BOOL]
        self._stores = files.stores
        self._formats = [formats[i] for i in files.layout_of]

    @property
    def constant(self) -> bool:
        """Whether no value is of variable size."""
        return all(column.dtype is not None for column in self.columns.values())

    def tasks(
        self, columns: Mapping[str, Any], parts: Sequence[ChunkPart], keep: bool = True
    ) -> list[Callable[[], None]]:
        """Tasks that fill columns (by name), one for each part. `keep` leaves the chunks in the stores' cache."""
        filled = {name: column for name, column in columns.items() if isinstance(column, list) or column.size}
        if not filled:
            return []
        used = {self._formats[part.file] for part in parts}
        readers = {of_file: of_file.reader(filled) for of_file in used}
        return [
            partial(readers[self._formats[part.file]], self._stores[part.file], part, keep) for part in parts
        ]

    def check(self, columns: Mapping[str, Any], parts: Sequence[ChunkPart], *, whole: bool) -> None:
        """Raises FormatError if bools in parts of columns are neither 0 nor 1 in their files.

        `whole` says that the columns hold these parts and nothing else.
        """
        for name in self._bools:
            if name not in columns or (whole and _are_bools(columns[name])):
                continue
            for part in parts:
                if not _are_bools(columns[name][part.indexes()[1]]):
                    raise FormatError(
                        f"{self._stores[part.file].name}: expected bools of 0 or 1 in {name!r}, found another byte"
                    )

    def fetch(self, parts: Sequence[ChunkPart]) -> None:
        """Announces chunks that will be read next."""
        for file, some in itertools.groupby(parts, lambda part: part.file):
            self._stores[file].fetch(part.chunk for part in some)

    def read(
        self, names: Sequence[str], parts: Sequence[ChunkPart], total: int, threads: int
    ) -> dict[str, Any]:
        """Columns of `total` rows, by name."""
        columns = {name: self.columns[name].empty(total) for name in names}
        self.fetch(parts)
        do_all(self.tasks(columns, parts), threads)
        self.check(columns, parts, whole=True)
        return columns

    def bytes_of(self, parts: Sequence[ChunkPart]) -> int:
        """Bytes of the chunks once they are decompressed."""
        return sum(int(self._stores[part.file].table["uncompressed"][part.chunk]) for part in parts)


# ---- kinds


def step_rows(files: Files) -> GatheredRows:
    """Rows of steps: the leaves that are no images, "terminal", "timeout" and `LOG_TIME`."""
    apart = image_names(files.layouts)
    leaves = [leaf for leaf in files.layouts[0].leaves if leaf.name not in apart]
    plain = {"terminal": Column((), _BOOL), "timeout": Column((), _BOOL), LOG_TIME: Column((), _U64)}
    return _rows(
        files, leaves, plain, lambda layout: layout.step_message.dtype, lambda decoder: decoder.steps
    )


def final_rows(files: Files) -> GatheredRows:
    """Rows of final states: the leaves, and `EPISODE`."""
    leaves, plain = files.layouts[0].state, {EPISODE: Column((), _U32)}
    return _rows(
        files, leaves, plain, lambda layout: layout.final_message.dtype, lambda decoder: decoder.finals
    )


def image_rows(files: Files, name: str) -> GatheredRows:
    """Rows of a leaf of the state (ROS name in the first layout) that is an image in one of the layouts."""
    (leaf,) = (leaf for leaf in files.layouts[0].state if leaf.name == name)
    columns = {name: _column(files, leaf)}

    def of_layout(layout: StepLayout) -> RowFormat:
        own = _own_names(files, layout)[name]
        if own not in layout.image_messages:
            return RowFormat(columns, layout.step_message.dtype, None, {name: own})
        turned = next((one for one in layout.images if one.name == own and one.frames_last), None)
        return RowFormat(columns, layout.image_messages[own].dtype, None, {name: "data"}, turned)

    return GatheredRows(files, columns, [of_layout(layout) for layout in files.layouts])


def image_names(layouts: Sequence[StepLayout]) -> dict[str, str]:
    """The leaves that are images in one of the layouts: ROS name in the first layout -> path."""
    paths = {leaf.path for layout in layouts for leaf in layout.images}
    return {leaf.name: leaf.path for leaf in (layouts[0].state if layouts else ()) if leaf.path in paths}


def _rows(
    files: Files,
    leaves: Sequence[Leaf],
    plain: Mapping[str, Column],
    dtype_of: Callable[[StepLayout], np.dtype[Any]],
    decode_of: Callable[[BatchDecoder], Decode],
) -> GatheredRows:
    columns = {**{leaf.name: _column(files, leaf) for leaf in leaves}, **plain}

    def of_layout(layout: StepLayout) -> RowFormat:
        fields = _own_names(files, layout)
        if layout.constant:
            return RowFormat(columns, dtype_of(layout), None, fields)
        return RowFormat(columns, None, decode_of(BatchDecoder(layout)), fields)

    return GatheredRows(files, columns, [of_layout(layout) for layout in files.layouts])


def _column(files: Files, leaf: Leaf) -> Column:
    """The column of a leaf of the first layout, in a dtype that holds the values of all layouts that share it."""
    if leaf.kind == "variable":
        return Column((), None)
    dtype = files.layouts[0].dtypes[leaf.name]
    for layout in files.layouts[1:]:
        own = _own_names(files, layout)[leaf.name]
        dtype = common_dtype(dtype, layout.dtypes.get(own, dtype)) or dtype
    return Column(leaf.shape, dtype)


def _own_names(files: Files, layout: StepLayout) -> dict[str, str]:
    """ROS names of leaves: in the first layout -> in this one; the same for a leaf that this one lacks."""
    names = {leaf.path: leaf.name for leaf in layout.leaves}
    return {leaf.name: names.get(leaf.path, leaf.name) for leaf in files.layouts[0].leaves}


# ---- fields


class Plan(NamedTuple):
    """How to read some fields: the columns of each kind of rows, and how they become fields."""

    sources: list[tuple[int, list[str]]]
    fields: list[tuple[str, Callable[[list[Any]], Any], list[str]]]

    @classmethod
    def of(cls, fields: Sequence[str], layout: StepLayout, kinds: Iterable[Mapping[str, Column]]) -> Plan:
        """The plan for some fields, by the columns of each kind; "next_states" must not be among them."""
        nests: dict[str, Callable[[list[Any]], Any]] = {
            "states": layout.nest_state, "actions": layout.nest_action, "rewards": layout.nest_reward,
            "times": _times,
        }  # fmt: skip
        plan = cls([], [])
        for field in fields:
            leaves = field_leaves(field, layout)
            names = [_PLAIN[field]] if leaves is None else [leaf.name for leaf in leaves]
            plan.fields.append((field, nests.get(field, _only), names))
        needed = dict.fromkeys(name for _, _, names in plan.fields for name in names)
        for i, columns in enumerate(kinds):
            if names := [name for name in needed if name in columns]:
                plan.sources.append((i, names))
        return plan

    def nest(self, columns: Mapping[str, Any]) -> dict[str, Any]:
        """The fields, made of all columns."""
        return {field: nest([columns[name] for name in names]) for field, nest, names in self.fields}


def _only(values: list[Any]) -> Any:
    return values[0]


def _times(values: list[Any]) -> Array:
    signed: Array = values[0].view(np.int64)
    if (signed < 0).any():
        raise FormatError(f"expected times of steps below 2**63 ns, found {values[0].max()}")
    return signed


# ---- threads


def do_all(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Runs all tasks on `threads` threads, the calling one included.

    After an error no further task begins; once running tasks have ended, it is raised (one, if several fail).
    """
    # No future for each task: a thread that waits for them wakes up at every one, and takes the interpreter lock.
    left = deque(tasks)
    if threads < 2 or len(left) <= _FEW_TASKS:
        _work(left, left.popleft)
        return
    # From both ends: neighbouring tasks write to neighbouring pages, and threads that touch new pages there at the same
    # time wait for each other.
    ends = itertools.cycle((left.pop, left.popleft))
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [
            pool.submit(_work, left, take) for take in itertools.islice(ends, min(threads, len(left)) - 1)
        ]
        _work(left, left.popleft)
    for other in others:
        other.result()


def _work(left: deque[Callable[[], None]], take: Callable[[], Callable[[], None]]) -> None:
    """Runs one task after the other until none is left."""
    try:
        while True:
            try:
                task = take()
            except IndexError:
                return
            task()
    except BaseException:
        left.clear()
        raise


# ---- copying


def _are_bools(column: Array) -> bool:
    """Whether all bytes of a column of bools are 0 or 1."""
    if column.nbytes < _FEW:  # not worth a call of NumPy
        return not column.tobytes().translate(None, b"\0\1")
    return bool(np.bitwise_or.reduce(column.view(np.uint8), axis=None) <= 1)


def put(column: Any, places: slice | Array, values: Any) -> None:
    """Sets rows of a column, which is a list if its values are of variable size."""
    if isinstance(places, slice) or isinstance(column, np.ndarray):
        column[places] = values
        return
    for place, value in zip(places.tolist(), values, strict=True):
        column[place] = value


def _items_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """A dtype of the same row in which a field of several numbers is one item of bytes, which NumPy copies faster."""
    fields: Mapping[str, Any] = dtype.fields or {}
    spec: Any = {
        "names": list(fields),
        "formats": [f"V{of.itemsize}" if of.shape and _LITTLE else of for of, *_ in fields.values()],
        "offsets": [offset for _, offset, *_ in fields.values()],
        "itemsize": dtype.itemsize,
    }
    made: np.dtype[Any] = np.dtype(spec)
    return made


def _as_items(column: Array) -> Array:
    """A view of a column of shape (rows, ...) with one item for each row, as in `_items_dtype`."""
    if column.ndim == 1 or not _LITTLE:
        return column
    size = math.prod(column.shape[1:])
    return column.reshape(len(column), size).view(f"V{size * column.itemsize}")[:, 0]
