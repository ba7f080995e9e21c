"""Infos of steps as columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.dataset.items.steps import SamplingError
from tupli_mcap.errors import did_you_mean

__all__ = ["info_columns"]


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
