"""`examine`: runs the checks on recordings. `CHECKS` has them in the order in which their findings are listed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.dataset.chosen import Chosen, Examinable, Subject, subjects_of
from tupli_mcap.doctor import episodes, steps, values
from tupli_mcap.doctor.findings import Diagnosis, Finding, Severity
from tupli_mcap.doctor.measurements import Measurements, Statistic
from tupli_mcap.errors import FilterError, NotFoundError, RecordingError, TupliError
from tupli_mcap.mcap.records import ForeignError
from tupli_mcap.recording.contents import NewerVersionError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, check_keys


@dataclass(frozen=True)
class Check:
    """A check: its id, a line on what it finds, and its function.

    run: called with the `Measurements` of each recording, and with thresholds as keywords. needs: the statistic to
    measure for it. across: if true, `run` compares recordings: it is called once, with that statistic of each.
    """

    id: str
    summary: str
    run: Callable[..., Iterator[Finding]]
    needs: type[Statistic] | None = None
    across: bool = False

    @property
    def explanation(self) -> str:
        """The docstring of `run`: what exactly is checked, and how."""
        return inspect.cleandoc(self.run.__doc__ or "")

    @property
    def thresholds(self) -> dict[str, Any]:
        """The names and defaults of its thresholds."""
        parameters = inspect.signature(self.run).parameters.values()
        return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


_VALUES = values.LeafValues
_CHECKS = (
    Check("unfinished", "recordings whose writer did not finish", episodes.unfinished),
    Check("nan", "NaN in states, final states, actions, rewards", values.nan, _VALUES),
    Check("infinity", "infinite states, final states, actions, rewards", values.infinity, _VALUES),
    Check("outside-space", "values that are not in their space", values.outside_space, _VALUES),
    Check("missing-terminals", "no episode ends in a terminal state", episodes.missing_terminals),
    Check(
        "final-state-is-reset",
        "final states that belong to the next episode",
        episodes.final_state_is_reset,
        episodes.FinalStates,
    ),
    Check("missing-reset", "steps after an end without a reset", episodes.missing_reset),
    Check("one-step-episodes", "episodes of a single step", episodes.one_step_episodes),
    Check(
        "duplicate-episodes",
        "episodes that are equal in every step",
        episodes.duplicate_episodes,
        episodes.Digests,
        across=True,
    ),
    Check("repeated-seed", "one seed for several episodes", episodes.repeated_seed),
    Check("constant-dimension", "dimensions that never change", values.constant_dimension, _VALUES),
    Check("frozen-frames", "images that stand still", steps.frozen_frames, steps.Frames),
    Check("reward-outliers", "rewards far from all others", steps.reward_outliers, steps.Rewards),
    Check("unused-action", "actions that never occur", values.unused_action, _VALUES),
    Check("clock-jump", "long pauses inside episodes", steps.clock_jump, steps.Clock),
)
CHECKS: dict[str, Check] = {check.id: check for check in _CHECKS}


UNREADABLE = "unreadable"


def examine(
    source: Examinable | Iterable[Examinable | Chosen],
    *,
    checks: Collection[str] | None = None,
    skip: Collection[str] = (),
    thresholds: Mapping[str, Mapping[str, Any]] | None = None,
    episode_filter: BaseFilter | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Check recorded episodes before training on them.

    Each recording is read once, a few megabytes at a time. Nothing in a file is executed. A file that cannot be read
    becomes a finding ("unreadable", an error); the other files are examined all the same.

    Args:
        source: the path of a recording or of a directory (a storage, too), a URL, an open `Recording`, a
            `TupliDataset` (its whole episodes: tuple filters do not count), a storage, or several of these.
            Deleted episodes are left out, except of an open `Recording`. Episodes chosen by
            `dataset.chosen.chosen_from` are examined as chosen.
        checks: ids of the checks to run (see `CHECKS`); by default, all. skip: ids of those to leave out.
        thresholds: by the id of a check, values of its thresholds (see `CHECKS[id].thresholds`).
        episode_filter: examine only episodes that match it.
        progress: called with the name of each recording before it is read.

    Raises:
        RecordingError: the source cannot be examined, there is no such check or threshold, or a threshold is no number
            from 0 on.
        FilterError: the filter names an unknown field.
    """
    check_settings([*_list(checks or ()), *_list(skip)], thresholds or {})
    if episode_filter is not None:
        check_keys(episode_filter, EpisodeHeader)
    chosen = [
        check for name, check in CHECKS.items() if (checks is None or name in checks) and name not in skip
    ]
    examination = _Examination(chosen, thresholds or {})
    for subject in subjects_of(source, episode_filter):
        if progress is not None:
            progress(subject.name)
        examination.add(subject)
    return examination.diagnosis()


