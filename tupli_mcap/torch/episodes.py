"""Whole episodes as items."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.sampling import SamplingError, Steps, Window
from tupli_mcap.sampling.steps import checked_fields, map_arrays
from tupli_mcap.sampling.windows import FIVE

__all__ = ["Episodes"]

Array = np.ndarray[Any, Any]


class Episodes:
    """The episodes that have a step, by number: an index gives a `Window` of all its steps.

    An array of numbers gives a `Window` of shape (B, T), T being the longest of them; the shorter ones are filled up
    with zero (None in a list), and `mask` is False there. Raises SamplingError: there is no step.
    """

    def __init__(self, steps: Steps, *, fields: Sequence[str] = FIVE) -> None:
        self.source = steps
        self.fields = tuple(checked_fields(fields))
        ends = np.cumsum(steps.episode_lengths)
        self._numbers = np.flatnonzero(steps.episode_lengths)
        self._lengths = steps.episode_lengths[self._numbers]
        self._firsts = ends[self._numbers] - self._lengths
        self.length = len(steps) // max(1, len(self))  # on average
        if not len(self):
            raise SamplingError("expected an episode with a step, found none; look at the filters")

    def __len__(self) -> int:
        return len(self._numbers)

    def first_steps(self, numbers: Array) -> Array:
        """The number of the first step of each of some episodes (int64); nothing is read."""
        found: Array = self._firsts[numbers]
        return found

    def __getitem__(self, index: int | Sequence[int] | Array) -> Window:
        numbers = np.asarray(index, np.int64)
        if numbers.size and not (-len(self) <= numbers.min() and numbers.max() < len(self)):
            raise IndexError(f"expected episodes from 0 to {len(self) - 1}, found {index!r:.80}")
        firsts, lengths = self._firsts[numbers], self._lengths[numbers]
        if not numbers.ndim:
            rows = firsts + np.arange(int(lengths))
            columns = self.source.read(self.fields, rows)
            return Window(np.ones(len(rows), np.bool_), firsts, self._numbers[numbers], **columns)
        places = np.arange(lengths.max(initial=0))
        mask = places < lengths[:, None]
        rows = (firsts[:, None] + places)[mask]
        found = self.source.read(self.fields, rows)
        columns = {name: _spread(column, mask) for name, column in found.items()}
        return Window(mask, firsts, self._numbers[numbers], **columns)


def _spread(column: Any, mask: Array) -> Any:
    """The rows of a column at the places where `mask` is True, zero or None elsewhere."""

    def of_array(part: Array) -> Array:
        spread = np.zeros((*mask.shape, *part.shape[1:]), part.dtype)
        spread[mask] = part
        return spread

    def of_list(part: list[Any]) -> list[Any]:
        rest = iter(part)
        return [[next(rest) if there else None for there in row] for row in mask.tolist()]

    return map_arrays(of_array, column, of_list)
