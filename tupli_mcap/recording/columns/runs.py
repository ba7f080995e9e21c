"""Which rows of which chunks go where: runs of rows, cut at the chunks, and copied a chunk at a time."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.recording.columns.chunk_store import ChunkStore

__all__ = ["Pieces", "Runs", "final_runs", "items", "items_dtype", "put", "runs_of"]

_LITTLE = sys.byteorder == "little"  # as the rows are
_FEW = 4  # so many pieces are copied one by one


class Runs(NamedTuple):
    """Consecutive rows of a channel each, which go to the columns one run after the other; int64 arrays, or lists."""

    channels: Array | Sequence[int]
    first: Array | Sequence[int]
    steps: Array | Sequence[int]

    @property
    def few(self) -> bool:
        """Whether arrays would take longer than these runs are worth: a window, an episode."""
        return len(self.first) <= _FEW

    def each(self) -> Iterator[tuple[int, int, int, int]]:
        """Channel, first row, number of rows, and where they go, of one run after the other."""
        place = 0
        for channel, first, steps in zip(*map(_listed, self), strict=True):
            yield channel, first, steps, place
            place += steps


def _listed(part: Array | Sequence[int]) -> Sequence[int]:
    return part.tolist() if isinstance(part, np.ndarray) else part


def runs_of(episodes: Array, channels: Sequence[int]) -> Runs:
    """The runs of index rows, in their order; neighbours that continue each other are one run.

    Args:
        channels: that of each sub-environment.

    Raises:
        FormatError: an episode is of another sub-environment.
    """
    env = episodes["env"].astype(np.int64)
    if len(env) and env.max() >= len(channels):
        raise FormatError(f"an episode names sub-environment {env.max()}, but there are {len(channels)}")
    lengths = episodes["length"].astype(np.int64)
    return _joined(np.array(channels, np.int64)[env], episodes["first_row"].astype(np.int64), lengths)


def final_runs(episodes: Array, channel: int) -> Runs:
    """The runs of the final states of index rows in `/final_state`."""
    rows = episodes["final_row"].astype(np.int64)
    return _joined(np.full_like(rows, channel), rows, np.ones_like(rows))


def _joined(channels: Array, first: Array, steps: Array) -> Runs:
    if not len(first):
        return Runs(channels, first, steps)
    breaks = (channels[1:] != channels[:-1]) | (first[1:] != first[:-1] + steps[:-1])
    starts = np.concatenate([[0], np.flatnonzero(breaks) + 1])
    return Runs(channels[starts], first[starts], np.add.reduceat(steps, starts))


class Pieces(NamedTuple):
    """Parts of a chunk: `steps[i]` rows from `begin[i]` on, which go to `out[i]` on. int64, or lists where few."""

    chunk: int
    begin: Array | Sequence[int]
    steps: Array | Sequence[int]
    out: Array | Sequence[int]

    @classmethod
    def of(cls, runs: Runs, store: ChunkStore) -> list[Pieces]:
        """The pieces of some runs, one for each chunk.

        Raises:
            FormatError: there are no such rows.
        """
        if runs.few:
            return _of_few(runs, store)
        channels, first, steps = map(np.asarray, runs)
        starts, found = np.cumsum(steps) - steps, []
        for channel in np.unique(channels).tolist():
            chosen = np.flatnonzero(channels == channel)
            located = store.locate(channel, first[chosen], steps[chosen])
            if not len(located.chunk):
                continue
            # Within its run, a piece comes after those before it.
            before = np.cumsum(located.steps) - located.steps
            new = np.diff(located.run, prepend=-1) != 0
            out = starts[chosen[located.run]] + before - before[np.flatnonzero(new)][np.cumsum(new) - 1]
            found += _by_chunk(located.chunk, located.begin, located.steps, out)
        return found

    def indexes(self) -> tuple[slice | Array, slice | Array]:
        """The rows of the chunk, and where they go."""
        begins, steps, outs = (np.asarray(part) for part in (self.begin, self.steps, self.out))
        return _indexes(begins, steps), _indexes(outs, steps)

    def copy(self, rows: Array, targets: Sequence[tuple[str, Array]]) -> None:
        """Copies fields of the chunk's rows to columns of the same shape."""
        if len(self.begin) <= _FEW:
            for begin, steps, out in zip(self.begin, self.steps, self.out, strict=True):
                for name, target in targets:
                    target[out : out + steps] = rows[name][begin : begin + steps]
            return
        source, places = self.indexes()
        if isinstance(source, slice) or len(targets) == 1:
            for name, target in targets:
                target[places] = rows[name][source]
            return
        picked = rows.take(source)  # whole rows: one walk through the chunk instead of one a field
        for name, target in targets:
            target[places] = picked[name]


def _of_few(runs: Runs, store: ChunkStore) -> list[Pieces]:
    found: dict[int, tuple[list[int], list[int], list[int]]] = {}
    for channel, first, steps, out in runs.each():
        for chunk, begin, end in store.spans(channel, first, steps):
            parts = found.setdefault(chunk, ([], [], []))
            for part, value in zip(parts, (begin, end - begin, out), strict=True):
                part.append(value)
            out += end - begin
    return [Pieces(chunk, *parts) for chunk, parts in found.items()]


def _by_chunk(chunks: Array, begin: Array, steps: Array, out: Array) -> list[Pieces]:
    order = np.lexsort((begin, chunks))
    chunks, begin, steps, out = chunks[order], begin[order], steps[order], out[order]
    firsts = np.flatnonzero(np.diff(chunks, prepend=-1))
    ends = np.append(firsts[1:], len(chunks))
    return [
        Pieces(int(chunks[a]), begin[a:b], steps[a:b], out[a:b])
        for a, b in zip(firsts.tolist(), ends.tolist(), strict=True)
    ]


def _indexes(begin: Array, steps: Array) -> slice | Array:
    """The rows of some pieces, one after the other."""
    if (begin[1:] == begin[:-1] + steps[:-1]).all():
        return slice(int(begin[0]), int(begin[-1] + steps[-1]))
    before = np.cumsum(steps) - steps
    found: Array = np.repeat(begin - before, steps) + np.arange(int(steps.sum()))
    return found


def put(column: Any, places: slice | Array, values: Any) -> None:
    """Sets rows of a column, which is a list where values are of variable size."""
    if isinstance(places, slice) or isinstance(column, np.ndarray):
        column[places] = values
        return
    for place, value in zip(places.tolist(), values, strict=True):
        column[place] = value


def items_dtype(dtype: np.dtype[Any]) -> np.dtype[Any]:
    """The dtype of a row with each field of several numbers as one item of bytes: NumPy copies it twice as fast."""
    fields = [(name, *found[:2]) for name, found in (dtype.fields or {}).items()]
    spec: Any = {
        "names": [name for name, _, _ in fields],
        "formats": [_item_format(field) for _, field, _ in fields],
        "offsets": [offset for _, _, offset in fields],
        "itemsize": dtype.itemsize,
    }
    made: np.dtype[Any] = np.dtype(spec)
    return made


def _item_format(field: np.dtype[Any]) -> Any:
    return np.dtype(f"V{field.itemsize}") if field.shape and _LITTLE else field


def items(column: Array) -> Array:
    """A column of shape (rows, ...) as `items_dtype` has it: one item a row. The memory is the same."""
    if column.ndim == 1 or not _LITTLE:
        return column
    size = math.prod(column.shape[1:])
    return column.reshape(len(column), size).view(f"V{size * column.itemsize}")[:, 0]
