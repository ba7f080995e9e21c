"""The recordings below a directory, and what their files look like; cheap, as each query needs it."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.journal.file import journal_name
from tupli_mcap.storage.sidecar import DELETING, Deletion, sidecar_path

__all__ = ["FoundRecording", "RecordingStamp", "scan", "stamp_of"]


class RecordingStamp(NamedTuple):
    """What a recording's file and its sidecar looked like when they were catalogued.

    size (bytes), mtime_ns: of the recording. mixed: a hash of what else tells both files from others.
    """

    size: int
    mtime_ns: int
    mixed: int


class FoundRecording(NamedTuple):
    """A recording: its path below the root (with forward slashes), its stamp, whether it has a journal."""

    relative: str
    stamp: RecordingStamp
    journal: bool


def scan(root: Path) -> Iterator[FoundRecording]:
    """Every recording below a directory; what is hidden is passed over, and so are links to directories.

    Raises:
        FormatError: What is noted there about a deletion is damaged.
    """
    pending = [(os.fspath(root), "")]
    deleting = Deletion()
    while pending:
        directory, prefix = pending.pop()
        try:
            with os.scandir(directory) as entries:
                found = {entry.name: entry for entry in entries if not entry.name.startswith(".")}
        except FileNotFoundError:
            continue  # deleted since it was listed
        if not prefix and DELETING in found:
            deleting = Deletion.read(root)
        for name, entry in found.items():
            if name.endswith(".mcap"):
                try:
                    if entry.is_file():
                        journal = journal_name(name) in found
                        stamp = _stamp(entry, found, deleting.stamp(prefix + name))
                        yield FoundRecording(prefix + name, stamp, journal)
                except OSError as err:
                    if err.errno not in (errno.ENOENT, errno.ELOOP):  # deleted since, or a link in a circle
                        raise
            elif entry.is_dir(follow_symlinks=False):
                pending.append((entry.path, f"{prefix}{name}/"))


def stamp_of(root: Path, relative: str) -> RecordingStamp:
    """The stamp of one recording below a directory; FileNotFoundError if it is gone."""
    deleting = Deletion.read(root).stamp(relative)
    path = root / relative
    status = path.stat()
    try:
        return _mix(status, sidecar_path(path).stat(), deleting)
    except FileNotFoundError:
        return _mix(status, None, deleting)


def _stamp(
    entry: os.DirEntry[str], found: dict[str, os.DirEntry[str]], deleting: Sequence[int]
) -> RecordingStamp:
    beside = found.get(f"{entry.name}.json")
    # Not `beside.stat()`: what scandir knows of a file may be older than its name.
    return _mix(os.stat(entry.path), None if beside is None else os.stat(beside.path), deleting)  # noqa: PTH116


def _mix(status: os.stat_result, beside: os.stat_result | None, deleting: Sequence[int]) -> RecordingStamp:
    # A clock ticks every few ms only, and archives set the times of their files: neither inodes nor times of change
    # repeat where a file is replaced.
    facts = [
        (found.st_ino, found.st_ctime_ns, found.st_size) for found in (status, beside) if found is not None
    ]
    return RecordingStamp(status.st_size, status.st_mtime_ns, hash((*facts, *deleting)) & (2**63 - 1))
