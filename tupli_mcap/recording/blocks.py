"""A recording in blocks: whole episodes, or a part of a long one, so that memory stays bounded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.read import Columns
from tupli_mcap.recording.recording import Recording

BLOCK_BYTES = 8 << 20
_VARIABLE_BYTES = 2048  # assumed for the values of variable size of a step
_FIELDS = ("states", "actions", "rewards", "terminals", "timeouts", "times")


@dataclass(frozen=True)
class Block:
    """Consecutive steps of some episodes, in `columns` with the leaves of `layout`.

    Attributes:
        positions: of the episodes in the recording.
        rows: the index rows of the episodes.
        lengths: steps of each episode in this block, int64.
        first_step: step of the first episode at which the block begins; not 0 only if the block has one episode.
        whole: the block holds its episodes to their ends.
        finals: by leaf name, the known final states of the episodes that end in this block.
        finals_of: the episodes of `finals`, as indexes in `rows`.
    """

    layout: StepLayout
    positions: Array
    rows: Array
    lengths: Array
    first_step: int
    whole: bool
    columns: Columns
    finals: dict[str, Any]
    finals_of: Array

    def __len__(self) -> int:
        return int(self.lengths.sum())

    @cached_property
    def leaves(self) -> dict[str, Any]:
        """The columns by leaf name: an array (steps, *shape), or a list for a leaf of variable size."""
        groups = (
            (self.layout.state, self.columns.states),
            (self.layout.action, self.columns.actions),
            (self.layout.reward, self.columns.rewards),
        )
        return {leaf.name: leaf.get(columns) for group, columns in groups for leaf in group}

    @cached_property
    def starts(self) -> Array:
        """Where each episode begins in the columns (int64)."""
        return np.cumsum(self.lengths) - self.lengths

    @cached_property
    def ends(self) -> Array:
        """The last step of each episode in the columns (int64)."""
        return np.cumsum(self.lengths) - 1

    def place(self, step: int) -> tuple[int, int]:
        """The number of the episode that a step of the columns belongs to, and its step there."""
        at = int(np.searchsorted(self.starts, step, side="right")) - 1
        return int(self.rows["episode"][at]), int(step - self.starts[at]) + self.first_step


def blocks(recording: Recording, positions: Array, *, steps: int | None = None) -> Iterator[Block]:
    """The steps of the episodes at some positions, in this order, at most `steps` (about `BLOCK_BYTES`) at a time."""
    if not len(positions):
        return
    limit = steps or max(1, BLOCK_BYTES // step_bytes(recording.layout))
    lengths = recording.index["length"][positions].astype(np.int64)
    for some in whole_episodes(lengths, limit):
        length = int(lengths[some].sum())
        if length <= limit:
            columns = recording.read(episodes=positions[some], fields=_FIELDS)
            yield _block(recording, positions[some], columns, 0, True)
            continue
        for first in range(0, length, limit):  # a single one
            stop = min(length, first + limit)
            columns = recording.read_steps(int(positions[some][0]), first, stop, _FIELDS)
            yield _block(recording, positions[some], columns, first, stop == length)


def whole_episodes(lengths: Array, limit: int) -> Iterator[slice]:
    """Consecutive episodes of at most `limit` steps together, at least one."""
    ends = np.cumsum(lengths)
    start = 0
    while start < len(lengths):
        before = int(ends[start - 1]) if start else 0
        stop = max(start + 1, int(np.searchsorted(ends, before + limit, side="right")))
        yield slice(start, stop)
        start = stop


def _block(recording: Recording, positions: Array, columns: Columns, first: int, whole: bool) -> Block:
    rows = recording.index[positions]
    known = np.flatnonzero(rows["final_row"] >= 0) if whole else np.empty(0, np.int64)
    found: dict[str, Any] = {}
    if len(known):
        nested = recording.final_states(positions[known])
        found = {leaf.name: leaf.get(nested) for leaf in recording.layout.state}
    lengths = columns.episode_lengths
    return Block(recording.layout, positions, rows, lengths, first, whole, columns, found, known)


def step_bytes(layout: StepLayout, *, images: bool = True) -> int:
    """Bytes that a step takes at least; for its values of variable size, an assumed number."""
    if layout.constant:
        own = layout.step_message.record_size
    else:
        fixed = [leaf for leaf in layout.step_leaves if leaf.kind != "variable"]
        own = _VARIABLE_BYTES + sum(leaf.size * layout.dtypes[leaf.name].itemsize for leaf in fixed)
    return own + (sum(leaf.size for leaf in layout.images) if images else 0)
