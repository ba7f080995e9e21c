"""Infos of steps as columns, beside the fields that are read out of recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.steps import SamplingError, Steps, checked_fields, following, pick, rows_of_runs
from tupli_mcap.errors import did_you_mean

__all__ = ["INFOS", "StepsWithInfos", "info_columns"]

INFOS = "infos"


class StepsWithInfos:
    """Steps that have one more field, `infos`: a dict of columns by key, all of them in memory."""

    def __init__(self, rest: Steps, columns: Mapping[str, Any]) -> None:
        self._rest, self._columns = rest, dict(columns)
        self.layout, self.fields = rest.layout, (*rest.fields, INFOS)
        self.episode_lengths, self.breaks = rest.episode_lengths, rest.breaks
        self.open_ends, self.identity = rest.open_ends, rest.identity

    def __reduce__(self) -> tuple[type[StepsWithInfos], tuple[Steps, dict[str, Any]]]:
        return StepsWithInfos, (self._rest, self._columns)

    def __len__(self) -> int:
        return len(self._rest)

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        fields = checked_fields(fields, self.fields)
        plain = [field for field in fields if field != INFOS]
        return self._joined(fields, self._rest.read(plain, rows) if plain else {}, rows)

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        fields = checked_fields(fields, self.fields)
        plain = [field for field in fields if field != INFOS]
        found = self._rest.read_runs(plain, starts, length) if plain else {}
        return self._joined(fields, found, rows_of_runs(starts, length))

    def _joined(self, fields: Sequence[str], found: dict[str, Any], rows: Array) -> dict[str, Any]:
        if INFOS in fields:
            where = following(rows, len(self))
            found[INFOS] = {key: pick(column, where) for key, column in self._columns.items()}
        return {field: found[field] for field in fields}

    def blocks(self, rows: Array) -> Array:
        return self._rest.blocks(rows)


def info_columns(infos: Sequence[Mapping[str, Any]], keys: Sequence[str] | None = None) -> dict[str, Any]:
    """A column for each of some keys, by default of all.

    Numbers, and arrays of one shape, become an array of shape (steps, ...): float64 with NaN where some steps lack the
    key, else of their own dtype. Other values become a list, with None where a step lacks the key.

    Raises:
        SamplingError: no step has one of the keys.
    """
    known = list(dict.fromkeys(key for info in infos for key in info))
    for key in keys or ():
        if key not in known:
            raise SamplingError(f"no info of these steps has the key {key!r:.80}{did_you_mean(key, known)}")
    return {key: _column([info.get(key) for info in infos]) for key in (known if keys is None else keys)}


def _column(values: list[Any]) -> Any:
    there = [np.asarray(value) for value in values if value is not None]
    alike = len({value.shape for value in there}) == 1 and all(value.dtype.kind in "biuf" for value in there)
    if not alike or any(isinstance(value, list | tuple) for value in values):
        return values
    if len(there) == len(values):
        return np.stack(there)
    column = np.full((len(values), *there[0].shape), np.nan)
    column[[value is not None for value in values]] = there
    return column
