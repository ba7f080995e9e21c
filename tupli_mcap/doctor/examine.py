"""`examine`: recordings in, a diagnosis out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from functools import partial
from typing import Any

from tupli_mcap.dataset.subjects import Examinable, Subject, subjects_of
from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.checks import CHECKS, Check
from tupli_mcap.doctor.checks.repeats import Contents
from tupli_mcap.doctor.findings import Diagnosis, Finding, Severity
from tupli_mcap.errors import FilterError, RecordingError, TupliError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, check_keys

__all__ = ["UNREADABLE", "examine"]

UNREADABLE = "unreadable"


def examine(
    source: Examinable | Iterable[Examinable],
    *,
    checks: Collection[str] | None = None,
    skip: Collection[str] = (),
    thresholds: Mapping[str, Mapping[str, Any]] | None = None,
    episode_filter: BaseFilter | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Look at recorded episodes as someone who is about to train on them.

    Each recording is read once, a few megabytes at a time. Nothing in a file is executed. A file that cannot be read
    is a finding ("unreadable", an error), and the others are examined all the same.

    Args:
        source: the path of a recording or of a directory (a storage, too), a URL, an open `Recording`, a
            `TupliDataset` (its episodes, whole: tuple filters are for steps), a storage, or several of those.
            Episodes that a storage has deleted are left out, except of an open `Recording`.
        checks: ids of the checks to run (see `CHECKS`); all by default. skip: those to leave out.
        thresholds: for the id of a check, values of its thresholds (see `CHECKS[id].thresholds`).
        episode_filter: examine only episodes that it is true of.
        progress: called with the name of each recording before it is read.

    Raises:
        RecordingError: the source is nothing that can be examined, or there is no such check or threshold.
        FilterError: the filter names an unknown field.
    """
    chosen = _chosen(checks, skip, thresholds or {})
    if episode_filter is not None:
        check_keys(episode_filter, EpisodeHeader)
    examination = _Examination(chosen)
    for subject in subjects_of(source, episode_filter):
        if progress is not None:
            progress(subject.name)
        examination.add(subject)
    return examination.diagnosis()


Bound = tuple[Check, Callable[..., Iterable[Finding]]]


def _chosen(
    checks: Collection[str] | None, skip: Collection[str], thresholds: Mapping[str, Mapping[str, Any]]
) -> list[Bound]:
    """The checks to run, with their thresholds."""
    if isinstance(checks, str) or isinstance(skip, str):
        raise RecordingError("expected a list of the ids of checks, found a text")
    for name in [*(checks or ()), *skip, *thresholds]:
        if name not in CHECKS:
            raise RecordingError(f"there is no check {name!r}; there are {', '.join(CHECKS)}")
    for name, values in thresholds.items():
        for key in values:
            if key not in CHECKS[name].thresholds:
                known = ", ".join(CHECKS[name].thresholds) or "none"
                raise RecordingError(f"the check {name!r} has no threshold {key!r}; it has {known}")
    names = [name for name in CHECKS if (checks is None or name in checks) and name not in skip]
    return [(CHECKS[name], partial(CHECKS[name].run, **thresholds.get(name, {}))) for name in names]


class _Examination:
    """The findings so far, and what is kept to compare recordings."""

    def __init__(self, checks: list[Bound]) -> None:
        self._checks = checks
        self._needs = frozenset().union(*(check.needs for check, _ in checks))
        self._findings: list[tuple[int, int, Finding]] = []
        self._contents: list[Contents] = []
        self._files = self._episodes = self._steps = 0

    def add(self, subject: Subject) -> None:
        """Examine one recording."""
        number = self._files
        self._files += 1
        try:
            if subject.error is not None:
                raise subject.error
            with subject.open() as recording:
                chart = Chart(recording, subject.choose(recording))
                chart.measure(self._needs)
                found = [
                    (number, i, finding)
                    for i, (check, run) in enumerate(self._checks)
                    if not check.across
                    for finding in run(chart)
                ]
        except FilterError:
            raise
        except (TupliError, OSError) as err:
            self._findings.append((number, -1, _unreadable(subject.name, err)))
            return
        self._findings += found
        self._episodes += len(chart.rows)
        self._steps += chart.steps
        contents = Contents.of(chart)
        if contents is not None:
            self._contents.append(contents)

    def diagnosis(self) -> Diagnosis:
        for i, (check, run) in enumerate(self._checks):
            if check.across:
                self._findings += [(-1, i, finding) for finding in run(self._contents)]
        # Sorting is stable: of one check and recording, findings stay in the order of the leaves.
        ordered = sorted(self._findings, key=lambda item: (-item[2].severity, item[0], item[1]))
        findings = tuple(finding for _, _, finding in ordered)
        return Diagnosis(findings, self._files, self._episodes, self._steps)


def _unreadable(name: str, err: TupliError | OSError) -> Finding:
    message = str(err)
    if isinstance(err, OSError) and not isinstance(err, TupliError):
        message = err.strerror or str(err)
    message, suggestion = " ".join(message.split()), "see what can be saved with 'tupli-mcap recover'"
    if isinstance(err, RecordingError):  # nothing is wrong with the file, or there is none
        said, _, advice = message.partition("; ")
        message, suggestion = said, advice or "give a recording (.mcap) or a directory of them"
    return Finding(UNREADABLE, Severity.ERROR, name, message, suggestion)
