"""Numbers, times and dimensions as texts for messages."""

from __future__ import annotations

import math

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.spaces.leaves import Leaf

_NAMED = 4  # dimensions that a message names
_LISTED = 100  # dimensions that a finding lists


def share(count: int, total: int) -> str:
    """A part in percent: `12%`, `0.3%`, `<0.1%`."""
    percent = 100 * count / total if total else 0.0
    if 0 < percent < 0.1:
        return "<0.1%"
    if percent < 10 or 99 < percent < 100:
        return f"{math.floor(10 * percent) / 10:g}%"
    return f"{percent:.0f}%"


def duration(ns: float) -> str:
    """A duration (ns) in a fitting unit: `850 ns`, `1.5 ms`, `2.0 h`."""
    for unit, size in (("h", 3600e9), ("min", 60e9), ("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if ns >= size:
            return f"{ns / size:.1f} {unit}"
    return f"{ns:.0f} ns"


def unravel(leaf: Leaf, mask: Array) -> tuple[tuple[int, ...], ...]:
    """The indexes of the elements of a leaf in a mask (C order), at most 100; empty for a scalar or for all."""
    if leaf.shape == () or mask.all():
        return ()
    indexes = np.argwhere(mask.reshape(leaf.shape))[:_LISTED]
    return tuple(tuple(index) for index in indexes.tolist())


def dimensions(leaf: Leaf, mask: Array) -> str:
    """`dimension 3`, `3 of 17 dimensions (0, 4, 5)`; empty for a scalar or for all."""
    indexes, count = unravel(leaf, mask), int(mask.sum())
    if not indexes:
        return ""
    names = [str(index[0]) if len(index) == 1 else str(index) for index in indexes[:_NAMED]]
    if count == 1:
        return f"dimension {names[0]}"
    more = ", ..." if count > _NAMED else ""
    return f"{count:,} of {leaf.size:,} dimensions ({', '.join(names)}{more})"


def dimension_text(leaf: Leaf, mask: Array) -> str:
    """The same after ` in `; empty for a scalar or for all."""
    text = dimensions(leaf, mask)
    return f" in {text}" if text else ""
