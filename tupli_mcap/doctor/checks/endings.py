"""Checks of episodes as a whole: how long they are, and how they end."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import Finding, Severity
from tupli_mcap.doctor.words import plural, share
from tupli_mcap.recording.blocks import Array
from tupli_mcap.recording.events import INTERRUPTED, TERMINAL, TIMEOUT

__all__ = [
    "episode_length",
    "flags_inside",
    "interrupted",
    "missing_final_state",
    "missing_terminals",
    "one_step_episodes",
    "time_limit_as_terminal",
]


def one_step_episodes(chart: Chart, *, part: float = 0.01, usual_length: float = 10) -> Iterator[Finding]:
    """Episodes of one step. The last one of a recording, where it is interrupted, does not count.

    A warning where they stand out: at least `part` of the episodes, while the median length is `usual_length` or more
    (a reset that was forgotten, an autoreset recorded as a step). Where episodes are short anyway, as in card games
    and bandits, information.
    """
    one = (chart.lengths == 1) & ~_last_interrupted(chart)
    count, total = int(one.sum()), len(chart.rows)
    if not count:
        return
    median = float(np.median(chart.lengths))
    odd = median >= usual_length and count >= part * total
    yield Finding(
        "one-step-episodes",
        Severity.WARNING if odd else Severity.INFO,
        chart.path,
        f"{count:,} of {plural(total, 'episode')} ({share(count, total)}) have one step; the median is {median:g}",
        "look at how these ended: a reset in the wrong place, or an autoreset recorded as a step, makes them"
        if odd
        else "nothing, if episodes of this environment are that short",
        count=count,
        total=total,
        places=chart.episodes(one),
    )


def missing_terminals(chart: Chart) -> Iterator[Finding]:
    """No episode ends in a terminal state.

    Usual where the task goes on for ever (information), if episodes end by timeout; a warning where several episodes
    have neither flag: a learner takes them for one long episode, or bootstraps from nothing.
    """
    ends: Array = chart.rows["end"]
    total = len(ends)
    if not total or (ends == TERMINAL).any():
        return
    timeouts = int((ends == TIMEOUT).sum())
    if timeouts:
        severity, words = Severity.INFO, f"{timeouts:,} by timeout"
        advice = "bootstrap from the final state of each timeout; do not treat it as a terminal"
    elif total > 1 and not _last_interrupted(chart).all():
        severity, words = Severity.WARNING, "all are interrupted"
        advice = "record terminated and truncated as the environment returns them, and step until one is true"
    else:
        return  # "interrupted" tells
    yield Finding(
        "missing-terminals",
        severity,
        chart.path,
        f"none of {plural(total, 'episode')} ends in a terminal state: {words}",
        advice,
        count=total,
        total=total,
        places=() if timeouts else chart.episodes(ends == INTERRUPTED),
    )


def interrupted(chart: Chart, *, part: float = 0.2) -> Iterator[Finding]:
    """Episodes that were cut off by a reset or the end of the recording, without terminal or timeout.

    The last one of a sub-environment is usual: information. A warning if others are, and they are `part` of all.
    """
    cut: Array = chart.rows["end"] == INTERRUPTED
    count, total = int(cut.sum()), len(cut)
    early = cut & ~_last_interrupted(chart)
    if not count:
        return
    many = int(early.sum()) >= max(2, part * total)
    last = "" if early.any() else ", as the last of " + ("its" if count == 1 else "their") + " environment"
    yield Finding(
        "interrupted",
        Severity.WARNING if many else Severity.INFO,
        chart.path,
        f"{count:,} of {plural(total, 'episode')} {'is' if count == 1 else 'are'} interrupted{last}",
        "filter them out with 'end != \"interrupted\"' where whole episodes are needed",
        count=count,
        total=total,
        places=chart.episodes(early if early.any() else cut),
    )


def time_limit_as_terminal(chart: Chart, *, least: int = 5, part: float = 0.2) -> Iterator[Finding]:
    """A time limit that was recorded as a terminal state: learners then take the value after it for 0.

    At least `least` terminal episodes, and `part` of all, have exactly the largest length there is. A warning if this
    is `max_episode_steps` of the recorded environment and no longer one exists; information if the environment says
    none and the length is at least 50, for it may be a task of fixed length.
    """
    if not len(chart.rows):
        return
    longest = int(chart.lengths.max())
    at_limit = (chart.rows["end"] == TERMINAL) & (chart.lengths == longest)
    count, total = int(at_limit.sum()), len(chart.rows)
    if count < max(least, part * total):
        return
    if chart.time_limit == longest:
        severity, words = Severity.WARNING, "the environment's time limit"
    elif chart.time_limit is None and longest >= 50:
        severity, words = Severity.INFO, "the largest length there is"
    else:
        return
    yield Finding(
        "time-limit-as-terminal",
        severity,
        chart.path,
        f"{count:,} of {plural(total, 'episode')} end as terminal after exactly {longest:,} steps, {words}",
        "return truncated instead of terminated at a time limit, so that learners bootstrap there",
        count=count,
        total=total,
        places=chart.episodes(at_limit),
    )


def flags_inside(chart: Chart) -> Iterator[Finding]:
    """Terminals or timeouts before an episode's last step: a reset was missed, or two episodes are one."""
    if chart.flags.inside:
        yield Finding(
            "flags-inside",
            Severity.ERROR,
            chart.path,
            f"{plural(chart.flags.inside, 'step')} before the last of an episode "
            f"{'is' if chart.flags.inside == 1 else 'are'} terminal or timed out",
            "split the episodes there; call reset after every end",
            count=chart.flags.inside,
            total=chart.steps,
            places=chart.places(chart.flags.places),
        )


