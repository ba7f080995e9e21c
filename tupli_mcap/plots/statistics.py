"""Statistics that plots draw: statistics of a leaf, running means, bands, and bins."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.spaces.labels import Labels, distinct, element_names
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.spaces.statistics import ElementStatistics

LARGEST = 1e150  # values of larger size are not drawn: their differences are too large for a float
_TINY = 1e-300  # a part of a smaller value may be 0
MAX_ELEMENTS = 256  # of a leaf that are looked at one by one; of larger leaves, so many evenly chosen ones
_SMALLEST_PICTURE = 16  # pixels
_RESAMPLES = 2000  # of a bootstrap
_TAIL = 0.002  # part of the values at either end that may be cut off
_FAR = 4  # times the range of all others that values must reach to be cut off

Kind = Literal["numbers", "choices", "picture", "variable", "empty"]


def drawable_numbers(values: Array) -> Array:
    """The numbers as float64, with NaN for those that cannot be drawn."""
    numbers = np.asarray(values, np.float64)
    return np.where(np.abs(numbers) <= LARGEST, numbers, np.nan)


class LeafValues:
    """The values of one leaf in some steps; every array has an entry for each element.

    kind: "numbers" (a Box), "choices" (a Discrete, ...: `counts` are kept), "picture" (only shown in a trace),
    "variable" or "empty" (nothing is kept). elements: indexes of the used elements of the flattened leaf; values: their
    values, (elements, steps). nan, infinite: the numbers of such values. mean, std, least, most: of the finite values
    (population standard deviation), NaN if there is none. counts: of choices, how often each value occurs, from
    `starts` on. value_names: names of the values of a choice, or none.
    """

    nan: Array = np.empty(0)
    infinite: Array = np.empty(0)
    mean: Array = np.empty(0)
    std: Array = np.empty(0)
    least: Array = np.empty(0)
    most: Array = np.empty(0)

    def __init__(self, leaf: Leaf, labels: Labels, column: Array | None) -> None:
        """`column` is (steps, size); None for images and leaves of variable size."""
        self.leaf = leaf
        self.kind: Kind = _kind(leaf)
        n = min(leaf.size, MAX_ELEMENTS) if self.kind == "numbers" else 0
        self.elements = np.linspace(0, leaf.size - 1, n).round().astype(np.int64)
        # labels may be equal, as those of Walker2d are
        self.names = tuple(distinct(element_names(leaf, labels, self.elements.tolist())))
        self.value_names = labels.values.get(leaf.path, ())
        self.counts: list[Array] = []
        self.values = np.empty((0, 0)) if column is None else np.ascontiguousarray(column.T[self.elements])
        if n:
            self._sum_up()

    @classmethod
    def pooled(cls, parts: Sequence[Self]) -> Self:
        """The values of the same leaf in several recordings, as one."""
        if len(parts) == 1:
            return parts[0]
        one = copy.copy(parts[0])
        one.values = np.concatenate([part.values for part in parts], axis=1)
        if len(one.elements):
            one._sum_up()
        return one

    def _sum_up(self) -> None:
        stats = ElementStatistics(self.leaf, self.values.dtype, self.elements)
        stats.add(self.values)
        self.nan, self.infinite, self.mean, self.std = stats.nan, stats.infinite, stats.mean, stats.std
        self.least, self.most = (
            np.where(stats.finite, end.astype(np.float64), np.nan) for end in (stats.least, stats.most)
        )
        if stats.choices:
            self.kind, self.counts, self.starts = "choices", stats.choices, stats.low.tolist()

    def column(self, i: int) -> Array:
        """The values of element `i` that can be drawn (float64)."""
        values = drawable_numbers(self.values[i])
        return values[np.isfinite(values)]

    def share(self, i: int) -> Array:
        """How often each value of a choice occurs, in percent of the steps."""
        return np.asarray(100 * self.counts[i] / max(1, self.values.shape[1]))

    def notes(self) -> list[str]:
        """Sentences about what is not shown of the leaf."""
        name = self.leaf.path
        if self.kind == "variable":
            return [f"{name} is of variable size ({type(self.leaf.space).__name__}) and not shown."]
        if self.kind == "empty":
            return [f"{name} has no elements (shape {self.leaf.shape})."]
        notes = []
        shown, size = len(self.elements), self.leaf.size
        if 0 < shown < size:
            notes.append(f"Of the {size:,} elements of {name}, {shown} at even distances are shown.")
        if (np.fmax(np.abs(self.least), np.abs(self.most)) > LARGEST).any():
            notes.append(f"{name}: values beyond {LARGEST:g} are not drawn.")
        inside = sum(int(counts.sum()) for counts in self.counts)
        counted = {"NaN": self.nan.sum(), "infinite": self.infinite.sum()}
        counted["outside of the space"] = self.values.size - inside if self.counts else 0
        odd = [f"{int(count):,} {word}" for word, count in counted.items() if count]
        if odd:
            notes.append(f"{name}: {', '.join(odd)} values are left out.")
        return notes


def _kind(leaf: Leaf) -> Kind:
    if leaf.kind == "variable":
        return "variable"
    if leaf.apart or (isinstance(leaf.space, spaces.Box) and leaf.size and _is_picture(leaf.shape)):
        return "picture"
    return "numbers" if leaf.size else "empty"


def _is_picture(shape: tuple[int, ...]) -> bool:
    """Whether it is the shape of a picture, (height, width) or (height, width, 1 | 3 | 4), or of a stack of grey ones:
    (n, height, width). Depths and heat maps are pictures, too."""
    if len(shape) not in (2, 3):
        return False
    sides = shape[:2] if shape[2:] in ((1,), (3,), (4,)) else shape[-2:]
    return min(sides) >= _SMALLEST_PICTURE


def running_mean(values: Array, window: int) -> Array:
    """The mean of the finite values among each value and the `window - 1` before it; NaN where there is none."""
    finite = np.isfinite(values)
    sums = np.convolve(np.where(finite, values, 0.0), np.ones(window))[: len(values)]
    counts = np.convolve(finite, np.ones(window))[: len(values)]
    with np.errstate(invalid="ignore"):
        mean: Array = sums / counts
    return mean


def mean_interval(values: Array) -> tuple[Array, Array, Array]:
    """The mean over runs (runs, points) at each point, and the ends of its 95% interval; the same every time.

    The interval is the percentile bootstrap: the 2.5% and 97.5% quantiles of the means of runs that are drawn anew
    (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13; for runs of reinforcement learning:
    Agarwal et al., 2021, https://arxiv.org/abs/2108.13264). Of few runs it is too narrow: of 3, from the lowest to the
    highest of them.
    """
    count = len(values)
    drawn = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), _RESAMPLES) / count
    low, high = np.quantile(drawn @ values, [0.025, 0.975], axis=0)
    return values.mean(axis=0), low, high


def bands(values: Array, groups: int) -> Array:
    """`values` in so many consecutive groups of about equal size: an array (6, groups).

    Of each group its middle position, then mean, smallest, 10% quantile, 90% quantile and largest of its finite
    values (NaN where there is none).
    """
    rows = []
    ends = np.linspace(0, len(values), groups + 1).round().astype(np.int64)
    for positions in np.split(np.arange(len(values)), ends[1:-1]):
        part = values[positions]
        part = part[np.isfinite(part)] if np.isfinite(part).any() else np.array([np.nan])
        rows.append((positions.mean(), part.mean(), *np.quantile(part, [0, 0.1, 0.9, 1])))
    return np.array(rows).T


def bin_edges(values: Array, most: int) -> tuple[Array, int]:
    """Edges of equal bins over numbers that can be drawn (or NaN), and how many of those lie beyond.

    Few values make few bins. A few values far away from all others would squeeze these into one bin: they are left
    beyond. Whole numbers get bins of a whole width, centred on them.
    """
    values = values[np.isfinite(values)]
    bins = int(np.clip(2 * np.ceil(np.sqrt(len(values))), 8, most))
    values = values if len(values) else np.zeros(1)
    low, high = float(values.min()), float(values.max())
    inner_low, inner_high = np.quantile(values, [_TAIL, 1 - _TAIL]).tolist()
    spread = inner_high - inner_low
    if 0 < _FAR * spread < high - low:
        low, high = max(low, inner_low - spread / 2), min(high, inner_high + spread / 2)
    beyond = int(((values < low) | (values > high)).sum())
    if high - low < 2**52 and np.array_equal(values, np.round(values)):
        first, last = np.ceil(low), np.floor(high)
        width = max(1, int(np.ceil((last - first + 1) / bins)))
        edges = first - 0.5 + width * np.arange((last - first) // width + 2.0)
    else:
        edges = np.linspace(low, high, bins + 1)
    if not (np.diff(edges) > 0).all():  # numbers that hardly differ, or do not
        edges = low + (abs(low) / 10 if abs(low) > _TINY else 1.0) * np.array([-0.5, 0.5])
    if len(edges) == 2:  # a bar in the middle, not a wall
        edges = edges[0] + (edges[1] - edges[0]) * np.arange(-1.0, 3.0)
    return edges, beyond
