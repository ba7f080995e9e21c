"""Steps with a field from elsewhere: infos from memory, frames from recordings; infos as columns."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.steps import SamplingError, Steps, checked_fields, pick, rows_of_runs
from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.messages.infos import info_column, paths_in
from tupli_mcap.recording.frames import Frames, gathered
from tupli_mcap.schema import split_key
from tupli_mcap.schema.keys import name_within
from tupli_mcap.schema.predicate import MISSING, step_value

INFOS, FRAMES = BESIDE = ("infos", "frames")


class StepsWith:
    """Steps with one more field; `values` returns its column for some steps (int64), and can be pickled."""

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

    def only(self, parts: Sequence[str]) -> Steps:
        return StepsWith(self._rest.only(parts), self._field, self._values)

    def blocks(self, rows: Array) -> Array:
        return self._rest.blocks(rows)

    def limit(self, cache_bytes: int, threads: int) -> None:
        self._rest.limit(cache_bytes, threads)


def info_values(columns: Mapping[str, Any], rows: Array) -> dict[str, Any]:
    """Rows of columns of infos, by key, as `info_columns` makes them."""
    return {key: pick(column, rows) for key, column in columns.items()}


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
