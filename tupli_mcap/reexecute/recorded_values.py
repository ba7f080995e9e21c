"""Reads the recorded values of episodes: many short episodes at once, a long one in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.recording import Columns, Recording
from tupli_mcap.recording.blocks import step_bytes, whole_episodes

_BLOCK = 8 << 20  # bytes of columns


class Block(NamedTuple):
    """Columns of the steps `start:stop` of an episode."""

    start: int
    stop: int
    columns: Columns


class RecordedValues:
    """The values of one episode. Iterating gives its blocks; it can be repeated."""

    def __init__(self, recording: Recording, position: int, columns: Columns | None, steps: int) -> None:
        self._recording = recording
        self._columns = columns
        self._steps = steps
        self.position = position
        self.length = int(recording.index["length"][position])

    def __iter__(self) -> Iterator[Block]:
        if self._columns is not None:
            yield Block(0, self.length, self._columns)
            return
        for start in range(0, self.length, self._steps):
            stop = min(self.length, start + self._steps)
            yield Block(start, stop, self._recording.read_steps(self.position, start, stop))

    @property
    def final_state(self) -> Any:
        """The state after the last step; None if it is not known."""
        return self._recording.final_state(self.position)


def recorded_values(recording: Recording, positions: Sequence[int]) -> Iterator[RecordedValues]:
    """The values of the episodes at `positions`, in that order, with a few MiB in memory at a time."""
    limit = max(1, _BLOCK // step_bytes(recording.layout))
    lengths = recording.index["length"][np.asarray(positions, np.int64)].astype(np.int64)
    for some in whole_episodes(lengths, limit):
        if int(lengths[some].sum()) > limit:  # a single one
            yield RecordedValues(recording, positions[some.start], None, limit)
        else:
            yield from _together(recording, positions[some])


def _together(recording: Recording, positions: Sequence[int]) -> Iterator[RecordedValues]:
    layout, columns, start = recording.layout, recording.read(episodes=list(positions)), 0
    for position, length in zip(positions, columns.episode_lengths.tolist(), strict=True):
        part = slice(start, start + length)
        own = Columns(
            columns.episode_lengths[:0],
            layout.nest_state([leaf.get(columns.states)[part] for leaf in layout.state]),
            layout.nest_action([leaf.get(columns.actions)[part] for leaf in layout.action]),
            layout.nest_reward([leaf.get(columns.rewards)[part] for leaf in layout.reward]),
            columns.terminals[part],
            columns.timeouts[part],
        )
        yield RecordedValues(recording, position, own, length)
        start += length
