"""Statistics of a leaf's values, element by element; their memory does not grow with the steps."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array, DType
from tupli_mcap.spaces.leaves import Leaf

_MOST_CHOICES = 1 << 14  # up to this many values of all elements together are counted
_NARROW = 64  # up to this many elements for each step, a transposed copy makes reductions faster
_INT64_MAX = 2**63 - 1
# NumPy has no minimum of bools, and is slow with float16
_WIDER: dict[str, DType] = {"bool": np.dtype(np.uint8), "float16": np.dtype(np.float32)}


class ElementStatistics:
    """Statistics of a leaf of constant size. Every array has one entry for each chosen element.

    Args:
        leaf: the leaf.
        dtype: of the values.
        elements: the chosen elements of the flattened leaf (C order); None for all.
        moments: False leaves `mean` and `std` at 0: of pictures, they are most of the work.

    Attributes:
        low, high: the smallest and the largest value that the space allows.
        seen: number of values of each element.
        nan, infinite: numbers of values that are NaN or infinite, int64.
        least, most: of the finite values; without any, `least` is the largest and `most` the smallest possible value.
        choices: how often each value from `low` on occurs; empty for a Box, and for more than 16,384 values.
    """

    def __init__(
        self, leaf: Leaf, dtype: DType, elements: Array | None = None, *, moments: bool = True
    ) -> None:
        chosen: Any = slice(None) if elements is None else elements
        self.low, self.high = (ends[chosen] for ends in element_bounds(leaf))
        self.dtype = _WIDER.get(dtype.name, dtype)
        size = len(self.low)
        info: Any = np.finfo(self.dtype) if self.dtype.kind == "f" else np.iinfo(self.dtype)
        self.seen = 0
        self.nan, self.infinite = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self.least, self.most = np.full(size, info.max, self.dtype), np.full(size, info.min, self.dtype)
        self._has_moments = moments
        self._mean, self._squares = np.zeros(size), np.zeros(size)
        counts = (
            [] if isinstance(leaf.space, spaces.Box) else (self.high.astype(object) - self.low + 1).tolist()
        )
        self.choices = [np.zeros(n, np.int64) for n in counts] if sum(counts) <= _MOST_CHOICES else []

    @property
    def finite(self) -> Array:
        """Numbers of finite values."""
        found: Array = self.seen - self.nan - self.infinite
        return found

    @property
    def mean(self) -> Array:
        """Mean of the finite values; NaN if there is none."""
        return np.where(self.finite, self._mean, np.nan)

    @property
    def std(self) -> Array:
        """Population standard deviation of the finite values; NaN if there is none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(self._squares / self.finite)

    def add(self, columns: Array) -> None:
        """Adds values of each element: shape (elements, values)."""
        if not columns.size:
            return
        columns, before = columns.astype(self.dtype, copy=False), self.finite
        self.seen += columns.shape[1]
        lowest = highest = columns
        finite: Any = True
        if self.dtype.kind == "f" and not (finite := np.isfinite(columns)).all():
            nan = np.isnan(columns)
            self.nan += nan.sum(axis=1)
            self.infinite += (~finite & ~nan).sum(axis=1)
            info = np.finfo(self.dtype)
            lowest, highest = (np.where(finite, columns, end) for end in (info.max, info.min))
        self.least = np.minimum(self.least, lowest.min(axis=1))
        self.most = np.maximum(self.most, highest.max(axis=1))
        if self._has_moments:
            self._add_moments(columns, finite, before)
        for counts, column, low, high in zip(self.choices, columns, self.low, self.high, strict=False):
            inside = column[(column >= low) & (column <= high)]
            counts += np.bincount((inside - low).astype(np.int64), minlength=len(counts))

    def _add_moments(self, columns: Array, finite: Any, before: Array) -> None:
        """Joins mean and sum of squares of two sets of values: Chan, Golub and LeVeque (1983)."""
        count = self.finite - before
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):  # numbers may be too large to add
            mean = columns.sum(axis=1, dtype=np.float64, where=finite) / count
            squares = np.square(columns - mean[:, None]).sum(axis=1, where=finite)
            share = np.where(count, count / self.finite, 0)
            step = np.where(count, mean - self._mean, 0)
            self._mean = self._mean + step * share
            self._squares = self._squares + np.where(count, squares, 0) + step**2 * before * share


def columns_of(values: Array) -> Array:
    """Values of a leaf, shape (n, ...), with one row for each element: shape (elements, n)."""
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    return np.ascontiguousarray(flat.T) if flat.shape[1] <= _NARROW else flat.T


def element_bounds(leaf: Leaf) -> tuple[Array, Array]:
    """The smallest and largest value that the space allows for each element of a leaf of constant size (C order)."""
    space = leaf.space
    if isinstance(space, spaces.Box):
        return space.low.reshape(-1), space.high.reshape(-1)
    starts, counts = [0] * leaf.size, [2] * leaf.size
    if isinstance(space, spaces.Discrete):
        starts, counts = [int(space.start)], [int(space.n)]
    elif isinstance(space, spaces.MultiDiscrete):
        starts, counts = np.asarray(space.start).reshape(-1).tolist(), space.nvec.reshape(-1).tolist()
    # Python's integers: a file may claim choices beyond int64.
    ends = [min(start + n - 1, _INT64_MAX) for start, n in zip(starts, counts, strict=True)]
    return np.array([min(start, _INT64_MAX) for start in starts], np.int64), np.array(ends, np.int64)
