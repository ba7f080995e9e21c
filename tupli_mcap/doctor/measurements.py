"""`Measurements`: the statistics of one recording, from which the checks make findings."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Place, Severity, unravel
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import Block, blocks
from tupli_mcap.spaces.leaves import Leaf

StepPlace = tuple[int, int]
"""The number of an episode, and a step in it; the episode's length stands for its final state."""


class Statistic:
    """Measures the steps of a recording in one pass, in memory that does not grow with their number."""

    def __init__(self, measured: Measurements) -> None: ...

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[Statistic]:
        """New statistics of this kind for a recording: one, or one for each leaf."""
        return [cls(measured)]

    def put(self, block: Block) -> None:
        """Add the next steps."""
        raise NotImplementedError


_S = TypeVar("_S", bound=Statistic)


class Measurements:
    """The chosen episodes of a recording, and the statistics of their steps.

    path: the recording's name. positions: the episodes, as positions in its index. rows, lengths: their index rows
    and numbers of steps.
    """

    def __init__(self, recording: Recording, positions: Array) -> None:
        self.recording = recording
        self.path = recording.name
        self.positions = positions
        self.rows: Array = recording.index[positions]
        self.lengths: Array = self.rows["length"].astype(np.int64)
        self.steps = int(self.lengths.sum())
        self._statistics: list[Statistic] = []

    @property
    def layout(self) -> StepLayout:
        return self.recording.layout

    def measure(self, kinds: Iterable[type[Statistic]]) -> None:
        """Read the steps once for statistics of these kinds; reads nothing if there are no kinds or no steps. Raises
        FormatError if the recording is damaged."""
        if self.steps:
            self._statistics = [statistic for kind in kinds for statistic in kind.start(self)]
        if self._statistics:
            for block in blocks(self.recording, self.positions):
                for statistic in self._statistics:
                    statistic.put(block)

    def statistics(self, kind: type[_S]) -> list[_S]:
        """The statistics of a kind."""
        return [statistic for statistic in self._statistics if isinstance(statistic, kind)]

    def places(self, steps: Iterable[StepPlace]) -> tuple[Place, ...]:
        """The first different places among some steps, at most `MAX_PLACES`."""
        return tuple(Place(self.path, *step) for step in dict.fromkeys(steps))[:MAX_PLACES]

    def episodes(self, mask: Array) -> tuple[Place, ...]:
        """The first episodes of a mask over `rows`, at most `MAX_PLACES`."""
        return tuple(Place(self.path, int(number)) for number in self.rows["episode"][mask][:MAX_PLACES])

    def finding(
        self,
        check: str,
        severity: Severity,
        message: str,
        advice: str,
        count: int = 0,
        total: int = 0,
        places: tuple[Place, ...] = (),
        leaf: Leaf | None = None,
        mask: Array | None = None,
    ) -> Finding:
        """A finding about this recording, or about the elements of a leaf in a mask."""
        path = None if leaf is None else leaf.path
        indexes = () if leaf is None or mask is None else unravel(leaf, mask)
        return Finding(check, severity, self.path, message, advice, path, indexes, count, total, places)


def value_bytes(layout: StepLayout, leaf: Leaf, value: Any) -> bytes:
    """A value of a leaf as bytes, which are equal only for equal values."""
    if leaf.kind == "variable":
        return layout.variable[leaf.name].encoded(value)
    return bytes(value.tobytes())