def _list(checks: Collection[str]) -> Collection[str]:
    if isinstance(checks, str):
        raise RecordingError(f"expected a list of ids of checks, found the text {checks!r:.80}")
    return checks


def check_settings(checks: Iterable[str], thresholds: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises RecordingError if there is no such check or threshold, or a threshold is no number from 0 on."""
    for name in [*checks, *thresholds]:
        if name not in CHECKS:
            raise RecordingError(f"there is no check {name!r}; checks are {', '.join(CHECKS)}")
    for name, given in thresholds.items():
        for key, value in given.items():
            if key not in CHECKS[name].thresholds:
                names = ", ".join(CHECKS[name].thresholds) or "none"
                raise RecordingError(f"the check {name!r} has no threshold {key!r}; it has {names}")
            is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not (is_number and value >= 0):
                raise RecordingError(f"expected a number from 0 on for {name}.{key}, found {value!r:.80}")


class _Examination:
    """The findings so far, and the statistics that are kept to compare recordings."""

    def __init__(self, checks: Sequence[Check], thresholds: Mapping[str, Mapping[str, Any]]) -> None:
        self._checks = checks
        self._thresholds = thresholds
        self._needs = dict.fromkeys(check.needs for check in checks if check.needs is not None)
        self._findings: list[
            Finding
        ] = []  # in the order of the recordings, of each in the order of the checks
        self._kept: list[Statistic] = []
        self._files = self._episodes = self._steps = 0

    def add(self, subject: Subject) -> None:
        """Examine one recording."""
        self._files += 1
        try:
            if subject.error is not None:
                raise subject.error
            with subject.open() as recording:
                measured = Measurements(recording, subject.choose(recording))
                measured.measure(self._needs)
                findings = self._run(measured, across=False)
        except FilterError:
            raise
        except (TupliError, OSError) as err:
            self._findings.append(_unreadable(subject.name, err))
            return
        self._findings += findings
        self._episodes += len(measured.rows)
        self._steps += measured.steps
        for check in self._checks:
            if check.across and check.needs is not None:
                self._kept += measured.statistics(check.needs)

    def diagnosis(self) -> Diagnosis:
        found = [*self._run(self._kept, across=True), *self._findings]
        # sorting is stable: findings of one severity stay in their order
        findings = sorted(found, key=lambda finding: -finding.severity)
        return Diagnosis(tuple(findings), self._files, self._episodes, self._steps)

    def _run(self, data: Any, *, across: bool) -> list[Finding]:
        chosen = [check for check in self._checks if check.across == across]
        return [one for check in chosen for one in check.run(data, **self._thresholds.get(check.id, {}))]


def _unreadable(name: str, err: TupliError | OSError) -> Finding:
    message = str(err)
    if isinstance(err, OSError) and not isinstance(err, TupliError):
        message = err.strerror or str(err)
    message, suggestion = " ".join(message.split()), "run 'tupli-mcap recover' to save what is undamaged"
    # the file is not damaged: its own advice follows the semicolon
    if isinstance(err, RecordingError | ForeignError | NewerVersionError | NotFoundError):
        said, _, advice = message.partition("; ")
        message, suggestion = said, advice or "give a recording (.mcap) or a directory of them"
    return Finding(UNREADABLE, Severity.ERROR, name, message, suggestion)
