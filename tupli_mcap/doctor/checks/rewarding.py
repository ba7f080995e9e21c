"""Checks of rewards and returns: outliers, and rewards that say nothing."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.gather.sequence import Rewards
from tupli_mcap.doctor.words import plural
from tupli_mcap.recording.blocks import Array

__all__ = ["constant_reward", "return_outliers", "reward_outliers"]

# The standard deviation of a normal distribution is 1.4826 times its median absolute deviation. Source: B. Iglewicz and
# D. C. Hoaglin, How to Detect and Handle Outliers, ASQC 1993, chapter 3.
_MAD_TO_STD = 1.4826
_FEW = 20


def constant_reward(chart: Chart, *, min_steps: int = 100, zero_steps: int = 10_000) -> Iterator[Finding]:
    """All rewards are equal, in at least `min_steps` steps.

    Usual where every step costs or earns the same (information); a warning if there are none but zeros in
    `zero_steps` or more: nothing can be learnt from them.
    """
    if chart.steps < min_steps:
        return
    for leaf in chart.leaves("reward"):
        array = chart.arrays.get(leaf.name)
        if array is None or not leaf.size or not array.constant.all() or array.least is None:
            continue
        zero = not array.least.any()
        value = f"{array.least[0]:g}" if leaf.size == 1 else "the same"
        yield Finding(
            "constant-reward",
            Severity.WARNING if zero and chart.steps >= zero_steps else Severity.INFO,
            chart.path,
            f"all {array.seen:,} rewards are {'0' if zero else value}",
            "record episodes that reach the goal; from these nothing can be learnt"
            if zero
            else "nothing, if only the length of an episode counts",
            leaf.path,
            (),
            array.seen,
            array.seen,
        )


def reward_outliers(chart: Chart, *, factor: float = 300) -> Iterator[Finding]:
    """Rewards further than `factor` scales from the median, among the last steps of episodes and the others apart.

    A bonus at the end is usual, one reward of a million is not. The scale is 1.4826 times the median absolute
    deviation; where most rewards are equal, the larger of the median's magnitude and the median of the deviations that
    are not 0 (if there are three). No judgement where that is 0 too, or below 20 rewards. Median and scale are those of
    a sample where there are more than 65,536 rewards.
    """
    for rewards in chart.rewards.values():
        for kind in ("inner", "last"):
            yield from _outliers(chart, rewards, kind, factor)


def _outliers(chart: Chart, rewards: Rewards, kind: str, factor: float) -> Iterator[Finding]:
    sample = rewards.inner if kind == "inner" else rewards.last
    if sample.seen < _FEW:
        return
    median, scale = _scale(sample.values)
    if scale == 0:
        return
    limit = factor * scale
    found = [(v, p) for v, p in rewards.highest[kind].largest if v - median > limit]
    found += [(-v, p) for v, p in rewards.lowest[kind].largest if median + v > limit]
    if not found:
        return
    found.sort(key=lambda item: (-abs(item[0] - median), item[1]))
    where = "among the last steps of episodes" if kind == "last" else "before the last steps of episodes"
    yield Finding(
        "reward-outliers",
        Severity.WARNING,
        chart.path,
        f"{plural(len(found), 'reward')} {'is' if len(found) == 1 else 'are'} further than {factor:g} times the usual "
        f"deviation ({scale:.3g}) from the median ({median:.3g}), {where}; the furthest is {found[0][0]:g}",
        "look at these steps; clip or scale rewards if they are right",
        rewards.leaf.path,
        (),
        len(found),
        sample.seen,
        chart.places(place for _, place in found),
    )


def return_outliers(chart: Chart, *, factor: float = 50) -> Iterator[Finding]:
    """Returns further than `factor` scales (as of "reward-outliers") from the median: information."""
    returns: Array = chart.rows["return"]
    finite = np.isfinite(returns)
    if finite.sum() < _FEW:
        return
    median, scale = _scale(returns[finite])
    far = finite & (np.abs(np.where(finite, returns, median) - median) > factor * scale)
    count = int(far.sum())
    if scale == 0 or not count:
        return
    worst = returns[far][np.argmax(np.abs(returns[far] - median))]
    yield Finding(
        "return-outliers",
        Severity.INFO,
        chart.path,
        f"the return of {plural(count, 'episode')} of {len(returns):,} is further than {factor:g} times the usual "
        f"deviation ({scale:.3g}) from the median ({median:.3g}); the furthest is {worst:g}",
        "look at these episodes; weigh them, or leave them out",
        count=count,
        total=len(returns),
        places=chart.episodes(far),
    )


def _scale(values: Array) -> tuple[float, float]:
    """Median, and how far values usually are from it."""
    median = float(np.median(values))
    deviations = np.abs(values - median)
    spread = _MAD_TO_STD * float(np.median(deviations))
    if spread > 0:
        return median, spread
    others = deviations[deviations > 0]
    return median, max(abs(median), float(np.median(others)) if len(others) >= 3 else 0.0)
