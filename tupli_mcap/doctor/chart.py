"""A chart: what was measured of one recording, for the checks to judge."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from functools import cached_property
from typing import Any

import numpy as np

from tupli_mcap.doctor.findings import MAX_PLACES, Place
from tupli_mcap.doctor.gather.digests import Digests
from tupli_mcap.doctor.gather.resets import Seams, continued
from tupli_mcap.doctor.gather.sequence import Clock, Flags, Frames, Rewards
from tupli_mcap.doctor.gather.values import ArrayValues, VariableValues
from tupli_mcap.errors import FormatError
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import Array, Block, blocks
from tupli_mcap.recording.describe import state_of

__all__ = ["NEEDS", "Chart"]

NEEDS = frozenset({"values", "frames", "clock", "rewards", "flags", "digests", "seams"})


class Chart:
    """Measurements of the chosen episodes of a recording; what no check needs is not measured.

    path: the recording. rows: the index rows of the episodes. layout: None without a step. state: that of
    `tupli_mcap.recording.describe.state_of`. time_limit: `max_episode_steps` of the environment's spec, None if there
    is none.
    """

    def __init__(self, recording: Recording, positions: Array) -> None:
        self.path = recording.name
        self.recording = recording
        self.positions = positions
        self.rows: Array = recording.index[positions]
        self.lengths: Array = self.rows["length"].astype(np.int64)
        self.steps = int(self.lengths.sum())
        self.state = state_of(recording)
        self.time_limit = _time_limit(recording)
        self.layout: StepLayout | None = recording.layout if recording.num_envs else None
        self.arrays: dict[str, ArrayValues] = {}
        self.variables: dict[str, VariableValues] = {}
        self.frames: dict[str, Frames] = {}
        self.rewards: dict[str, Rewards] = {}
        self.clock = Clock()
        self.flags = Flags()
        self.digests: Digests | None = None
        self.seams: Seams | None = None

    def measure(self, needs: Collection[str]) -> None:
        """Read the steps once.

        Raises:
            FormatError: the recording is damaged.
        """
        if self.layout is None or not needs or not len(self.rows):
            return
        layout = self.layout
        if "values" in needs:
            self._prepare_values(layout)
        if "frames" in needs:
            self.frames = {leaf.name: Frames(leaf) for leaf in layout.images}
        if "rewards" in needs:
            self.rewards = {
                leaf.name: Rewards(leaf)
                for leaf in layout.reward
                if leaf.kind != "variable" and leaf.size == 1
            }
        if "digests" in needs:
            self.digests = Digests(layout.leaves)
        if "seams" in needs:
            self.seams = Seams(layout.state)
        for block in blocks(self.recording, self.positions):
            self._put(block, needs)

    def _prepare_values(self, layout: StepLayout) -> None:
        for leaf in layout.leaves:
            if leaf.kind == "variable":
                checked = leaf.name not in layout.inner_dtypes
                self.variables[leaf.name] = VariableValues(leaf, checked=checked)
            else:
                action = leaf in layout.action
                self.arrays[leaf.name] = ArrayValues(leaf, layout.dtypes[leaf.name], action=action)

    def _put(self, block: Block, needs: Collection[str]) -> None:
        if "values" in needs:
            gathered: dict[str, Any] = {**self.arrays, **self.variables}
            for name, values in gathered.items():
                values.put(block.leaves[name], block.place)
            numbers, lengths = block.rows["episode"], block.rows["length"]
            for name, column in block.finals.items():
                gathered[name].put(
                    column,
                    lambda i: (int(numbers[block.finals_of[i]]), int(lengths[block.finals_of[i]])),
                )
        for frames in self.frames.values():
            frames.put_block(block)
        for rewards in self.rewards.values():
            rewards.put(block)
        if "clock" in needs:
            self.clock.put_block(block)
        if "flags" in needs:
            self.flags.put(block)
        if self.digests is not None:
            self.digests.put(block)
        if self.seams is not None:
            self.seams.put(block)

    def places(self, found: Iterable[tuple[int, ...]]) -> tuple[Place, ...]:
        """The first (episode, step, ...) as places."""
        unique = dict.fromkeys(Place(self.path, item[0], item[1]) for item in found)
        return tuple(unique)[:MAX_PLACES]

    def episodes(self, chosen: Array) -> tuple[Place, ...]:
        """The first episodes of a mask over `rows`."""
        numbers = self.rows["episode"][chosen][:MAX_PLACES]
        return tuple(Place(self.path, int(number)) for number in numbers)

    @cached_property
    def continued(self) -> Array:
        """Which of the episodes began with a step after an end, without a reset (bool)."""
        return continued(self.recording, self.rows)

    def metadata_text(self, i: int) -> str:
        """The metadata of the i-th of the episodes, as JSON text."""
        return self.recording._contents.index.metadata_text(int(self.positions[i]))

    def leaves(self, kind: str) -> list[Leaf]:
        """The leaves of "state", "action" or "reward"."""
        found: list[Leaf] = [] if self.layout is None else getattr(self.layout, kind)
        return found


def _time_limit(recording: Recording) -> int | None:
    """What the environment's spec says; only data is read."""
    if "benchmark.json" not in recording.attachments:
        return None
    try:
        spec = recording.benchmark.record.spec
    except FormatError:  # a damaged description says nothing of the steps
        return None
    limit = None if spec is None else spec.get("max_episode_steps")
    return limit if isinstance(limit, int) and not isinstance(limit, bool) and limit > 0 else None
