"""What `examine` returns: a diagnosis, and the findings in it."""

from __future__ import annotations

import enum
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

MAX_PLACES = 5  # examples that a finding names
JSON_VERSION = 1


class Severity(enum.IntEnum):
    """How bad a finding is.

    ERROR: the data is wrong, a learner would break on it or learn nonsense (NaN, values outside a Discrete space).
    WARNING: something is probably wrong, or surprises a learner (a dimension that never changes).
    INFO: worth knowing, and usual in healthy data too (episodes that all end by timeout).
    """

    INFO = 1
    WARNING = 2
    ERROR = 3

    def __str__(self) -> str:
        return self.name.lower()


class Place(NamedTuple):
    """Where something was found: the recording, the number of the episode, the step in it (from 0).

    step: None where it is about the whole episode; the episode's length where it is about its final state.
    """

    path: str
    episode: int
    step: int | None = None

    def __str__(self) -> str:
        return f"episode {self.episode}" if self.step is None else f"episode {self.episode} step {self.step}"


@dataclass(frozen=True)
class Finding:
    """Something that is worth a look.

    check: the id of the check, one of `CHECKS`.
    path: the recording it is about; where several are, the first one.
    message: one sentence with numbers.
    suggestion: what to do about it.
    leaf: the leaf it is about, as its keys in the space lead to it (`state['arm']['angle'][0]`, `action`); None where
        it is about episodes or files.
    dimensions: indexes inside the leaf; empty where it is about the whole leaf, or the leaf is a scalar.
    count, total: how many values, steps or episodes (the message says which) are affected, and of how many.
    places: at most `MAX_PLACES` examples, the first ones.
    """

    check: str
    severity: Severity
    path: str
    message: str
    suggestion: str
    leaf: str | None = None
    dimensions: tuple[tuple[int, ...], ...] = ()
    count: int = 0
    total: int = 0
    places: tuple[Place, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The finding as a JSON-able object: its fields, with the name of the severity in lower case."""
        return {
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "severity": str(self.severity),
            "dimensions": [list(index) for index in self.dimensions],
            "places": [place._asdict() for place in self.places],
        }


@dataclass(frozen=True)
class Diagnosis:
    """The findings, worst first, then in the order of the recordings, the checks and the leaves.

    files, episodes, steps: what was examined; files that could not be read are among the findings ("unreadable").
    """

    findings: tuple[Finding, ...]
    files: int
    episodes: int
    steps: int

    @property
    def worst(self) -> Severity | None:
        """The worst severity there is; None without a finding."""
        return max((finding.severity for finding in self.findings), default=None)

    @property
    def healthy(self) -> bool:
        """True if there is no error and no warning."""
        return self.worst in (None, Severity.INFO)

    def at_least(self, severity: Severity) -> tuple[Finding, ...]:
        """The findings that are as bad as `severity`, or worse."""
        return tuple(finding for finding in self.findings if finding.severity >= severity)

    def of(self, check: str) -> tuple[Finding, ...]:
        """The findings of one check."""
        return tuple(finding for finding in self.findings if finding.check == check)

    def to_dict(self) -> dict[str, Any]:
        """The diagnosis as a JSON-able object. Keys are only added; a change of meaning changes `version`.

        `version` (1), `healthy`, `worst` ("info", "warning", "error" or null), `files`, `episodes`, `steps`, and
        `findings`, a list of objects with the keys of `Finding`; a place has `path`, `episode` and `step` (or null).
        """
        return {
            "version": JSON_VERSION,
            "healthy": self.healthy,
            "worst": None if self.worst is None else str(self.worst),
            "files": self.files,
            "episodes": self.episodes,
            "steps": self.steps,
            "findings": [finding.to_dict() for finding in self.findings],
        }
