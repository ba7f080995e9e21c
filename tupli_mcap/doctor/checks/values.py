"""Checks of single values: NaN, infinities, values that are not in their space, dtypes that differ from it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.words import dimension_text, share, unravel
from tupli_mcap.recording.blocks import Array

__all__ = ["infinity", "nan", "outside_space", "stored_dtype"]


def nan(chart: Chart) -> Iterator[Finding]:
    """NaN in a state, a final state, an action or a reward. One is enough: it spreads through every network."""
    yield from _not_finite(
        chart, "nan", "NaN", "drop these episodes, or find the division or sensor that made it"
    )


def infinity(chart: Chart) -> Iterator[Finding]:
    """An infinite state, final state, action or reward."""
    advice = "clip the values, or drop these episodes; means and normalisation become infinite"
    yield from _not_finite(chart, "infinity", "infinite", advice)


def _not_finite(chart: Chart, check: str, words: str, advice: str) -> Iterator[Finding]:
    kind: Literal["nan", "infinite"] = "nan" if check == "nan" else "infinite"
    for array in chart.arrays.values():
        counts: Array = getattr(array, kind)
        count = int(counts.sum())
        if count:
            total = array.seen * array.leaf.size
            yield Finding(
                check,
                Severity.ERROR,
                chart.path,
                f"{count:,} of {total:,} values are {words}{dimension_text(array.leaf, counts > 0)}",
                advice,
                array.leaf.path,
                unravel(array.leaf, counts > 0),
                count,
                total,
                chart.places(array.places[kind]),
            )
    for variable in chart.variables.values():
        count = getattr(variable, kind)
        if count:
            yield Finding(
                check,
                Severity.ERROR,
                chart.path,
                f"{count:,} of {variable.seen:,} values hold {words}{' numbers' if check == 'infinity' else ''}",
                advice,
                variable.leaf.path,
                (),
                count,
                variable.seen,
                chart.places(variable.places[kind]),
            )


def outside_space(chart: Chart) -> Iterator[Finding]:
    """Values outside of their space: bounds of a Box, choices of a Discrete, letters of a Text, ...

    An error where the space names choices (an index out of range crashes an embedding), a warning for a Box: learners
    that scale by its bounds go astray. Within 8 units in the last place of the larger bound it is a rounding error, and
    information only. Infinite values and NaN are left to their own checks.
    """
    for array in chart.arrays.values():
        if array.outside.any():
            yield _outside(chart, array)
        elif array.barely.any():
            count, total = int(array.barely.sum()), array.seen * array.leaf.size
            yield Finding(
                "outside-space",
                Severity.INFO,
                chart.path,
                f"{count:,} of {total:,} values are outside the Box by a rounding error",
                "nothing, unless something compares with the bounds exactly",
                array.leaf.path,
                unravel(array.leaf, array.barely > 0),
                count,
                total,
            )
    for variable in chart.variables.values():
        if variable.outside:
            yield Finding(
                "outside-space",
                Severity.ERROR,
                chart.path,
                f"{variable.outside:,} of {variable.seen:,} values are not in {variable.leaf.space!r:.80}",
                "correct the space the environment declares, or what it returns",
                variable.leaf.path,
                (),
                variable.outside,
                variable.seen,
                chart.places(variable.places["outside"]),
            )


def _outside(chart: Chart, array: Any) -> Finding:
    leaf, bad = array.leaf, array.outside > 0
    count, total = int(array.outside.sum()), array.seen * leaf.size
    is_box = isinstance(leaf.space, spaces.Box)
    least, most = array.least[bad].min(), array.most[bad].max()
    low, high = array.low[bad].min(), array.high[bad].max()
    found = f"they reach from {least:g} to {most:g}, the space from {low:g} to {high:g}"
    action = leaf in chart.leaves("action")
    if action and is_box:
        advice = "clip actions before the environment does, or what was recorded is not what was done"
    elif is_box:
        advice = "widen the space's bounds, or clip what the environment returns"
    else:
        advice = "correct the space's size or start; an index out of range crashes one-hot encodings"
    return Finding(
        "outside-space",
        Severity.WARNING if is_box else Severity.ERROR,
        chart.path,
        f"{count:,} of {total:,} values ({share(count, total)}) are outside the space"
        f"{dimension_text(leaf, bad)}: {found}",
        advice,
        leaf.path,
        unravel(leaf, bad),
        count,
        total,
        chart.places(array.places["outside"]),
    )


def stored_dtype(chart: Chart) -> Iterator[Finding]:
    """Values recorded in a wider dtype than the space declares, because the environment returned it."""
    for array in chart.arrays.values():
        if array.leaf.dtype is not None and array.dtype != array.leaf.dtype:
            yield Finding(
                "stored-dtype",
                Severity.INFO,
                chart.path,
                f"the environment returned {np.dtype(array.dtype).name}, its space declares {array.leaf.dtype.name}",
                f"cast to {array.leaf.dtype.name} when training, or correct the environment",
                array.leaf.path,
            )
    for variable in chart.variables.values():
        if not variable.checked:
            yield Finding(
                "stored-dtype",
                Severity.INFO,
                chart.path,
                "the environment returned wider dtypes than its space declares, so it is not compared with it",
                "correct the environment's space",
                variable.leaf.path,
            )
