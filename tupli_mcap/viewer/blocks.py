"""Episodes as blocks of rows: what is sent at once, with its place on the timelines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.recording import Columns, Recording

__all__ = ["TIMELINES", "Block", "Piece", "blocks_of"]

TIMELINES = ("step", "episode_time", "time")
_MAX_ROWS = 65_536  # larger chunks make the viewer no faster
_MAX_BYTES = 32 << 20
Array = np.ndarray[Any, Any]


class Piece(NamedTuple):
    """Rows `begin:end` of a block: steps of one episode, from `step` on; `last` if they include its last."""

    begin: int
    end: int
    position: int
    step: int
    last: bool


class Block(NamedTuple):
    """Some rows, of one recording.

    `number` counts the rows from 0 within what is shown, `times` are wall clock (ns).
    """

    recording: Recording
    columns: Columns
    pieces: Sequence[Piece]
    number: Array
    times: Array

    def __len__(self) -> int:
        return len(self.number)

    @property
    def ends(self) -> list[Piece]:
        """The pieces with the last step of their episode."""
        return [piece for piece in self.pieces if piece.last]


def blocks_of(recording: Recording, positions: Sequence[int], first: int = 0) -> Iterator[Block]:
    """The steps of some episodes, in their order, at most 65,536 rows and some 32 MiB at a time.

    Args:
        first: the number of the first row.
    """
    limit = _rows_at_once(recording)
    lengths = recording.index["length"]
    group: list[int] = []
    total = 0
    for position in positions:
        length = int(lengths[position])
        if group and total + length > limit:
            yield _whole(recording, group, first)
            first += total
            group, total = [], 0
        if length > limit:
            for start in range(0, length, limit):
                yield _part(recording, position, start, min(start + limit, length), first + start)
            first += length
        elif length:
            group.append(position)
            total += length
    if group:
        yield _whole(recording, group, first)


def _rows_at_once(recording: Recording) -> int:
    layout = recording.layout
    row = sum(max(8, layout.dtypes[leaf.name].itemsize) * leaf.size for leaf in layout.leaves if leaf.dtype)
    return max(1, min(_MAX_ROWS, _MAX_BYTES // max(row, 8)))


_FIELDS = ("states", "actions", "rewards", "times")


def _whole(recording: Recording, positions: list[int], first: int) -> Block:
    columns = recording.read(positions, fields=_FIELDS)
    ends = np.cumsum(columns.episode_lengths).tolist()
    starts = [0, *ends[:-1]]
    pieces = [Piece(a, b, at, 0, True) for a, b, at in zip(starts, ends, positions, strict=True)]
    return Block(recording, columns, pieces, np.arange(first, first + len(columns)), columns.times)


def _part(recording: Recording, position: int, start: int, stop: int, first: int) -> Block:
    columns = recording.read_steps(position, start, stop, _FIELDS)
    last = stop == int(recording.index["length"][position])
    pieces = [Piece(0, stop - start, position, start, last)]
    return Block(recording, columns, pieces, np.arange(first, first + stop - start), columns.times)
