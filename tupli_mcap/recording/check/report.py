"""The problems that verification finds, each with its place and what to do about it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

_MOST = 1000  # problems of a file that are kept, the first error among them; others are counted
RECOVER = "save what is good with tupli-mcap recover"


@dataclass(frozen=True)
class Problem:
    """Something found in a file.

    Attributes:
        kind: "file", "record", "chunk", "message_index", "attachment", "metadata", "summary", "index", "layout",
            "rows", "episode", "final_state", "info", "image", "frame", "benchmark", "signature", "journal", or one of
            a storage's.
        severity: "error" if the file is damaged; "note" if it is not.
        offset: in the file (bytes).
        channel: a topic.
        episode, step: numbers.
        follows: other damage in the file explains it.
    """

    kind: str
    message: str
    severity: str = "error"
    advice: str = RECOVER
    offset: int | None = None
    channel: str | None = None
    episode: int | None = None
    step: int | None = None
    follows: bool = False

    @property
    def place(self) -> str:
        """The place, for people; empty for the whole file."""
        parts = [
            f"{name} {value}"
            for name, value in (
                ("offset", self.offset),
                ("channel", self.channel),
                ("episode", self.episode),
                ("step", self.step),
            )
            if value is not None
        ]
        return ", ".join(parts)


@dataclass
class VerifyReport:
    """The result of verifying a file: counts of what was checked, and the problems.

    Attributes:
        kind: "recording" or "storage".
        state: "complete", "unfinished" (its writer was killed) or "recording" (a writer works on it).
        size: of the file (bytes).
        chunks, messages, episodes, steps, attachments: how many were checked; of a storage, `attachments` are its
            artifacts, and the others are 0.
        signed_by: the fingerprint of the key whose signature fits, and the name this user gave it if they trust it;
            empty if the file is not signed.
        more: number of problems beyond the first thousand.
    """

    path: str
    kind: str = "recording"
    state: str = "complete"
    size: int = 0
    chunks: int = 0
    messages: int = 0
    episodes: int = 0
    steps: int = 0
    attachments: int = 0
    signed_by: str = ""
    problems: list[Problem] = field(default_factory=list)
    more: int = 0

    @property
    def errors(self) -> list[Problem]:
        """The problems that are damage."""
        return [problem for problem in self.problems if problem.severity == "error"]

    @property
    def ok(self) -> bool:
        """Whether there is no damage."""
        return not self.errors

    def to_json(self) -> dict[str, Any]:
        """The report as a JSON value."""
        return {**asdict(self), "ok": self.ok}


class Findings:
    """Adds problems to a report; errors that begin with the `name` of the file lose it."""

    def __init__(self, report: VerifyReport, name: str | None = None) -> None:
        self.report = report
        self._prefix = f"{name or report.path}: "
        self._explained = False

    @contextlib.contextmanager
    def following(self, explained: bool) -> Iterator[None]:
        """Marks damage that is found within as following from earlier damage, if `explained`."""
        before, self._explained = self._explained, self._explained or explained
        try:
            yield
        finally:
            self._explained = before

    def error(self, kind: str, message: str, **place: Any) -> None:
        """Adds damage; `place` are fields of `Problem`."""
        self._add(Problem(kind, message.removeprefix(self._prefix), follows=self._explained, **place))

    def note(self, kind: str, message: str, advice: str, **place: Any) -> None:
        """Adds something that is no damage."""
        self._add(Problem(kind, message, "note", advice, **place))

    def _add(self, problem: Problem) -> None:
        problems = self.report.problems
        if len(problems) < _MOST:
            problems.append(problem)
            return
        self.report.more += 1
        if problem.severity == "error" and self.report.ok:  # notes must not hide that there is damage
            problems[-1] = problem

    def __len__(self) -> int:
        return len(self.report.errors) + self.report.more
