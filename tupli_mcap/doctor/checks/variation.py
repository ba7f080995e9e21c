"""Checks of what varies: dimensions that never change, frozen cameras, scales that differ."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.gather.values import ArrayValues
from tupli_mcap.doctor.words import dimensions, share, unravel

__all__ = ["constant_dimension", "frozen_frames", "state_scale"]


def constant_dimension(chart: Chart, *, min_steps: int = 100) -> Iterator[Finding]:
    """Dimensions of states and of continuous actions that had one value only in at least `min_steps` steps.

    A warning where a whole leaf never changes, or a dimension of floats (its standard deviation is 0: normalising
    divides by it); information where some of many integers or pixels do not. Dimensions whose Box allows one value
    only are left out, and discrete actions: those are "unused-action"'s.
    """
    if chart.steps < min_steps:
        return
    for leaf in [*chart.leaves("state"), *chart.leaves("action")]:
        array = chart.arrays.get(leaf.name)
        if array is not None and array.counts is None and leaf.size:
            yield from _constant(chart, array)
        variable = chart.variables.get(leaf.name)
        if variable is not None and not variable.changes and variable.seen:
            yield Finding(
                "constant-dimension",
                Severity.WARNING,
                chart.path,
                f"all {variable.seen:,} values are the same",
                "look whether this part of the environment works; leave it out when training",
                leaf.path,
                (),
                variable.seen,
                variable.seen,
            )


def _constant(chart: Chart, array: ArrayValues) -> Iterator[Finding]:
    leaf = array.leaf
    constant = array.constant & (array.low < array.high)
    count = int(constant.sum())
    whole = count == leaf.size
    if array.least is None or not count or (leaf.apart and not whole):
        return  # a background is no defect
    seen, value = f"{array.seen:,}", f"{array.least[constant][0]:g}"
    advice = "guard against a standard deviation of 0 when normalising, or leave it out"
    if leaf.apart:
        message, advice = f"all {seen} frames are the same", "look whether the camera works"
    elif whole:
        what = f"is always {value}" if count == 1 else "never changes"
        message = f"it {what} in {seen} values"
        advice = "look whether this sensor or actuator works; leave it out when training"
    elif count == 1:
        message = f"{dimensions(leaf, constant)} is always {value} in {seen} values"
    else:
        message = f"{dimensions(leaf, constant)} never change in {seen} values"
    yield Finding(
        "constant-dimension",
        Severity.WARNING if whole or array.dtype.kind == "f" else Severity.INFO,
        chart.path,
        message,
        advice,
        leaf.path,
        unravel(leaf, constant),
        count,
        leaf.size,
    )


def frozen_frames(chart: Chart, *, frames: int = 30) -> Iterator[Finding]:
    """A camera that stands still: `frames` or more consecutive frames of an episode equal in every pixel.

    Shorter runs are usual: an action without effect, a game that waits.
    """
    for found in chart.frames.values():
        if found.longest.length + 1 < frames:
            continue
        repeated = share(found.repeated, chart.steps)
        yield Finding(
            "frozen-frames",
            Severity.WARNING,
            chart.path,
            f"{found.longest.length + 1:,} frames in a row are equal; {repeated} of all frames repeat the one before",
            "look whether the camera or the renderer hung, and cut these steps out",
            found.leaf.path,
            (),
            found.repeated,
            chart.steps,
            chart.places([found.longest.place]),
        )


def state_scale(chart: Chart, *, ratio: float = 1e4) -> Iterator[Finding]:
    """Dimensions of a state of floats whose ranges differ by a factor of `ratio` or more."""
    for leaf in chart.leaves("state"):
        array = chart.arrays.get(leaf.name)
        if array is None or array.dtype.kind != "f" or leaf.size < 2:
            continue
        ranges = array.range
        varied = np.isfinite(ranges) & (ranges > 0)
        if varied.sum() < 2:
            continue
        smallest, largest = float(ranges[varied].min()), float(ranges[varied].max())
        if largest < ratio * smallest:
            continue
        extreme = varied & ((ranges == smallest) | (ranges == largest))
        yield Finding(
            "state-scale",
            Severity.INFO,
            chart.path,
            f"the dimension of largest range ({largest:.3g}) varies {largest / smallest:.2g} times as much as that of "
            f"the smallest ({smallest:.3g})",
            "normalise observations before training",
            leaf.path,
            unravel(leaf, extreme),
            int(extreme.sum()),
            leaf.size,
        )