def missing_final_state(chart: Chart) -> Iterator[Finding]:
    """Episodes whose state after the last step was not recorded; a warning where a timeout needs it."""
    missing = chart.rows["final_row"] < 0
    timeouts = missing & (chart.rows["end"] == TIMEOUT)
    count, total = int(missing.sum()), len(missing)
    if not count:
        return
    needed = int(timeouts.sum())
    words = f", {needed:,} of them timeouts" if needed else ""
    yield Finding(
        "missing-final-state",
        Severity.WARNING if needed else Severity.INFO,
        chart.path,
        f"{count:,} of {plural(total, 'episode')} have no final state{words}",
        "drop the last step of each, or do not bootstrap there: its next state is not known"
        if needed
        else "nothing for terminals; the next state of the last step is not known",
        count=count,
        total=total,
        places=chart.episodes(timeouts if needed else missing),
    )


def episode_length(chart: Chart, *, factor: float = 100) -> Iterator[Finding]:
    """Episodes longer than the environment's time limit (a warning), or `factor` times the median (information)."""
    if not len(chart.rows):
        return
    limit = chart.time_limit
    median = float(np.median(chart.lengths))
    if limit is not None and (chart.lengths > limit).any():
        long, severity = chart.lengths > limit, Severity.WARNING
        words, advice = f"the environment's time limit of {limit:,} steps", "look whether resets are recorded"
    else:
        long, severity = chart.lengths > factor * median, Severity.INFO
        words, advice = f"{factor:g} times the median of {median:g} steps", "look at what happened in these"
    count = int(long.sum())
    if count:
        yield Finding(
            "episode-length",
            severity,
            chart.path,
            f"{plural(count, 'episode')} of {len(chart.rows):,} {'is' if count == 1 else 'are'} longer than {words}; "
            f"the longest has {int(chart.lengths.max()):,}",
            advice,
            count=count,
            total=len(chart.rows),
            places=chart.episodes(long),
        )


def _last_interrupted(chart: Chart) -> Array:
    """The interrupted episodes that are the last of their sub-environment (bool)."""
    last: Array = np.zeros(len(chart.rows), np.bool_)
    reverse = chart.rows["env"][::-1]
    _, first = np.unique(reverse, return_index=True)
    last[len(reverse) - 1 - first] = True
    cut: Array = last & (chart.rows["end"] == INTERRUPTED)
    return cut
