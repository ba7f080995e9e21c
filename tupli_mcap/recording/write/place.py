"""Where a recording and its journal lie, and what other writers have left there."""

from __future__ import annotations

import contextlib
import os
import uuid
from pathlib import Path

from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.journal.file import is_journal_of, journal_aside, journal_in, journal_info, journal_path
from tupli_mcap.recording.recover.evidence import metadata_at


class RecordingPlace:
    """Which recording is written, and where.

    Attributes:
        file: its path, absolute: the process may change its directory before the journal is made.
        journal: the path of its journal, which is not there before the first step.
        uuid: of the recording.
        rewritten: which rewriting of that recording it is; empty if there was none.
        replaces: the recording that this one takes the place of with its first step; empty if there is none.
        replaced: the recording whose journal a writer that was killed has left in this one's place; empty if none has.
    """

    def __init__(self, path: str | os.PathLike[str], journal_dir: str | os.PathLike[str] | None) -> None:
        self.file = Path(os.path.realpath(path))
        self.uuid = uuid.uuid4().hex
        self.journal = (
            journal_path(self.file)
            if journal_dir is None
            else journal_in(os.path.realpath(journal_dir), self.file, self.uuid)
        )
        self.rewritten = self.replaces = self.replaced = ""
        self._of_killed: Path | None = None  # a journal that a writer of this recording may have left

    def begin(self, *, replaces: bool) -> None:
        """For a new recording: looks at what is there, and removes journals whose files are gone.

        `replaces`: it takes the place of the recording that is there.
        """
        there = _metadata_of(self.file) if replaces else {}
        self.replaces = there.get("uuid", "")
        self._remove_left(there.get("replaced", ""))
        self._remove_unstarted(self.replaces)
        if any(is_journal_of(place, self.replaces) for place in self._beside(self.replaces)):
            self.replaced = self.replaces

    def go_on(self) -> None:
        """For a recording that is appended to, of which `uuid`, `journal` and `replaced` are known by now."""
        self._of_killed = self.journal
        self.remove_replaced()
        self._remove_unstarted(self.uuid)

    def identity(self) -> dict[str, str]:
        """Which recording the journal belongs to, as it says itself."""
        facts = {"uuid": self.uuid, "rewritten": self.rewritten, "replaces": self.replaces}
        beside = self.journal.parent == self.file.parent
        return {key: fact for key, fact in facts.items() if fact} | (
            {} if beside else {"recording": str(self.file)}
        )

    def remove_replaced(self) -> None:
        """Removes the journal of the recording that was here."""
        self._remove_left(self.replaced)

    def remove_of_killed(self) -> None:
        """Removes what a killed writer of this recording left of its journal, and of one that was not in its place."""
        if self._of_killed is not None:
            _remove_of(self._of_killed, self.uuid)
            _remove_unnamed(self._of_killed)

    def remove_unnamed(self) -> None:
        """Removes a journal that was not in its place yet."""
        _remove_unnamed(self.journal)

    def _remove_left(self, uuid: str) -> None:
        for place in self._beside(uuid):
            _remove_of(place, uuid)

    def _beside(self, uuid: str) -> tuple[Path, Path]:
        """Where a recording that was at this path may have left its journal."""
        place = journal_path(self.file)
        return place, journal_aside(place, uuid)

    def _remove_unstarted(self, uuid: str) -> None:
        """Removes the journal of a recording that was to replace that of `uuid`, if it is there: it never had a
        step."""
        place = journal_path(self.file)
        with contextlib.suppress(OSError, FormatError):
            if uuid and journal_info(place).get("replaces") == uuid:
                place.unlink()


def _remove_of(place: Path, uuid: str) -> None:
    with contextlib.suppress(OSError):
        if is_journal_of(place, uuid):
            place.unlink()


def _remove_unnamed(place: Path) -> None:
    with contextlib.suppress(OSError):
        place.with_name(f"{place.name}.tmp").unlink()


def _metadata_of(path: Path) -> dict[str, str]:
    """The metadata of a recording that is there; empty if there is none."""
    if path.is_file():
        with contextlib.suppress(RecordingError, FormatError):
            return metadata_at(path)
    return {}
