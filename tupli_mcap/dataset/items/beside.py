"""Fields of steps from elsewhere: frames from recordings, and infos, as columns in memory."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.steps import SamplingError
from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.messages.images.pictures import Picture
from tupli_mcap.messages.infos import info_column, paths_in
from tupli_mcap.recording.frames import Frames, gathered
from tupli_mcap.schema import split_key
from tupli_mcap.schema.keys import name_within
from tupli_mcap.schema.predicate import MISSING, step_value

INFOS, FRAMES = BESIDE = ("infos", "frames")


class FrameValues:
    """The frames of steps, decoded on access: uint8 (steps, height, width, 3).

    Args:
        lengths: of the whole episodes (int64).
        frames_of: returns the frames of an episode by its place.
        mask: the wanted ones of their steps (bool), by whose numbers they are called; None for all.
    """

    def __init__(self, lengths: Array, frames_of: Callable[[int], Frames], mask: Array | None = None) -> None:
        self._ends, self._frames_of = np.cumsum(lengths), frames_of
        self._starts = self._ends - lengths
        self._wanted = None if mask is None else np.flatnonzero(mask)

    def __call__(self, rows: Array) -> Array:
        rows = rows if self._wanted is None else self._wanted[rows]
        episodes = self._ends.searchsorted(rows, side="right")
        steps = rows - self._starts[episodes]
        each = ((episode, np.flatnonzero(episodes == episode)) for episode in np.unique(episodes).tolist())
        return gathered(((self._frames_of(episode), steps[at], at) for episode, at in each), len(rows))

    def seen(self, row: int) -> Picture | None:
        """The frame of a step of all; None if it has none."""
        episode = int(self._ends.searchsorted(row, side="right"))
        frames, step = self._frames_of(episode), row - int(self._starts[episode])
        return frames.of_step(step) if step in frames.steps else None


def info_keys(fields: Sequence[str]) -> tuple[list[str], list[str]]:
    """The keys of infos that fields name ("info.x": "x"; "infos": ""), and the other fields."""
    given = list(fields) if isinstance(fields, Sequence) and not isinstance(fields, str) else [fields]
    infos = [name for name in given if isinstance(name, str) and name.partition(".")[0] in (INFOS, "info")]
    return [name.partition(".")[2] for name in infos], [name for name in given if name not in infos]


def info_columns(infos: Sequence[Mapping[str, Any]], keys: Sequence[str] | None = None) -> dict[str, Any]:
    """A column for each of `keys`, by default for all keys. `contact.left[0]` is an element of an array in a dict.

    Numbers, and arrays of one shape, become an array of shape (steps, ...) with their dtype; if some steps lack the
    key it is float64, with NaN for them. Other values, and integers that would lose digits as floats, become a list,
    with None for steps that lack the key.

    Raises:
        SamplingError: no step has one of the keys.
    """
    known = list(dict.fromkeys(key for info in infos for key in info))
    if keys is None:
        return {key: info_column([info.get(key) for info in infos]) for key in known}
    return {key: info_column(_values_of(key, infos, known)) for key in keys}


def _values_of(key: str, infos: Sequence[Mapping[str, Any]], known: Sequence[str]) -> list[Any]:
    if key in known:
        return [info.get(key) for info in infos]
    with contextlib.suppress(FilterError):  # it is no name
        path = split_key(key)
        values = [step_value(info, path) for info in infos]
        if any(value is not MISSING for value in values):
            return [None if value is MISSING else value for value in values]
    names = {path: name_within("info", *path) for info in infos for path in paths_in(info)}
    hint = did_you_mean(f"info.{key}", names.values())
    raise SamplingError(f"no info of these steps has the key {key!r:.80}{hint}")
