"""Recordings and episodes of files and directories, whether a storage or not; nothing is written."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.errors import RecordingError, TupliError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe import state_of
from tupli_mcap.recording.lock import is_locked
from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.storage.catalog import Catalog
from tupli_mcap.storage.entries import catalog_rows
from tupli_mcap.storage.scan import scan, stamp_of
from tupli_mcap.storage.sidecar import Sidecar

__all__ = ["ListedRecording", "file_episodes", "find_recordings", "is_storage", "list_recordings"]


class ListedRecording(NamedTuple):
    """A recording without its deleted episodes; `error` says why there is nothing else.

    return_mean: over all episodes that are left, None if there are none. size: bytes of the file.
    state: "complete", "recording" (a writer is at work) or "recovered" (a writer was killed).
    """

    path: str
    episodes: int = 0
    steps: int = 0
    return_mean: float | None = None
    size: int = 0
    created_ns: int = 0
    benchmark_id: str = ""
    state: str = ""
    error: str | None = None


def is_storage(path: Path) -> bool:
    """Whether a directory was made by a FileStorage."""
    return any((path / name).exists() for name in ("catalog.sqlite", "benchmarks", "storage.json"))


def find_recordings(path: Path) -> list[Path]:
    """A file itself, or the recordings (`.mcap`) below a directory, sorted.

    Raises:
        RecordingError: there is no such file or directory.
    """
    if path.is_dir():
        return [path / item.relative for item in sorted(scan(path))]
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
            yield _listed(file)


def file_episodes(
    path: Path, filter: BaseFilter | None = None, *, limit: int | None = None
) -> list[EpisodeHeader]:
    """The episodes of one recording that a filter is true of, by number; the meaning is that of a storage.

    Raises:
        FormatError: it is no recording, or damaged.
        FilterError: the filter names an unknown key.
    """
    with Recording(path) as recording, Catalog(None) as catalog:
        catalog.put_recording(
            path.name,
            stamp_of(path),
            uuid=recording.uuid,
            benchmark_id=recording.benchmark_id,
            rows=catalog_rows(recording, Sidecar.read(path), live=is_locked(path)),
        )
        return catalog.episodes(filter, limit=limit)


def _listed(path: Path) -> ListedRecording:
    try:
        deleted = list(Sidecar.read(path).deleted)
        with Recording(path) as recording:
            rows = recording.index
            if deleted:
                rows = rows[[int(number) not in deleted for number in rows["episode"]]]
            return ListedRecording(
                path=str(path),
                episodes=len(rows),
                steps=int(rows["length"].sum()),
                return_mean=float(rows["return"].mean()) if len(rows) else None,
                size=path.stat().st_size,
                created_ns=recording.created_ns,
                benchmark_id=recording.benchmark_id,
                state=state_of(recording),
            )
    except (TupliError, OSError) as err:
        return ListedRecording(str(path), error=str(err))
