"""The result of `examine`: a diagnosis, and its findings; and the words of their messages."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.leaves import Leaf

MAX_PLACES = 5  # most examples that a finding names
JSON_VERSION = 1
_NAMED = 4  # dimensions that a message names
_LISTED = 100  # dimensions that a finding lists


class Severity(enum.IntEnum):
    """How bad a finding is.

    ERROR: the data is wrong; training on it fails or learns nonsense (NaN, values outside a Discrete space).
    WARNING: the data is probably wrong, or needs care in training (a dimension that never changes).
    INFO: worth knowing, and usual in healthy data too (all episodes end by timeout).
    """

    INFO = 1
    WARNING = 2
    ERROR = 3

    def __str__(self) -> str:
        return self.name.lower()


class Place(NamedTuple):
    """The place of a finding: recording, number of the episode, step in it (from 0).

    step: None for a whole episode; the episode's length for its final state.
    """

    path: str
    episode: int
    step: int | None = None

    def __str__(self) -> str:
        return f"episode {self.episode}" if self.step is None else f"episode {self.episode} step {self.step}"


@dataclass(frozen=True)
class Finding:
    """What a check found in a recording.

    check: the id of the check, one of `CHECKS`.
    path: the recording; the first one, if several are affected.
    message: one sentence with numbers.
    suggestion: what to do about it.
    leaf: the name of the affected leaf (`state.arm.angle[0]`, `action`), or the camera of recorded frames
        (`camera 'render'`); None for findings about episodes or files.
    dimensions: the affected indexes inside the leaf; empty for the whole leaf, and for a scalar.
    count, total: how many values, steps or episodes (the message says which) are affected, and of how many.
    places: the first examples, at most `MAX_PLACES`.
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
        """The fields as values for JSON; the severity is its name in lower case."""
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
        """The worst severity of the findings; None without findings."""
        return max((finding.severity for finding in self.findings), default=None)

    @property
    def healthy(self) -> bool:
        """Whether there is neither an error nor a warning."""
        return self.worst in (None, Severity.INFO)

    def at_least(self, severity: Severity) -> tuple[Finding, ...]:
        """The findings of this severity, and worse ones."""
        return tuple(finding for finding in self.findings if finding.severity >= severity)

    def of(self, check: str) -> tuple[Finding, ...]:
        """The findings of one check."""
        return tuple(finding for finding in self.findings if finding.check == check)

    def to_dict(self) -> dict[str, Any]:
        """The diagnosis as values for JSON. `version` changes when a key goes away or changes its meaning.

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


# ---- numbers, times and dimensions in messages


def share(count: int, total: int) -> str:
    """A part in percent: `12%`, `0.3%`, `<0.1%`."""
    percent = 100 * count / total if total else 0.0
    if 0 < percent < 0.1:
        return "<0.1%"
    if percent < 10 or 99 < percent < 100:
        return f"{math.floor(10 * percent) / 10:g}%"
    return f"{percent:.0f}%"


def duration(ns: float) -> str:
    """A duration (ns) in a fitting unit: `850 ns`, `1.5 ms`, `2.0 h`."""
    for unit, size in (("h", 3600e9), ("min", 60e9), ("s", 1e9), ("ms", 1e6), ("µs", 1e3)):
        if ns >= size:
            return f"{ns / size:.1f} {unit}"
    return f"{ns:.0f} ns"


def unravel(leaf: Leaf, mask: Array) -> tuple[tuple[int, ...], ...]:
    """The indexes of the elements of a leaf in a mask (C order), at most 100; empty for a scalar or for all."""
    if leaf.shape == () or mask.all():
        return ()
    indexes = np.argwhere(mask.reshape(leaf.shape))[:_LISTED]
    return tuple(tuple(index) for index in indexes.tolist())


def dimensions(leaf: Leaf, mask: Array) -> str:
    """`state[3]`, `3 of 17 dimensions (state[0], state[4], state[5])`; empty for a scalar or for all."""
    indexes, count = unravel(leaf, mask), int(mask.sum())
    if not indexes:
        return ""
    names = [name_within(leaf.path, index) for index in indexes[:_NAMED]]
    if count == 1:
        return names[0]
    more = ", ..." if count > _NAMED else ""
    return f"{count:,} of {leaf.size:,} dimensions ({', '.join(names)}{more})"


def dimension_text(leaf: Leaf, mask: Array) -> str:
    """The same after ` in `; empty for a scalar or for all."""
    text = dimensions(leaf, mask)
    return f" in {text}" if text else ""
