"""The values of a leaf, streamed: exact moments, ranges and counts of every element, and a sample of steps."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.plots.series import drawn
from tupli_mcap.spaces.element_names import element_names
from tupli_mcap.spaces.labels import Labels
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["LeafValues"]

MAX_ELEMENTS = 256
"""Elements of a leaf that are looked at one by one; of larger leaves, so many evenly chosen ones."""
_MOST_CHOICES = 1 << 12
_SMALLEST_PICTURE = 16  # pixels

Kind = Literal["numbers", "choices", "picture", "variable", "empty"]


class LeafValues:
    """What is known of the values of one leaf after `put` has seen them all; every array has an entry an element.

    kind: "numbers" (a Box), "choices" (the values of a Discrete, ...: `counts` are kept), "picture" (looked at in a
    trace only), "variable" or "empty" (nothing is kept). elements: which of the flattened leaf are looked at.
    count: steps seen. finite, nan, infinite: how many values are. least, most, mean, std: of the finite values
    (population standard deviation), NaN where there is none. counts: of choices, how often each value occurs, from
    `starts` on; outside: values that are none of them. sample: rows of the sampled steps, (steps, elements).
    """

    def __init__(self, leaf: Leaf, labels: Labels) -> None:
        self.leaf = leaf
        self.kind: Kind = _kind(leaf)
        size = leaf.size if self.kind in ("numbers", "choices") else 0
        self.elements = _evenly(size, MAX_ELEMENTS)
        self.names = element_names(leaf, labels, self.elements.tolist())
        self.value_names = labels.values.get(leaf.path, ())
        n = len(self.elements)
        self.count = 0
        self.finite, self.nan, self.infinite, self.outside = (np.zeros(n, np.int64) for _ in range(4))
        self.least, self.most = np.full(n, np.inf), np.full(n, -np.inf)
        self._mean, self._squares = np.zeros(n), np.zeros(n)
        self._sampled: list[Array] = []
        self.starts, sizes = _choices(leaf, self.elements) if self.kind == "choices" else ([], [])
        self.counts = [np.zeros(size, np.int64) for size in sizes]

    def put(self, values: Any, sampled: Array) -> None:
        """The leaf's column of some steps, and which of them (indexes) belong to the sample."""
        self.count += len(values)
        if not len(self.elements) or not len(values):
            return
        flat = values.reshape(len(values), -1)
        if len(self.elements) < flat.shape[1]:
            flat = flat[:, self.elements]
        self._sampled.append(flat[sampled])
        if self.kind == "choices":
            self._count_choices(flat)
        self._put_numbers(np.ascontiguousarray(flat.T))

    def _count_choices(self, flat: Array) -> None:
        for i, counts in enumerate(self.counts):
            at = flat[:, i].astype(np.int64) - self.starts[i]
            inside = at[(at >= 0) & (at < len(counts))]
            counts += np.bincount(inside, minlength=len(counts))
            self.outside[i] += len(at) - len(inside)

    def _put_numbers(self, columns: Array) -> None:
        """Merges moments as Chan, Golub and LeVeque do (1979); `columns` has a row an element."""
        with np.errstate(invalid="ignore", over="ignore"):
            if columns.dtype.kind == "f" and not np.isfinite(columns).all():
                nan, infinite = np.isnan(columns), np.isinf(columns)
                self.nan += nan.sum(axis=1)
                self.infinite += infinite.sum(axis=1)
                kept = np.ma.masked_array(columns.astype(np.float64), nan | infinite)
                count = (~kept.mask).sum(axis=1)
                mean, squares = kept.mean(axis=1).filled(0), (kept.var(axis=1) * count).filled(0)
                least, most = kept.min(axis=1).filled(np.inf), kept.max(axis=1).filled(-np.inf)
            else:
                count = np.full(len(columns), columns.shape[1])
                mean = columns.mean(axis=1, dtype=np.float64)
                squares = columns.var(axis=1, dtype=np.float64) * count
                least, most = columns.min(axis=1), columns.max(axis=1)
            total = self.finite + count
            away = mean - self._mean
            part = count / np.maximum(total, 1)
            self._mean = self._mean + away * part
            self._squares = self._squares + squares + away**2 * self.finite * part
        self.finite = total
        self.least, self.most = np.minimum(self.least, least), np.maximum(self.most, most)

    def finish(self) -> None:
        """To be called after the last `put`."""
        none = self.finite == 0
        self.least[none] = self.most[none] = np.nan

    @property
    def mean(self) -> Array:
        return np.where(self.finite > 0, self._mean, np.nan)

    @property
    def std(self) -> Array:
        with np.errstate(invalid="ignore", over="ignore"):
            return np.where(self.finite > 0, np.sqrt(self._squares / np.maximum(self.finite, 1)), np.nan)

    @property
    def sample(self) -> Array:
        if len(self._sampled) > 1:
            self._sampled = [np.concatenate(self._sampled)]
        if self._sampled:
            return self._sampled[0]
        return np.empty((0, len(self.elements)))

    def column(self, i: int) -> Array:
        """The values of element `i` in the sample that can be drawn (float64)."""
        values = drawn(self.sample[:, i])
        return values[np.isfinite(values)]


def _kind(leaf: Leaf) -> Kind:
    if leaf.kind == "variable":
        return "variable"
    if leaf.apart or _is_picture(leaf):
        return "picture"
    if not leaf.size:
        return "empty"
    space = leaf.space
    if isinstance(space, spaces.MultiBinary):
        return "choices"
    if isinstance(space, spaces.Discrete):
        return "choices" if int(space.n) <= _MOST_CHOICES else "numbers"
    if isinstance(space, spaces.MultiDiscrete):
        return "choices" if int(space.nvec.max()) <= _MOST_CHOICES else "numbers"
    return "numbers"


def _is_picture(leaf: Leaf) -> bool:
    """Grey pictures, and stacks of them: uint8 of the shape (height, width) or (n, height, width)."""
    if leaf.dtype != np.uint8 or not isinstance(leaf.space, spaces.Box):
        return False
    return len(leaf.shape) in (2, 3) and min(leaf.shape[-2:]) >= _SMALLEST_PICTURE and 0 not in leaf.shape


def _evenly(size: int, most: int) -> Array:
    """At most so many of the indexes below `size`, at even distances."""
    return np.arange(size) if size <= most else np.linspace(0, size - 1, most).round().astype(np.int64)


def _choices(leaf: Leaf, elements: Array) -> tuple[list[int], list[int]]:
    """The first value and the number of values of each element."""
    space = leaf.space
    if isinstance(space, spaces.Discrete):
        return [int(space.start)], [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        starts = np.asarray(space.start).reshape(-1)[elements].tolist()
        return starts, space.nvec.reshape(-1)[elements].tolist()
    return [0] * len(elements), [2] * len(elements)
