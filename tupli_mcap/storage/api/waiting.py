"""The files of recordings that wait for a server: their state, how to finish those of killed processes, and the note of
how many episodes of a growing one were sent."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

from tupli_mcap.errors import FormatError, RecordingError, warn
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import has_summary
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.recording import Recording, finish_recording, journal_path, recover_recording

__all__ = ["finished", "note", "numbers_of", "sent_before", "state_of"]


def state_of(path: Path) -> str:
    """`recording` while somebody writes to it, else `finished` or `unfinished`."""
    with contextlib.suppress(RecordingError, FormatError):  # where it is gone on with at this moment
        source = PathSource(path)
        try:
            if has_summary(source):
                return "finished"
        finally:
            source.close()
    return "recording" if is_locked(path) else "unfinished"


def numbers_of(recording: Recording, first: int) -> list[int]:
    """The numbers of the episodes from `first` on."""
    return sorted(number for number in recording.index["episode"].tolist() if number >= first)


def finished(path: Path) -> Path:
    """Finishes the recording of a killed process; returns the path of the file to send.

    Raises:
        RecordingError, FormatError: nothing of it can be saved.
    """
    try:
        finish_recording(path)
        return path
    except (RecordingError, FormatError) as err:
        if is_locked(path):  # another process is at it
            return path
        report = recover_recording(path, overwrite=True)
        if report.target is None or not report.saved:
            raise RecordingError(f"{path}: nothing of it can be saved; delete it") from err
    saved, damaged = Path(report.target), path.parents[1] / "damaged" / path.parent.name
    damaged.mkdir(parents=True, exist_ok=True, mode=0o700)
    moved = {note(path): note(saved)} | {each: damaged / each.name for each in (journal_path(path), path)}
    for each, goal in moved.items():
        with contextlib.suppress(FileNotFoundError):
            each.replace(goal)
    told = f"{path} was damaged: what could be saved of it is sent, the original is kept in {damaged}"
    warn(told, RuntimeWarning)
    return saved


def note(path: Path) -> Path:
    """The path of the note of how many episodes of a recording were sent."""
    return path.with_name(f"{path.name}.sent")


def sent_before(path: Path) -> int:
    """The first episode of a recording that was not sent yet."""
    try:
        return int(json.loads(note(path).read_bytes())["sent_before"])
    except (OSError, ValueError, KeyError, TypeError):
        return 0
