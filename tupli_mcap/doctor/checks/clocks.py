"""Checks of the clock: pauses in the middle of an episode, a clock that was set back or never set."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.words import duration, plural

__all__ = ["clock_held", "clock_jump", "clock_unset"]

_SECOND = 10**9
_YEAR_2000 = 946_684_800 * _SECOND


def clock_jump(
    chart: Chart, *, factor: float = 1000, least_s: float = 1.0, warn_s: float = 600.0
) -> Iterator[Finding]:
    """Steps that came `factor` times the median and `least_s` seconds or more after the one before, in one episode.

    A policy that is trained between steps pauses too: information. A warning from `warn_s` seconds on: a suspended
    machine, or a clock that was set.
    """
    gaps = chart.clock.gaps.values
    if not len(gaps):
        return
    median = float(np.median(gaps))
    limit = max(factor * median, least_s * _SECOND)
    found = [(gap, place) for gap, place in chart.clock.longest_gaps.largest if gap >= limit]
    if not found:
        return
    longest = found[0][0]
    # The list is bounded: if all of it is beyond the limit there may be more.
    many = "at least " if len(found) == len(chart.clock.longest_gaps.largest) < chart.clock.gaps.seen else ""
    yield Finding(
        "clock-jump",
        Severity.WARNING if longest >= warn_s * _SECOND else Severity.INFO,
        chart.path,
        f"{many}{plural(len(found), 'step')} came after a pause inside an episode, the longest of {duration(longest)}; "
        f"the median is {duration(median)}",
        "leave these episodes out where timing matters, as on a robot",
        count=len(found),
        total=chart.clock.gaps.seen,
        places=chart.places(place for _, place in found),
    )


def clock_held(chart: Chart, *, steps: int = 10) -> Iterator[Finding]:
    """`steps` or more steps of an episode in a row at the same time: the clock was set back, and its time is held.

    Information where no time differs inside any episode: the times were never recorded.
    """
    run, gaps = chart.clock.longest, chart.clock.gaps
    if run.length + 1 < steps:
        return
    never = chart.clock.repeated == gaps.seen
    yield Finding(
        "clock-held",
        Severity.INFO if never else Severity.WARNING,
        chart.path,
        "all steps of an episode have the same time"
        if never
        else f"{run.length + 1:,} steps in a row have the same time; {chart.clock.repeated:,} steps have that of the "
        "one before",
        "do not derive velocities or rates from these times",
        count=chart.clock.repeated,
        total=gaps.seen,
        places=chart.places([run.place]),
    )


def clock_unset(chart: Chart) -> Iterator[Finding]:
    """Episodes from before the year 2000: the machine had no clock when they were recorded."""
    old = chart.rows["start_time"] < _YEAR_2000
    count = int(old.sum())
    if count:
        yield Finding(
            "clock-unset",
            Severity.WARNING,
            chart.path,
            f"{plural(count, 'episode')} of {len(old):,} {'is' if count == 1 else 'are'} from before the year 2000",
            "set the clock of the machine that records; do not sort these by time",
            count=count,
            total=len(old),
            places=chart.episodes(old),
        )
