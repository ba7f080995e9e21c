"""Columns while they are filled, recording after recording."""

from __future__ import annotations

from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.shared_dtypes import common_dtype, field_leaves
from tupli_mcap.messages.step import StepLayout

__all__ = ["FieldBuilder", "LeafBuilder", "pick"]

Keep = Array | None  # a bool mask of rows, a slice as None: all


class LeafBuilder:
    """One array (a list for a leaf of variable size) that grows up to `capacity` rows.

    Memory that is never written to is never used, so a generous capacity costs nothing.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._array: Array | None = None
        self._items: list[Any] = []
        self._filled = 0

    def put(self, values: Any, keep: Keep) -> None:
        """Appends those rows of `values` that `keep` is True of; all if it is None."""
        if isinstance(values, list):
            self._items += values if keep is None else [values[i] for i in np.flatnonzero(keep)]
            return
        rows = values if keep is None else values[keep]
        if self._array is None:
            if len(rows) == self._capacity and rows.base is None:
                self._array, self._filled = rows, len(rows)  # the whole at once: nothing to copy
                return
            self._array = np.empty((self._capacity, *rows.shape[1:]), rows.dtype)
        elif self._array.dtype != rows.dtype:
            self._widen(common_dtype(self._array.dtype, rows.dtype))
        self._array[self._filled : self._filled + len(rows)] = rows
        self._filled += len(rows)

    def _widen(self, dtype: np.dtype[Any] | None) -> None:
        if dtype is None or self._array is None or dtype == self._array.dtype:
            return
        wider = np.empty(self._array.shape, dtype)
        wider[: self._filled] = self._array[: self._filled]
        self._array = wider

    def finish(self) -> Any:
        """What has been put; the builder is empty afterwards."""
        array, self._array = self._array, None
        if array is None:
            return self._items
        if self._filled < len(array):
            array.resize((self._filled, *array.shape[1:]), refcheck=False)  # gives the rest back in place
        return array


class FieldBuilder:
    """A field's leaves while they are filled, nested as its space is once it is finished."""

    def __init__(self, field: str, capacity: int, layout: StepLayout) -> None:
        self._field = field
        self._leaves = field_leaves(field, layout)
        self._layout = layout
        self._builders = [
            LeafBuilder(capacity) for _ in range(1 if self._leaves is None else len(self._leaves))
        ]

    def put(self, column: Any, keep: Keep) -> None:
        if self._leaves is None:
            self._builders[0].put(column, keep)
            return
        for leaf, builder in zip(self._leaves, self._builders, strict=True):
            builder.put(leaf.get(column), keep)

    def finish(self) -> Any:
        values = [builder.finish() for builder in self._builders]
        if self._leaves is None:
            return values[0]
        if self._field == "rewards":
            return self._layout.nest_reward(values)
        return (self._layout.nest_action if self._field == "actions" else self._layout.nest_state)(values)


def pick(column: Any, rows: Any) -> Any:
    """Rows of a column, as a copy: `rows` is a bool mask, an array of indices or a slice."""
    if isinstance(column, dict):
        return {key: pick(part, rows) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(pick(part, rows) for part in column)
    if isinstance(column, list):
        if isinstance(rows, slice):
            return column[rows]
        return [column[i] for i in (np.flatnonzero(rows) if rows.dtype == np.bool_ else rows)]
    return column[rows].copy() if isinstance(rows, slice) else column[rows]
