"""Whole episodes as items."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.dataset.items import FIELDS, Items, Steps, Window
from tupli_mcap.dataset.items.steps import steps_and_fields
from tupli_mcap.recording.columns.fields import FIVE


class Episodes(Items[Window]):
    """The episodes that have a step, by number: an index gives a `Window` of all its steps.

    An array of numbers gives a `Window` of shape (B, T), T being the longest of them; the shorter ones are filled up
    with zero (None in a list), and `mask` is False there. Raises SamplingError: there is no step, or no such field.
    """

    def __init__(self, steps: Steps, *, fields: Sequence[str] = FIVE) -> None:
        super().__init__(steps, ())
        self.source, names = steps_and_fields(steps, fields, FIELDS)
        self.fields = tuple(names)
        self._counts = np.minimum(steps.episode_lengths, 1)
        self._numbers = np.flatnonzero(self._counts)
        self._lengths = steps.episode_lengths[self._numbers]
        self._firsts = np.cumsum(self._lengths) - self._lengths
        self.length = len(steps) // len(self)  # on average

    def __len__(self) -> int:
        return len(self._numbers)

    def steps_of(self, items: Array) -> Array:
        found: Array = self._firsts[items]
        return found

    def counts(self) -> Array:
        return self._counts

    def _one(self, item: int) -> Window:
        length = int(self._lengths[item])
        columns = self.source.read(self.fields, self._firsts[item] + np.arange(length))
        return Window(np.ones(length, np.bool_), self._firsts[item], self._numbers[item], **columns)

    def _batch(self, items: Array) -> Window:
        firsts, lengths = self._firsts[items], self._lengths[items]
        places = np.arange(lengths.max(initial=0))
        mask = places < lengths[:, None]
        steps = self.source.read(self.fields, (firsts[:, None] + places)[mask])
        columns = {name: _spread(column, mask) for name, column in steps.items()}
        return Window(mask, firsts, self._numbers[items], **columns)

    def __repr__(self) -> str:
        return f"<{len(self)} episodes>"


def _spread(column: Any, mask: Array) -> Any:
    """The rows of a column at the places where `mask` is True, zero or None elsewhere."""

    def of_array(part: Array) -> Array:
        spread = np.zeros((*mask.shape, *part.shape[1:]), part.dtype)
        spread[mask] = part
        return spread

    def of_list(part: list[Any]) -> list[Any]:
        rest = iter(part)
        return [[next(rest) if is_step else None for is_step in row] for row in mask.tolist()]

    return map_arrays(column, of_array, of_list)
