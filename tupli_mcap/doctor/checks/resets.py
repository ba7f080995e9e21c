"""Checks of what happens between episodes: missing resets, and wrappers that reset too early."""

from __future__ import annotations

from collections.abc import Iterator

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.words import plural

__all__ = ["final_state_is_reset", "missing_reset"]


def missing_reset(chart: Chart) -> Iterator[Finding]:
    """Episodes that began with a step after an end: nobody reset the environment, and it does as it likes.

    The first one of a file goes on from another file, in which it was cut when that was full.
    """
    found = chart.continued & (chart.rows["first_row"] > 0)
    count = int(found.sum())
    if count:
        yield Finding(
            "missing-reset",
            Severity.WARNING,
            chart.path,
            f"{plural(count, 'episode')} of {len(chart.rows):,} {'begins' if count == 1 else 'begin'} with a step "
            "after an end, without a reset",
            "call reset when terminated or truncated is true; leave these episodes out",
            count=count,
            total=len(chart.rows),
            places=chart.episodes(found),
        )


def final_state_is_reset(chart: Chart, *, least: int = 3, part: float = 0.5) -> Iterator[Finding]:
    """Final states that are the first observation of the next episode.

    An autoreset inside of the recorder makes them: the true last observation is lost, and bootstrapping at a timeout
    takes the value of a fresh episode. A warning from `least` episodes and `part` of those that can be compared on;
    episodes that all start in the same state cannot.
    """
    seams = chart.seams
    if seams is None or seams.equal < max(least, part * seams.compared):
        return
    yield Finding(
        "final-state-is-reset",
        Severity.WARNING,
        chart.path,
        f"the final state of {plural(seams.equal, 'episode')} of {seams.compared:,} is the first state of the next one",
        "record inside of the wrapper that resets by itself; do not bootstrap from these final states",
        count=seams.equal,
        total=seams.compared,
        places=chart.places(seams.places),
    )
