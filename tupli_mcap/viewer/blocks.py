"""Reads episodes as blocks of rows, each sent to Rerun at once, with the positions of the rows on the timelines."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.recording import Columns, Recording
from tupli_mcap.recording.blocks import Block as Steps, blocks

_MAX_ROWS = 65_536  # Rerun's viewer is no faster with larger chunks
_MAX_BYTES = 32 << 20


class Piece(NamedTuple):
    """Rows `begin:end` of a block: the episode at `position`, from `step` on.

    how_ended: `TERMINAL`, `TIMEOUT` or `INTERRUPTED` if they include its last step, else None.
    """

    begin: int
    end: int
    position: int
    step: int
    how_ended: int | None


class Finals(NamedTuple):
    """A row after the last step of each episode, for its final state.

    known: whether it was recorded (bool). before: the rows of the block before which these rows come. states: the known
    final states, nested as the observation space is.
    """

    before: Array
    known: Array
    states: Any
    number: Array
    times: Array


class Block(NamedTuple):
    """Rows of one recording: steps, or states.

    `number` counts the shown rows from 0; `times` are wall clock (ns). `finals` are further rows, for final states;
    None if no episode ends here.
    """

    recording: Recording
    columns: Columns
    pieces: Sequence[Piece]
    number: Array
    times: Array
    finals: Finals | None = None

    def __len__(self) -> int:
        return len(self.number)

    @property
    def seams(self) -> list[int]:
        """The first rows of episodes that follow another one."""
        return [piece.begin for piece in self.pieces if not piece.step and self.number[piece.begin]]

    def with_finals(self) -> Block:
        """Only the states, with the known final states inserted after the last steps of their episodes."""
        if self.finals is None or not self.finals.known.any():
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
    """The pieces after one row was inserted before each of the rows `before`."""
    ends = np.array([piece.end for piece in pieces])
    shifts = np.searchsorted(before, ends, side="right").tolist()
    return [
        piece._replace(begin=piece.begin + earlier, end=piece.end + shift)
        for piece, earlier, shift in zip(pieces, [0, *shifts[:-1]], shifts, strict=True)
    ]


def _inserted(column: Any, before: Array, values: Any) -> Any:
    """A leaf's column with `values[i]` inserted before row `before[i]`."""
    if not isinstance(column, list):
        return np.insert(column, before, values, axis=0)
    found: list[Any] = []
    begin = 0
    for end, value in zip(before.tolist(), values, strict=True):
        found += [*column[begin:end], value]
        begin = end
    return found + column[begin:]


def row_counts(recording: Recording, positions: Sequence[int]) -> Array:
    """The number of rows of each episode: its steps, and one for its final state."""
    lengths = recording.index["length"][np.asarray(positions, np.int64)].astype(np.int64)
    return lengths + (lengths > 0)


def blocks_of(recording: Recording, positions: Sequence[int], first: int = 0) -> Iterator[Block]:
    """The steps of episodes, in their order, at most 65,536 rows and about 32 MiB at a time. The first row has the
    number `first`. After the last step of each episode, a row number is reserved for its final state, known or not."""
    chosen = np.asarray(positions, np.int64)
    chosen = chosen[recording.index["length"][chosen] > 0]
    for block in blocks(recording, chosen, steps=_rows_at_once(recording)):
        yield _shown(recording, block, first)
        first += len(block) + (len(block.rows) if block.whole else 0)


def _rows_at_once(recording: Recording) -> int:
    layout = recording.layout
    row = sum(max(8, layout.dtypes[leaf.name].itemsize) * leaf.size for leaf in layout.leaves if leaf.dtype)
    return max(1, min(_MAX_ROWS, _MAX_BYTES // max(row, 8)))


def _shown(recording: Recording, block: Steps, first: int) -> Block:
    """A block whose first row has the number `first`."""
    starts, ends, earlier = block.starts, block.starts + block.lengths, np.arange(len(block.rows))
    columns = (starts, ends, block.positions, block.rows["end"])
    pieces = [
        Piece(start, end, position, block.first_step, how_ended if block.whole else None)
        for start, end, position, how_ended in zip(*(column.tolist() for column in columns), strict=True)
    ]
    number = np.arange(first, first + len(block)) + np.repeat(earlier, block.lengths)
    return Block(recording, block.columns, pieces, number, block.columns.times, _finals(block, ends, first))


def _finals(block: Steps, ends: Array, first: int) -> Finals | None:
    if not block.whole:
        return None
    known = block.rows["final_row"] >= 0
    states = [block.finals[leaf.name] for leaf in block.layout.state] if known.any() else None
    # Final states were seen when the last step returned; 1 ns later, so that the viewer can show that step's state too.
    times = block.columns.times[ends - 1] + 1
    nested = None if states is None else block.layout.nest_state(states)
    return Finals(ends, known, nested, first + ends + np.arange(len(ends)), times)
