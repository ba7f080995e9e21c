"""The recordings of files and directories, whether a storage or not; nothing is written."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.errors import RecordingError, TupliError, os_reason
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.recording import Recording
from tupli_mcap.recording.description import spread_of, state_of
from tupli_mcap.recording.recover.prefix import metadata_at
from tupli_mcap.storage.scan import scan
from tupli_mcap.storage.sidecar import Notes

__all__ = ["Compactable", "ListedRecording", "compactable", "find_recordings", "list_recordings"]


class ListedRecording(NamedTuple):
    """A recording without its deleted episodes; `error` says why there is nothing else.

    return_mean: over the episodes that are left, None if there are none; without the `return_nan` whose return is
        NaN, and NaN itself where that is so of all. size: bytes of the file.
    state: "complete", "recording" (a writer is at work) or "recovered" (a writer did not finish).
    """

    path: str
    episodes: int = 0
    steps: int = 0
    return_mean: float | None = None
    return_nan: int = 0
    size: int = 0
    created_ns: int = 0
    benchmark_id: str = ""
    state: str = ""
    error: str | None = None


class Compactable(NamedTuple):
    """A recording (its path below the storage) with how many deleted episodes, and its size (bytes)."""

    recording: str
    deleted: int
    size: int


def find_recordings(path: Path) -> list[Path]:
    """A file itself, or the recordings (`.mcap`) below a directory, sorted.

    Raises:
        RecordingError: there is no such file or directory, or the directory cannot be read.
    """
    if path.is_dir():
        try:
            return [path / item.relative for item in sorted(scan(path))]
        except OSError as err:
            raise RecordingError(f"{path} cannot be read: {os_reason(err)}") from err
    if not path.exists():
        raise RecordingError(f"{path} does not exist; give a recording (.mcap) or a directory of them")
    return [path]


def list_recordings(paths: Iterable[Path]) -> Iterator[ListedRecording]:
    """The recordings of files and directories; one that cannot be read is listed with its error."""
    for path in paths:
        try:
            found = find_recordings(path)
        except TupliError as err:
            yield ListedRecording(str(path), error=str(err))
            continue
        for file in found:
            yield _listed(file, path if path.is_dir() else None)


def compactable(root: Path) -> list[Compactable]:
    """The recordings of a storage that `FileStorage.compact` would rewrite.

    Raises:
        FormatError: a recording with deleted episodes is damaged, or what is noted beside it.
    """
    found = []
    for item in sorted(scan(root)):
        path = root / item.relative
        notes = Notes.read(path, root)
        if notes.deleted and not is_locked(path):
            with contextlib.suppress(RecordingError):  # gone meanwhile
                deleted = notes.about(metadata_at(path)).deleted
                if deleted:
                    found.append(Compactable(item.relative, len(deleted), item.stamp.size))
    return found


def _listed(path: Path, root: Path | None) -> ListedRecording:
    try:
        notes = Notes.read(path, root)
        with Recording(path) as recording:
            deleted = notes.about(recording.metadata).deleted
            rows = recording.index
            if deleted:
                rows = rows[[int(number) not in deleted for number in rows["episode"]]]
            returns = spread_of(rows["return"])
            return ListedRecording(
                path=str(path),
                episodes=len(rows),
                steps=int(rows["length"].sum()),
                return_mean=None if returns is None else returns.mean,
                return_nan=0 if returns is None else returns.nan,
                size=path.stat().st_size,
                created_ns=recording.created_ns,
                benchmark_id=recording.benchmark_id,
                state=state_of(recording),
            )
    except (TupliError, OSError) as err:
        return ListedRecording(str(path), error=str(err))
