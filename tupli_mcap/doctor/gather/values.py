"""The values of a leaf: what is no number, what is outside of the space, what never changes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap.doctor.findings import MAX_PLACES
from tupli_mcap.doctor.gather.digests import feed
from tupli_mcap.messages.leaves import DType, Leaf
from tupli_mcap.recording.blocks import Array

__all__ = ["ArrayValues", "VariableValues", "bounds_of"]

Locate = Callable[[int], tuple[int, int]]
_NARROW = 64  # elements a step up to which a transposed copy makes reductions quicker
_MANY_ACTIONS = 1 << 12
_INT64_MAX = 2**63 - 1


def bounds_of(leaf: Leaf) -> tuple[Array, Array]:
    """The smallest and largest value the space allows, of each element of a constant leaf (C order)."""
    space = leaf.space
    if isinstance(space, spaces.Box):
        return space.low.reshape(-1), space.high.reshape(-1)
    if isinstance(space, spaces.Discrete):
        return _choices([int(space.start)], [int(space.n)])
    if isinstance(space, spaces.MultiDiscrete):
        return _choices(np.asarray(space.start).reshape(-1).tolist(), space.nvec.reshape(-1).tolist())
    return np.zeros(leaf.size, np.int8), np.ones(leaf.size, np.int8)


def _choices(starts: list[int], sizes: list[int]) -> tuple[Array, Array]:
    # As Python's integers: a file may claim choices beyond what int64 holds.
    ends = [min(start + n - 1, _INT64_MAX) for start, n in zip(starts, sizes, strict=True)]
    return np.array([min(start, _INT64_MAX) for start in starts], np.int64), np.array(ends, np.int64)


class ArrayValues:
    """Counts for each element of a constant leaf (arrays of `leaf.size`).

    nan, infinite, outside: how many values are; `barely` are outside by a rounding error only. low, high: the space's
    bounds. least, most: the smallest and largest finite value. at_low, at_high: how many values are at a finite
    bound (actions only). counts: how often each value of a Discrete or MultiDiscrete action occurs.
    places: of each kind, the first (episode, step, element).
    """

    def __init__(self, leaf: Leaf, dtype: DType, *, action: bool) -> None:
        self.leaf = leaf
        self.dtype = dtype
        self.low, self.high = bounds_of(leaf)
        zeros = np.zeros(leaf.size, np.int64)
        self.nan, self.infinite, self.outside, self.barely = (zeros.copy() for _ in range(4))
        self.at_low, self.at_high = zeros.copy(), zeros.copy()
        self.least: Array | None = None
        self.most: Array | None = None
        self.seen = 0
        self.places: dict[str, list[tuple[int, int, int]]] = {}
        self.counts = _counts(leaf) if action else None
        self._bounded = action and isinstance(leaf.space, spaces.Box) and dtype.kind == "f"
        self._slack = _slack(leaf, self.low, self.high)

    def put(self, values: Array, locate: Locate) -> None:
        """`values` has the shape (n, *leaf.shape); `locate` gives episode and step of one of the n."""
        if not len(values) or not self.leaf.size:
            return
        flat = values.reshape(len(values), -1)
        if flat.dtype == np.bool_:
            flat = flat.view(np.uint8)
        elif flat.dtype == np.float16:
            flat = flat.astype(np.float32)
        self.seen += len(flat)
        columns = np.ascontiguousarray(flat.T) if flat.shape[1] <= _NARROW else flat.T
        least, most = self._finite_range(columns, locate)
        self.least = least if self.least is None else np.minimum(self.least, least)
        self.most = most if self.most is None else np.maximum(self.most, most)
        if (least < self.low).any() or (most > self.high).any():
            self._note_outside(columns, locate)
        if self._bounded:
            self.at_low += (columns == self.low[:, None]).sum(axis=1)
            self.at_high += (columns == self.high[:, None]).sum(axis=1)
        if self.counts is not None:
            for counts, column, low in zip(self.counts, columns, self.low, strict=True):
                inside = column[(column >= low) & (column < low + len(counts))]
                counts += np.bincount((inside - low).astype(np.int64), minlength=len(counts))

    def _finite_range(self, columns: Array, locate: Locate) -> tuple[Array, Array]:
        if columns.dtype.kind != "f":
            return columns.min(axis=1), columns.max(axis=1)
        finite = np.isfinite(columns)
        if finite.all():
            return columns.min(axis=1), columns.max(axis=1)
        nan = np.isnan(columns)
        infinite = ~finite & ~nan
        self.nan += nan.sum(axis=1)
        self.infinite += infinite.sum(axis=1)
        self._note("nan", nan, locate)
        self._note("infinite", infinite, locate)
        return (
            np.where(finite, columns, np.inf).min(axis=1),
            np.where(finite, columns, -np.inf).max(axis=1),
        )

    def _note_outside(self, columns: Array, locate: Locate) -> None:
        low, high = self.low[:, None], self.high[:, None]
        with np.errstate(invalid="ignore"):
            outside = (columns < low) | (columns > high)
            if columns.dtype.kind == "f":
                outside &= np.isfinite(columns)
                slack = self._slack[:, None]
                far = outside & ((columns < low - slack) | (columns > high + slack))
                self.barely += (outside & ~far).sum(axis=1)
                outside = far
        self.outside += outside.sum(axis=1)
        self._note("outside", outside, locate)

    def _note(self, kind: str, flags: Array, locate: Locate) -> None:
        places = self.places.setdefault(kind, [])
        missing = MAX_PLACES - len(places)
        if missing > 0:
            steps = np.flatnonzero(flags.any(axis=0))[:missing]
            places += [(*locate(int(step)), int(np.argmax(flags[:, step]))) for step in steps]

    @property
    def constant(self) -> Array:
        """Which elements had one finite value only (bool), of those that were seen at all."""
        if self.least is None or self.most is None:
            return np.zeros(self.leaf.size, np.bool_)
        constant: Array = (self.least == self.most) & (self.nan + self.infinite == 0)
        return constant

    @property
    def range(self) -> Array:
        """Largest minus smallest finite value of each element (float64); NaN where there is none."""
        if self.least is None or self.most is None:
            return np.full(self.leaf.size, np.nan)
        with np.errstate(invalid="ignore"):
            found = self.most.astype(np.float64) - self.least.astype(np.float64)
        return np.where(found >= 0, found, np.nan)


def _counts(leaf: Leaf) -> list[Array] | None:
    if isinstance(leaf.space, spaces.Discrete):
        sizes = [int(leaf.space.n)]
    elif isinstance(leaf.space, spaces.MultiDiscrete):
        sizes = [int(n) for n in leaf.space.nvec.reshape(-1)]
    elif isinstance(leaf.space, spaces.MultiBinary):
        sizes = [2] * leaf.size
    else:
        return None
    return [np.zeros(n, np.int64) for n in sizes] if sum(sizes) <= _MANY_ACTIONS else None


def _slack(leaf: Leaf, low: Array, high: Array) -> Array:
    """How far outside a rounding error may carry a value: 8 units in the last place of the larger bound."""
    if leaf.dtype is None or leaf.dtype.kind != "f":
        return np.zeros(leaf.size)
    finite = [np.where(np.isfinite(bound), np.abs(bound), 0).astype(np.float64) for bound in (low, high)]
    return 8 * float(np.finfo(leaf.dtype).eps) * np.maximum(*finite)


class VariableValues:
    """The values of a leaf of variable size: how many hold NaN, infinities, or are not in the space.

    `checked` is False where the recorded dtypes are wider than the space's: nothing would be in the space.
    """

    def __init__(self, leaf: Leaf, *, checked: bool) -> None:
        self.leaf = leaf
        self.checked = checked
        self.nan = self.infinite = self.outside = self.seen = 0
        self.changes = False
        self.places: dict[str, list[tuple[int, int]]] = {}
        self._first: bytes | None = None

    def put(self, values: Sequence[Any], locate: Locate) -> None:
        for i, value in enumerate(values):
            self._note("outside", self.checked and not self.leaf.space.contains(value), i, locate)
            numbers = [array for array in _floats(value) if not np.isfinite(array).all()]
            self._note("nan", any(np.isnan(array).any() for array in numbers), i, locate)
            self._note("infinite", any(np.isinf(array).any() for array in numbers), i, locate)
            if not self.changes:
                digest = hashlib.blake2b(digest_size=16)
                feed(digest, value)
                self._first = self._first or digest.digest()
                self.changes = digest.digest() != self._first
        self.seen += len(values)

    def _note(self, kind: str, found: bool, i: int, locate: Locate) -> None:
        if not found:
            return
        setattr(self, kind, getattr(self, kind) + 1)
        places = self.places.setdefault(kind, [])
        if len(places) < MAX_PLACES:
            places.append(locate(i))


def _floats(value: Any) -> Iterator[Array]:
    """The arrays of floats inside a value."""
    if isinstance(value, dict):
        for part in value.values():
            yield from _floats(part)
    elif isinstance(value, tuple | list):  # a GraphInstance is a tuple too
        for part in value:
            yield from _floats(part)
    elif isinstance(value, np.ndarray | np.generic | float):
        array = np.asarray(value)
        if array.dtype.kind == "f":
            yield array
