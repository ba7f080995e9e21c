"""Steps with a field that is read elsewhere: infos out of memory, frames out of recordings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.steps import Steps, checked_fields, following, pick, rows_of_runs
from tupli_mcap.recording.frames import Frames, gathered

__all__ = ["BESIDE", "FRAMES", "INFOS", "FrameValues", "InfoValues", "StepsWith"]

INFOS, FRAMES = BESIDE = ("infos", "frames")


class StepsWith:
    """Steps that have one more field. `values` gives its column of some steps (int64), and can be pickled."""

    def __init__(self, rest: Steps, field: str, values: Callable[[Array], Any]) -> None:
        self._rest, self._field, self._values = rest, field, values
        self.layout, self.fields = rest.layout, (*rest.fields, field)
        self.episode_lengths, self.breaks = rest.episode_lengths, rest.breaks
        self.open_ends, self.identity = rest.open_ends, rest.identity

    def __reduce__(self) -> tuple[type[StepsWith], tuple[Steps, str, Callable[[Array], Any]]]:
        return StepsWith, (self._rest, self._field, self._values)

    def __len__(self) -> int:
        return len(self._rest)

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        fields = checked_fields(fields, self.fields)
        plain = [field for field in fields if field != self._field]
        return self._joined(fields, self._rest.read(plain, rows) if plain else {}, rows)

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        fields = checked_fields(fields, self.fields)
        plain = [field for field in fields if field != self._field]
        found = self._rest.read_runs(plain, starts, length) if plain else {}
        return self._joined(fields, found, rows_of_runs(starts, length))

    def _joined(self, fields: Sequence[str], found: dict[str, Any], rows: Array) -> dict[str, Any]:
        if self._field in fields:
            found[self._field] = self._values(rows)
        return {field: found[field] for field in fields}

    def blocks(self, rows: Array) -> Array:
        return self._rest.blocks(rows)


class InfoValues:
    """Columns of infos by key, as `info_columns` makes them, all in memory."""

    def __init__(self, columns: Mapping[str, Any], total: int) -> None:
        self._columns, self._total = dict(columns), total

    def __call__(self, rows: Array) -> dict[str, Any]:
        where = following(rows, self._total)
        return {key: pick(column, where) for key, column in self._columns.items()}


class FrameValues:
    """The frames of steps, decoded when they are asked for: uint8 (steps, height, width, 3).

    Args:
        lengths: of the episodes (int64).
        frames_of: gives the frames of an episode by its place.
    """

    def __init__(self, lengths: Array, frames_of: Callable[[int], Frames]) -> None:
        self._ends, self._frames_of = np.cumsum(lengths), frames_of
        self._starts = self._ends - lengths

    def __call__(self, rows: Array) -> Array:
        episodes = self._ends.searchsorted(rows, side="right")
        steps = rows - self._starts[episodes]
        each = ((episode, np.flatnonzero(episodes == episode)) for episode in np.unique(episodes).tolist())
        return gathered(((self._frames_of(episode), steps[at], at) for episode, at in each), len(rows))
