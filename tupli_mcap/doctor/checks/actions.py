"""Checks of actions: choices that never occur, one that always does, controllers at their limits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from gymnasium import spaces

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.gather.values import ArrayValues
from tupli_mcap.doctor.words import dimension_text, plural, share, unravel
from tupli_mcap.recording.blocks import Array

__all__ = ["action_imbalance", "action_range", "saturated_action", "unused_action"]

_NAMED = 8


def unused_action(chart: Chart, *, steps_each: int = 20) -> Iterator[Finding]:
    """Choices of a Discrete, MultiDiscrete or MultiBinary action that never occur.

    Judged from `steps_each` steps a choice on: a uniform policy then misses one with a probability below e^-20.
    """
    for array in _counted(chart):
        for i, counts in enumerate(array.counts or ()):
            unused = np.flatnonzero(counts == 0)
            if not len(unused) or array.seen < steps_each * len(counts):
                continue
            chosen = np.arange(array.leaf.size) == i
            start = int(array.low[i])
            names = ", ".join(str(start + int(value)) for value in unused[:_NAMED])
            more = ", ..." if len(unused) > _NAMED else ""
            yield Finding(
                "unused-action",
                Severity.WARNING,
                chart.path,
                f"{len(unused):,} of {len(counts):,} choices{dimension_text(array.leaf, chosen)} never "
                f"{'occurs' if len(unused) == 1 else 'occur'} in {plural(array.seen, 'step')}: {names}{more}",
                "nothing can be learnt about these: record with more exploration, or mask them",
                array.leaf.path,
                unravel(array.leaf, chosen),
                len(unused),
                len(counts),
            )


def action_imbalance(chart: Chart, *, part: float = 0.99, min_steps: int = 1000) -> Iterator[Finding]:
    """One choice of a Discrete or MultiDiscrete action in `part` of at least `min_steps` steps, others in the rest."""
    for array in _counted(chart):
        for i, counts in enumerate(array.counts or ()):
            most, total = int(counts.max()), int(counts.sum())
            if total < min_steps or most == total or most < part * total:
                continue
            chosen = np.arange(array.leaf.size) == i
            value = int(array.low[i]) + int(np.argmax(counts))
            yield Finding(
                "action-imbalance",
                Severity.INFO,
                chart.path,
                f"the action is {value} in {share(most, total)} of {plural(total, 'step')}"
                f"{dimension_text(array.leaf, chosen)}",
                "weigh or resample the other choices when cloning behaviour",
                array.leaf.path,
                unravel(array.leaf, chosen),
                most,
                total,
            )


def saturated_action(
    chart: Chart, *, part: float = 0.5, warn: float = 0.95, min_steps: int = 100
) -> Iterator[Finding]:
    """Dimensions of a Box action that are exactly at a bound in `part` of at least `min_steps` steps.

    Information, a warning from `warn` on, unless both bounds are in use: a controller may be bang-bang.
    """
    for array in _boxes(chart):
        at_bound = array.at_low + array.at_high
        bad = at_bound >= part * array.seen
        # A dimension that never changes is "constant-dimension"'s.
        bad &= ~array.constant
        if array.seen < min_steps or not bad.any():
            continue
        one_sided = np.maximum(array.at_low, array.at_high)[bad].max() >= warn * array.seen
        count, total = int(at_bound[bad].sum()), int(bad.sum()) * array.seen
        yield Finding(
            "saturated-action",
            Severity.WARNING if one_sided else Severity.INFO,
            chart.path,
            f"actions are exactly at a bound in {share(count, total)} of {plural(array.seen, 'step')}"
            f"{dimension_text(array.leaf, bad)}",
            "look whether the policy's output was clipped: what it wanted is lost, and its density is wrong",
            array.leaf.path,
            unravel(array.leaf, bad),
            count,
            total,
        )


def action_range(chart: Chart, *, part: float = 0.1, min_steps: int = 100) -> Iterator[Finding]:
    """Dimensions of a Box action that use less than `part` of their range, in at least `min_steps` steps."""
    for array in _boxes(chart):
        if array.seen < min_steps:
            continue
        with np.errstate(invalid="ignore", over="ignore"):
            width = array.high.astype(np.float64) - array.low.astype(np.float64)
            used: Array = np.where(np.isfinite(width) & (width > 0), array.range / width, 1.0)
        bad = (used < part) & ~array.constant
        if not bad.any():
            continue
        yield Finding(
            "action-range",
            Severity.INFO,
            chart.path,
            f"actions use {100 * float(used[bad].max()):.2g}% of their range, or less"
            f"{dimension_text(array.leaf, bad)}",
            "nothing can be learnt about the rest of the range: record with more exploration",
            array.leaf.path,
            unravel(array.leaf, bad),
            int(bad.sum()),
            array.leaf.size,
        )


def _counted(chart: Chart) -> Iterator[ArrayValues]:
    found = (chart.arrays.get(leaf.name) for leaf in chart.leaves("action"))
    yield from (array for array in found if array is not None and array.counts is not None)


def _boxes(chart: Chart) -> Iterator[ArrayValues]:
    for leaf in chart.leaves("action"):
        array = chart.arrays.get(leaf.name)
        if array is not None and isinstance(leaf.space, spaces.Box) and leaf.size and array.dtype.kind == "f":
            yield array
