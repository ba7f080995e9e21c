"""Checks of recordings as files: empty ones, unfinished ones, metadata that does not compare."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.words import plural

__all__ = ["metadata_nan", "no_episodes", "unfinished"]


def no_episodes(chart: Chart) -> Iterator[Finding]:
    """A recording without an episode."""
    if not len(chart.rows):
        yield Finding(
            "no-episodes",
            Severity.WARNING,
            chart.path,
            "there is no episode in it",
            "look whether the rollout that made it failed, or all its episodes are deleted",
        )


def unfinished(chart: Chart) -> Iterator[Finding]:
    """A recording that its writer did not finish, or still works on."""
    if chart.state == "complete":
        return
    alive = chart.state == "recording"
    yield Finding(
        "unfinished",
        Severity.INFO,
        chart.path,
        "a writer is at work on it"
        if alive
        else "its writer did not finish it; what its chunks and its journal hold is there",
        "examine it again when the writer is done" if alive else "finish it with 'tupli-mcap recover'",
    )


def metadata_nan(chart: Chart) -> Iterator[Finding]:
    """Metadata of episodes that holds NaN or an infinity: no filter compares with it as one expects."""
    bad = np.zeros(len(chart.rows), np.bool_)
    for i in np.flatnonzero(chart.rows["metadata_length"]):
        bad[i] = "$float" in chart.metadata_text(int(i))
    count = int(bad.sum())
    if count:
        yield Finding(
            "metadata-nan",
            Severity.WARNING,
            chart.path,
            f"the metadata of {plural(count, 'episode')} of {len(bad):,} holds NaN or infinite numbers",
            "correct the metadata callback: such an episode passes no comparison in a filter",
            count=count,
            total=len(bad),
            places=chart.episodes(bad),
        )
