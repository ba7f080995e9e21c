"""Recordings in a directory: finds their paths, publishes, deletes and restores episodes, and frees space."""

from __future__ import annotations

import contextlib
import errno
import stat
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.errors import FormatError, NotFoundError, RecordingError, StorageError
from tupli_mcap.journal.file import journal_info, recorded_journal
from tupli_mcap.mcap.lock import is_locked, writers_kept_out
from tupli_mcap.progress import progress
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.rewrite import rewrite_in_place
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.schema import EpisodeHeader, FilterEQ
from tupli_mcap.storage.atomic import Lock, os_errors
from tupli_mcap.storage.base import (
    LOCAL_USER,
    episode_id,
    is_episode_id,
    new_name,
    no_such,
    numbers_by_file,
    published_in,
    uuid_of,
)
from tupli_mcap.storage.files.sync import SyncedCatalog
from tupli_mcap.storage.listing import scan
from tupli_mcap.storage.sidecar import DELETING, Deletion, Notes, Sidecar, sidecar_path


class RecordingFiles:
    """The recordings below a storage's root, and changes of their episodes.

    Several processes may record, publish and delete at once. The next query of the catalog sees the changes.
    """

    def __init__(self, root: Path, lock: Lock, catalog: SyncedCatalog) -> None:
        self._root = root
        self._lock = lock
        self._catalog = catalog

    def new_path(self, benchmark_id: str, name: str) -> Path:
        """See `TupliStorage.new_recording_path`."""
        directory = self._root / "recordings" / benchmark_id
        with os_errors("cannot make the directory", directory):
            directory.mkdir(parents=True, exist_ok=True)
        return directory / new_name(name)

    def path(self, recording: str) -> Path:
        """See `FileStorage.recording_path`."""
        if not isinstance(recording, str):
            raise NotFoundError(
                f"expected the recording of an episode header, such as 'recordings/…/….mcap', found {recording!r:.80}"
            )
        path = self._root / recording
        relative = Path(recording)
        inside = recording.endswith(".mcap") and not relative.is_absolute() and ".." not in relative.parts
        if not inside or not _is_file(path):
            raise NotFoundError(f"there is no recording {recording[:200]!r} in {str(self._root)!r}")
        return path

    def refuse_live(self, benchmark_id: str) -> None:
        """Raises StorageError if somebody records episodes of a benchmark."""
        found = []
        for item in sorted(scan(self._root)):
            path = self._root / item.relative
            if is_locked(path):
                with contextlib.suppress(RecordingError, FormatError), Recording(path) as recording:
                    if recording.benchmark_id == benchmark_id:
                        found.append(str(path))
        if found:
            raise StorageError(
                f"benchmark {benchmark_id} is being recorded to {', '.join(found[:3])}: nothing is deleted; "
                "close that first, or keep the episodes"
            )

    def of_recording(self, path: Path) -> list[EpisodeHeader]:
        """The episodes of a recording that was just catalogued, without a query of the others."""
        wanted = FilterEQ(key="recording", value=path.relative_to(self._root).as_posix())
        return self._catalog.known(wanted) or self._catalog.headers(wanted)

    def header(self, uri: str) -> EpisodeHeader:
        """The header of an episode. NotFoundError if there is no such episode."""
        if is_episode_id(uri):
            # The catalog may be out of date, so only the place of the episode is taken from it.
            found = self._catalog.known(FilterEQ(key="id", value=uri), limit=1)
            if found and self._holds(found[0]):
                return found[0]
            found = self._catalog.headers(FilterEQ(key="id", value=uri), limit=1)
            if found:
                return found[0]
        raise no_such("episode", uri)

    def _holds(self, header: EpisodeHeader) -> bool:
        path = self._root / header.recording
        notes = Notes.read(path, self._root)
        with contextlib.suppress(RecordingError, FormatError):  # gone, or damaged
            metadata = metadata_at(path)
            return metadata["uuid"] == uuid_of(header) and header.episode not in notes.about(metadata).deleted
        return False

    def ingest(self, path: Path) -> None:
        """Catalogue one recording; a finished one without episodes is removed instead.

        Raises:
            StorageError: It is not below the root.
            FormatError: It is damaged.
        """
        try:
            place = path.parent.resolve() / path.name  # a link to a file elsewhere is below the root itself
            relative = place.relative_to(self._root.resolve()).as_posix()
        except ValueError as err:
            raise StorageError(
                f"expected a recording below {str(self._root)!r}, found {str(path)!r}"
            ) from err

        with self._lock:
            # without a step, or deleted in the meantime: the next query notices
            if path.exists() and self._catalog.put(relative) == 0:
                with (
                    contextlib.suppress(RecordingError),
                    writers_kept_out(path),
                    Recording(path) as recording,
                ):
                    if not len(recording):
                        self._remove(path)

    def publish(self, header: EpisodeHeader, group: str) -> None:
        with self._lock, _alone(path := self.path(header.recording)):
            if header.episode not in self._left(path, uuid_of(header)):  # not as the catalog was read
                raise NotFoundError(f"episode {header.id} was deleted or replaced by somebody else meanwhile")
            sidecar = Notes.read(path, self._root).about(metadata_at(path))
            groups = sidecar.published_in.get(header.episode, [LOCAL_USER])
            sidecar.published_in[header.episode] = published_in(groups, group)
            sidecar.write(path)  # the next query notices

    def delete(self, headers: Sequence[EpisodeHeader]) -> int:
        """Delete episodes, all or none; returns how many were still there."""
        return self.delete_numbers(numbers_by_file(headers))

    def delete_numbers(
        self, by_recording: Mapping[tuple[str, str], Collection[int]], *, dry_run: bool = False
    ) -> int:
        """See `TupliStorage.delete_numbers`; recordings are named by their paths below the root.

        A copy of a recording is another one: only the recordings that are named here lose episodes.
        """
        if dry_run:  # leaves no lock behind
            return sum(len(note.deleted) for note in self._doomed(by_recording).values())
        with self._lock:
            self._finish_deletion()
            doomed = self._doomed(by_recording)
            if len(doomed) > 1:
                Deletion(
                    deleted={relative: note.deleted for relative, note in doomed.items()},
                    uuids={relative: note.uuid for relative, note in doomed.items()},
                ).write(self._root)
            self._do_deletion(doomed)
        return sum(len(note.deleted) for note in doomed.values())

    def _doomed(self, by_recording: Mapping[tuple[str, str], Collection[int]]) -> dict[str, Sidecar]:
        """Those of the episodes that are still there, by path below the root."""
        doomed: dict[str, Sidecar] = {}
        for (relative, uuid), numbers in by_recording.items():
            with contextlib.suppress(NotFoundError):  # somebody else was first
                gone = self._left(self.path(relative), uuid).intersection(numbers)
                if gone:
                    doomed[relative] = Sidecar(uuid=uuid, deleted=gone)
        return doomed

    def deleted(self, only: Collection[str] | None = None) -> list[str]:
        """See `FileStorage.deleted_episodes`."""
        found = []
        for path in self._with_deleted(only):
            notes = Notes.read(path, self._root)
            with Recording(path) as recording:
                numbers = notes.about(recording.metadata).deleted & set(recording.index["episode"].tolist())
                found += [episode_id(recording.uuid, number) for number in sorted(numbers)]
        return found

    def restore(self, ids: Collection[str], only: Collection[str] | None = None) -> int:
        """See `FileStorage.restore_episodes`."""
        restored = 0
        if not self._with_deleted(only):  # leaves no lock behind
            return 0
        with self._lock:
            self._finish_deletion()
            for path in self._with_deleted(only):
                with _alone(path):
                    notes = Notes.read(path, self._root)
                    sidecar = notes.about(_metadata_of(path, notes.beside))
                    back = {n for n in sidecar.deleted if episode_id(sidecar.uuid, n) in ids}
                    if back:
                        sidecar.deleted -= back
                        sidecar.write(path)  # the next query notices
                        restored += len(back)
        return restored

    def _with_deleted(self, only: Collection[str] | None) -> list[Path]:
        """The paths of the recordings with notes of deleted episodes; of all recordings, or of the given ones, which
        may be hidden."""
        names = [item.relative for item in scan(self._root)] if only is None else only
        paths = (self._root / name for name in sorted(names))
        return [path for path in paths if _is_file(path) and Notes.read(path, self._root).deleted]

    def _finish_deletion(self) -> None:
        """Finish a deletion that was interrupted, if there is one; only recordings in its list are changed."""
        if not (self._root / DELETING).exists():
            return
        with self._lock:
            deletion = Deletion.read(self._root)
            listed = {item.relative for item in scan(self._root)}
            self._do_deletion(
                {relative: deletion.of(relative) for relative in deletion.deleted.keys() & listed}
            )

    def _do_deletion(self, deleted: Mapping[str, Sidecar]) -> None:
        for relative, note in deleted.items():
            path = self._root / relative
            metadata = _metadata_of(path, note)
            if not note.is_about(metadata):  # replaced since
                continue
            with _alone(path):
                sidecar = Notes.read(path, self._root).about(metadata)
                sidecar.deleted |= note.deleted
                # first the note: a crash, or a writer that goes on with the file, must not bring anything back
                sidecar.write(path)  # the next query notices
        Deletion().write(self._root)

    def _left(self, path: Path, uuid: str | None = None) -> set[int]:
        """The numbers of a recording's episodes that are not deleted; empty if it has another uuid than `uuid`."""
        notes = Notes.read(path, self._root)
        with Recording(path) as recording:
            if uuid not in (None, recording.uuid):
                return set()
            deleted = notes.about(recording.metadata).deleted
            return {int(number) for number in recording.index["episode"]} - deleted

    def remove_emptied(self, paths: Iterable[Path]) -> None:
        """Delete those of some recordings that have no episodes left, unless somebody is writing to them."""
        for path in paths:
            with contextlib.suppress(FormatError, RecordingError), writers_kept_out(path), _alone(path):
                if not self._left(path):
                    self._remove(path)

    def _remove(self, path: Path) -> int:
        """Delete a recording whose lock the caller holds; returns the bytes freed. The next query notices."""
        file, freed = path.resolve(), 0
        with os_errors("cannot delete the recording", path):
            for gone in (*_own_journal(file), file, sidecar_path(file), path):
                freed += gone.stat().st_size if gone.is_file() else 0
                gone.unlink(missing_ok=True)
        self.remove_directory(path.parent)
        return freed

    def remove_directory(self, directory: Path) -> None:
        """Remove the directory of a benchmark's recordings if it is empty and the benchmark is deleted.

        While the benchmark exists, somebody may be about to record to it.
        """
        if directory.parent != self._root / "recordings":
            return
        if not (self._root / "benchmarks" / f"{directory.name}.json").exists():
            with contextlib.suppress(OSError):  # not empty
                directory.rmdir()

    def compact(self, only: Collection[str] | None = None) -> int:
        """See `FileStorage.compact`."""
        freed = files.remove_left(files.left_below(self._root))
        self._finish_deletion()
        paths = self._with_deleted(only)
        with progress(len(paths), "compacting recordings") as bar:
            for path in paths:
                with self._lock:
                    freed += self._compact_unless_recorded(path)
                bar.advance(1)
        return freed

    def _compact_unless_recorded(self, path: Path) -> int:
        """Compacts a recording unless somebody is writing to it; returns the bytes freed."""
        try:
            with writers_kept_out(path), _alone(path):  # nobody appends, or restores, meanwhile
                return self._compact(path)
        except RecordingError:
            if path.exists() and not is_locked(path):
                raise
            return 0

    def _compact(self, path: Path) -> int:
        """Rewrites a recording whose lock the caller holds, or deletes it if no episode stays; returns the bytes freed.
        Of one that is not finished, the journal goes, since the new file has all its steps."""
        notes = Notes.read(path, self._root)
        before = path.stat().st_size
        with os_errors("cannot rewrite the recording", path), Recording(path) as recording:
            sidecar = notes.about(recording.metadata)
            kept = [n for n in recording.index["episode"].tolist() if n not in sidecar.deleted]
            if sidecar.deleted and not kept:
                return self._remove(path)
            if sidecar.deleted:
                journals = _own_journal(path)  # the new file does not say where it is
                rewrite_in_place(recording, path, kept)
                for journal in journals:
                    before += journal.stat().st_size
                    journal.unlink()
                groups = {n: sidecar.published_in[n] for n in kept if n in sidecar.published_in}
                sidecar = Sidecar(uuid=recording.uuid, published_in=groups)
        sidecar.write(path)
        return before - path.stat().st_size


def _alone(path: Path) -> AbstractContextManager[None]:
    """Keeps out all others who change the notes beside a recording. Those who know it by a directory above or below
    this root have another `.lock`, so all of them lock the recording's own directory, last."""
    return files.alone_in(sidecar_path(path).parent)


def _metadata_of(path: Path, note: Sidecar) -> Mapping[str, str]:
    """The metadata of a recording; of a damaged one, the UUID that a note about it has: a repair may need the note."""
    try:
        return metadata_at(path)
    except FormatError:
        return {"uuid": note.uuid}


def _own_journal(path: Path) -> list[Path]:
    """The journal of a recording, wherever it lies; none if there is none. One beside it may be of another recording,
    which was renamed without it; a copy of a recording names the journal of the original."""
    with contextlib.suppress(OSError, FormatError, RecordingError):
        metadata, file = metadata_at(path), str(path.resolve())
        place = recorded_journal(path, metadata)
        info = journal_info(place)
        if info.get("uuid") == metadata.get("uuid") and info.get("recording", file) == file:
            return [place]
    return []


def _is_file(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except ValueError:  # a NUL, or a surrogate that stands for no byte: no file has such a name
        return False
    except OSError as err:
        if err.errno in (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP):
            return False
        raise
