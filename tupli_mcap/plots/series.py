"""Numbers over episodes: running means, bands, and the edges of bins."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array

__all__ = ["LARGEST", "Bands", "bands", "bin_count", "bin_edges", "drawn", "running_mean", "window_of"]

_TAIL = 0.002  # part of the values at either end that may be cut off
_FAR = 4  # times the range of all others that values must reach to be cut off
_MOST_WINDOW = 100
_HUGE = 1e300
LARGEST = 1e150
"""Values of larger size are not drawn: their differences are too large for a float."""


def drawn(values: Array) -> Array:
    """As float64, with NaN for what cannot be drawn."""
    numbers = np.asarray(values, np.float64)
    return np.where(np.abs(numbers) <= LARGEST, numbers, np.nan)


def window_of(count: int) -> int:
    """Episodes of a running mean: a tenth of all, at most 100."""
    return max(1, min(_MOST_WINDOW, count // 10))


def running_mean(values: Array, window: int) -> Array:
    """The mean of each value and the `window - 1` before it (fewer at the start), without those that are not finite.

    NaN where none of them is finite.
    """
    finite = np.isfinite(values)
    sums = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    counts = np.concatenate([[0], np.cumsum(finite)])
    stop = np.arange(1, len(values) + 1)
    start = np.maximum(0, stop - window)
    count = counts[stop] - counts[start]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean: Array = (sums[stop] - sums[start]) / count
    return mean


class Bands(NamedTuple):
    """Values in consecutive groups: the middle of each, and quantiles and mean of its finite values (NaN: none)."""

    at: Array
    low: Array
    tenth: Array
    mean: Array
    ninetieth: Array
    high: Array


def bands(values: Array, groups: int) -> Bands:
    """`values` in so many groups of about equal size, in their order."""
    edges = np.linspace(0, len(values), groups + 1).round().astype(np.int64)
    rows = []
    for start, stop in itertools.pairwise(edges.tolist()):
        part = values[start:stop]
        part = part[np.isfinite(part)]
        row = (np.nan,) * 5
        if len(part):
            quantiles = np.quantile(part, [0, 0.1, 0.9, 1])
            row = (quantiles[0], quantiles[1], part.mean(), quantiles[2], quantiles[3])
        rows.append(((start + stop - 1) / 2, *row))
    return Bands(*np.array(rows).T)


def bin_count(count: int, most: int) -> int:
    """Bins of a histogram of so many values: few values make few bins."""
    return int(np.clip(2 * np.ceil(np.sqrt(count)), 8, most))


def bin_edges(values: Array, bins: int) -> tuple[Array, int]:
    """Edges of equal bins over the finite values, and how many of those lie beyond.

    A few values far away from all others would squeeze these into one bin: they are left beyond. Whole numbers get
    bins of a whole width, centred on them.
    """
    values = np.asarray(values, np.float64)
    values = values[np.isfinite(values)]
    if not len(values):
        return np.array([0.0, 1.0]), 0
    low, high = float(values.min()), float(values.max())
    inner_low, inner_high = (float(value) for value in np.quantile(values / 2, [_TAIL, 1 - _TAIL]))
    spread = 2 * (inner_high - inner_low)
    if 0 < spread < np.inf and high - low > _FAR * spread:
        low, high = max(low, 2 * inner_low - spread / 2), min(high, 2 * inner_high + spread / 2)
    beyond = int(((values < low) | (values > high)).sum())
    if high - low < 2**52 and np.array_equal(values, np.round(values)):
        width = max(1, int(np.ceil((np.floor(high) - np.ceil(low) + 1) / bins)))
        count = int((np.floor(high) - np.ceil(low)) // width) + 1
        found = np.ceil(low) - 0.5 + width * np.arange(count + 1.0)
    else:
        found = 2 * np.linspace(
            low / 2, high / 2, bins + 1
        )  # halves: the whole range may be too large a number
        found[0], found[-1] = low, high
    if not (np.diff(found) > 0).all():  # numbers that hardly differ, or do not
        half = 0.5 * max(1.0, abs(low)) if abs(low) < _HUGE else 0.0
        found = np.array([low - half, high + half]) if half else np.array([low * 0.9, low * 1.05])
    return found, beyond
