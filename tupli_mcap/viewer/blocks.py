"""Episodes as blocks of rows: what is sent at once, with its place on the timelines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.recording import Columns, Recording

__all__ = ["TIMELINES", "Block", "Finals", "Piece", "blocks_of", "row_counts"]

TIMELINES = ("step", "episode_time", "time")
_MAX_ROWS = 65_536  # larger chunks make the viewer no faster
_MAX_BYTES = 32 << 20


class Piece(NamedTuple):
    """Rows `begin:end` of a block: one episode from `step` on; `last` if they include its last step."""

    begin: int
    end: int
    position: int
    step: int
    last: bool


class Finals(NamedTuple):
    """What comes after the last steps of episodes, a row each: its final state, where that is `known`.

    `before` are the rows of the block that they come before; `states` those of the known ones, nested as the
    observation space is.
    """

    before: Array
    known: Array
    states: Any
    number: Array
    times: Array


class Block(NamedTuple):
    """Some rows, of one recording: steps, or states.

    `number` counts the rows from 0 within what is shown, `times` are wall clock (ns). `finals` are rows that are none
    of the block's; None if there are none, as in a rollout that goes on.
    """

    recording: Recording
    columns: Columns
    pieces: Sequence[Piece]
    number: Array
    times: Array
    finals: Finals | None = None

    def __len__(self) -> int:
        return len(self.number)

    def with_finals(self) -> Block:
        """The states only, with the known final ones behind the last steps of their episodes."""
        if self.finals is None:
            return self
        finals = self.finals
        known = finals.known
        before, number, times = finals.before[known], finals.number[known], finals.times[known]
        layout = self.recording.layout
        states = [
            _inserted(leaf.get(self.columns.states), before, leaf.get(finals.states)) for leaf in layout.state
        ]
        pieces = _moved(self.pieces, before)
        unknown = ~known
        later = finals.before + np.cumsum(known)
        rest = Finals(later[unknown], known[unknown], None, finals.number[unknown], finals.times[unknown])
        lengths = np.array([piece.end - piece.begin for piece in pieces])
        return Block(
            self.recording,
            Columns(lengths, states=layout.nest_state(states)),
            pieces,
            np.insert(self.number, before, number),
            np.insert(self.times, before, times),
            rest,
        )


def _moved(pieces: Sequence[Piece], before: Array) -> list[Piece]:
    """Pieces of which those that end before the rows `before` have one row more."""
    ends = np.array([piece.end for piece in pieces])
    shifts = np.searchsorted(before, ends, side="right").tolist()
    return [
        Piece(piece.begin + earlier, piece.end + shift, piece.position, piece.step, piece.last)
        for piece, earlier, shift in zip(pieces, [0, *shifts[:-1]], shifts, strict=True)
    ]


def _inserted(column: Any, before: Array, values: Any) -> Any:
    """A leaf's column with each of `values` before the row that `before` says."""
    if not isinstance(column, list):
        return np.insert(column, before, values, axis=0)
    found: list[Any] = []
    begin = 0
    for end, value in zip(before.tolist(), values, strict=True):
        found += [*column[begin:end], value]
        begin = end
    return found + column[begin:]


def row_counts(recording: Recording, positions: Sequence[int]) -> Array:
    """How many rows each of some episodes takes: its steps, and its final state."""
    lengths = recording.index["length"][np.asarray(positions, np.int64)].astype(np.int64)
    return lengths + (lengths > 0)


def blocks_of(recording: Recording, positions: Sequence[int], first: int = 0) -> Iterator[Block]:
    """The steps of some episodes, in their order, at most 65,536 rows and some 32 MiB at a time.

    Behind the last step of each, there is room for its final state: known or not, it takes a row.

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
            first += total + len(group)
            group, total = [], 0
        if length > limit:
            for start in range(0, length, limit):
                yield _part(recording, position, start, min(start + limit, length), first + start)
            first += length + 1
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
    ends = np.cumsum(columns.episode_lengths)
    starts = [0, *ends[:-1].tolist()]
    pieces = [Piece(a, b, at, 0, True) for a, b, at in zip(starts, ends.tolist(), positions, strict=True)]
    earlier = np.arange(len(positions))  # final states
    number = np.arange(first, first + len(columns)) + np.repeat(earlier, columns.episode_lengths)
    finals = _finals(recording, positions, columns, ends, first + ends + earlier)
    return Block(recording, columns, pieces, number, columns.times, finals)


def _part(recording: Recording, position: int, start: int, stop: int, first: int) -> Block:
    columns = recording.read_steps(position, start, stop, _FIELDS)
    last = stop == int(recording.index["length"][position])
    end = first + stop - start
    pieces = [Piece(0, stop - start, position, start, last)]
    finals = (
        _finals(recording, [position], columns, np.array([stop - start]), np.array([end])) if last else None
    )
    return Block(recording, columns, pieces, np.arange(first, end), columns.times, finals)


def _finals(
    recording: Recording, positions: list[int], columns: Columns, before: Array, number: Array
) -> Finals:
    """Of episodes that end before the rows `before` of some columns."""
    chosen = np.array(positions)
    known = recording.index["final_row"][chosen] >= 0
    # they were seen when the last step returned; a moment later, that one's own state can be looked at, too
    times = columns.times[before - 1] + 1
    return Finals(before, known, recording.final_states(chosen[known]), number, times)
