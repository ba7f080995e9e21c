"""Recordings in a directory, and the catalog that follows them."""

from __future__ import annotations

import contextlib
import datetime
import errno
import functools
import re
import secrets
import stat
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from sqlalchemy import Connection

from tupli_mcap import files
from tupli_mcap.errors import FormatError, NotFoundError, RecordingError, StorageError
from tupli_mcap.mcap.lock import is_locked, writers_kept_out
from tupli_mcap.progress import progress
from tupli_mcap.recording import Recording, journal_path, rewrite_recording
from tupli_mcap.recording.recover.prefix import metadata_at
from tupli_mcap.schema import BaseFilter, EpisodeHeader, FilterEQ
from tupli_mcap.storage.atomic import Lock, os_errors
from tupli_mcap.storage.base import LOCAL_USER, published_in
from tupli_mcap.storage.catalog.catalog import (
    Catalog,
    CatalogDamagedError,
    CatalogMovedError,
    CatalogUnusableError,
    RecordingStamp,
)
from tupli_mcap.storage.catalog.entries import Entry, entry_of, read_ahead
from tupli_mcap.storage.catalog.place import cache_dir, catalog_path
from tupli_mcap.storage.listing import LIVE, scan, stamp_of
from tupli_mcap.storage.sidecar import Deletion, Notes, Sidecar, sidecar_path

__all__ = ["RecordingFiles", "episode_id"]

_ATTEMPTS = 100  # at a catalog that is deleted or replaced again and again
_RESTLESS = f"the catalog of {{!r}} was replaced during each of {_ATTEMPTS} attempts; try again later"
_TROUBLE = (CatalogMovedError, CatalogDamagedError, CatalogUnusableError)
_OLD_CATALOG = [f"catalog.sqlite{end}" for end in ("", "-wal", "-shm", "-journal", ".lock", ".new")]
_T = TypeVar("_T")
_EPISODE_ID = re.compile(r"([0-9a-f]{32})-(0|[1-9][0-9]{0,9})\Z")


class RecordingFiles:
    """The recordings below a storage's root. Several processes may record, query and delete at once.

    The files are the truth. Before each query the catalog is brought up to date with those that have
    appeared, changed (by size, time stamps and inode) or gone; recordings that are being written are read anew each
    time. The catalog lies in this user's cache directory, or in memory: a query writes nothing below the root.
    """

    def __init__(self, root: Path, lock: Lock, declared_keys: Iterable[str]) -> None:
        self._root = root
        self._lock = lock
        self._declared_keys = list(declared_keys)
        self._opened: Catalog | None = None
        self._synced = -1  # the catalog that has been brought up to date
        self._undeclared = True  # its keys are still to be declared
        self._warned: set[tuple[str, RecordingStamp]] = set()
        self.skipped: dict[str, str] = {}
        """Recordings that are not listed, and why, as of the last query."""

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    # --- queries ---

    def of_recording(self, path: Path) -> list[EpisodeHeader]:
        """The episodes of a recording that has just been ingested, without a look at the others."""
        wanted = FilterEQ(key="recording", value=path.relative_to(self._root).as_posix())
        with contextlib.suppress(*_TROUBLE):
            headers = self._catalog.episodes(wanted)
            if headers:
                return headers
        return self.headers(wanted)

    def headers(
        self, filter: BaseFilter | None, *, limit: int | None = None, offset: int = 0
    ) -> list[EpisodeHeader]:
        return self._settled(lambda: self._catalog.episodes(filter, limit=limit, offset=offset))

    def count(self, filter: BaseFilter | None) -> int:
        return self._settled(lambda: self._catalog.count(filter))

    def ask(self, question: Callable[[Connection], _T]) -> _T:
        """What a question finds in the tables of the catalog, which is up to date."""
        return self._settled(lambda: self._catalog.ask(question))

    def _settled(self, ask: Callable[[], _T]) -> _T:
        """Asks a catalog that is up to date, again if somebody has replaced it meanwhile."""

        def settle() -> _T:
            for _ in range(_ATTEMPTS):
                self._sync()
                with contextlib.suppress(CatalogMovedError):
                    found = ask()
                    if self._catalog.identity == self._synced and self._catalog.is_current():
                        return found
            raise StorageError(_RESTLESS.format(str(self._root)))

        return self._with_usable_catalog(settle)

    def _with_usable_catalog(self, work: Callable[[], _T]) -> _T:
        """What `work` returns, done again where the catalog fails: with a new one if it is damaged, then in memory."""
        try:
            try:
                return work()
            except CatalogDamagedError:
                self._catalog.reset()
                return work()
        except (CatalogDamagedError, CatalogUnusableError) as err:
            self._use_memory(err)
            return work()

    def explain(self, filter: BaseFilter | None) -> str:
        def ask() -> str:
            self._declare_keys()
            return self._catalog.explain(filter)

        return self._with_usable_catalog(ask)

    def declare_key(self, key: str) -> None:
        self._with_usable_catalog(lambda: self._catalog.declare_key(key))
        if key not in self._declared_keys:
            self._declared_keys.append(key)

    def header(self, uri: str) -> EpisodeHeader:
        """The header of an episode.

        Raises:
            NotFoundError: There is no such episode.
        """
        match = _EPISODE_ID.match(uri) if isinstance(uri, str) else None
        if match:
            # What the catalog knows already may be out of date in all but where the episode is.
            found = []
            with contextlib.suppress(*_TROUBLE):
                found = self._catalog.episodes(FilterEQ(key="id", value=uri), limit=1)
            if found and self._holds(found[0]):
                return found[0]
            found = self.headers(FilterEQ(key="id", value=uri), limit=1)
            if found:
                return found[0]
        raise NotFoundError(f"there is no episode with id {str(uri)[:80]!r}; list_episodes() names them all")

    def _holds(self, header: EpisodeHeader) -> bool:
        path = self._root / header.recording
        notes = Notes.read(path, self._root)
        with contextlib.suppress(RecordingError, FormatError):  # gone, or damaged
            metadata = metadata_at(path)
            return metadata["uuid"] == _uuid(header) and header.episode not in notes.about(metadata).deleted
        return False

    # --- files ---

    def new_path(self, benchmark_id: str, name: str) -> Path:
        """A path below the benchmark's directory that nobody else is given: time (UTC), name and random digits."""
        directory = self._root / "recordings" / benchmark_id
        with os_errors("cannot make the directory", directory):
            directory.mkdir(parents=True, exist_ok=True)
        now = datetime.datetime.now(datetime.UTC)
        named = f"{files.as_file_name(name)}-" if name else ""
        return directory / f"{now:%Y%m%dT%H%M%S}-{named}{secrets.token_hex(6)}.mcap"

    def path(self, recording: str) -> Path:
        """The file of a catalogued recording.

        Raises:
            NotFoundError: It is not one, or not below the root.
        """
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

    # --- the catalog ---

    @property
    def _catalog(self) -> Catalog:
        if self._opened is None:
            if not self._root.is_dir():
                return self._empty
            try:
                with os_errors("no catalog can be kept in", cache_dir()):
                    path = catalog_path(self._root)
                self._opened = Catalog(path)
            except StorageError as err:
                return self._use_memory(err)
        return self._opened

    @functools.cached_property
    def _empty(self) -> Catalog:
        """What is listed before the first write makes the directory: nothing."""
        return Catalog(None)

    def _use_memory(self, err: StorageError) -> Catalog:
        """Go on with a catalog in memory: what is recorded can be listed even where nothing can be written."""
        advice = "TUPLI_MCAP_CACHE_DIR names another place; meanwhile the catalog is made in memory"
        warnings.warn(f"{err}; {advice}", stacklevel=7)
        self.close()
        self._opened = Catalog(None)
        return self._opened

    def _declare_keys(self) -> None:
        """Declares the keys in a catalog that was opened or made anew, perhaps by another process.

        Done once its rows are in it: making an index of them is quicker than adding each to one.
        """
        if self._undeclared:
            for key in self._declared_keys:
                self._catalog.declare_key(key)
            self._undeclared = False

    def reindex(self) -> None:
        """Empty the catalog and fill it from the files."""

        def make() -> None:
            with self._catalog.alone():  # nobody sees half of it
                self._catalog.reset()
                self._warned.clear()
                self._sync()

        self._with_usable_catalog(make)

    def ingest(self, path: Path) -> None:
        """Catalogue one recording; a finished one without episodes is removed instead.

        Raises:
            StorageError: It is not below the root.
            FormatError: It is damaged.
        """
        try:
            relative = path.resolve().relative_to(self._root.resolve()).as_posix()
        except ValueError as err:
            raise StorageError(
                f"expected a recording below {str(self._root)!r}, found {str(path)!r}"
            ) from err

        def put() -> int:
            alone = self._catalog.alone()
            with alone, contextlib.suppress(CatalogMovedError), entry_of(self._root, relative) as entry:
                return self._put(relative, entry)
            return -1  # the next query fills the new one

        with self._lock:
            # without a step, or deleted since: the next query notices
            if path.exists() and self._with_usable_catalog(put) == 0:
                self._remove(path)

    def _sync(self) -> None:
        """Bring the catalog up to date with the files."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(CatalogMovedError):
                if self._sync_once():
                    return
        raise StorageError(_RESTLESS.format(str(self._root)))

    def _sync_once(self) -> bool:
        """False if the catalog was replaced meanwhile."""
        self.skipped = {}  # they are no part of the catalog, and so are met again
        if not self._changes():
            self._declare_keys()
            return True
        with self._catalog.alone():
            self._follow(self._changes())
            self._declare_keys()
            return self._catalog.identity == self._synced

    def _follow(self, changes: Mapping[str, Path | None]) -> None:
        """Brings what has changed into the catalog."""
        present = [relative for relative, path in changes.items() if path is not None]
        with (
            progress(len(changes), "Cataloguing recordings") as bar,
            contextlib.closing(read_ahead(self._root, present)) as entries,
        ):
            for relative, path in changes.items():
                if path is None:
                    self._catalog.remove_recording(relative)
                else:
                    self._try_to_put(relative, next(entries))
                bar.advance(1)

    def _changes(self) -> dict[str, Path | None]:
        """Recordings that the catalog does not know as they are; None for those that are gone.

        The latter come first: a file that was moved is no copy of itself.
        """
        catalogued = self._catalog.recordings()
        if self._catalog.identity != self._synced:
            self._synced = self._catalog.identity
            self._undeclared = True
        if catalogued:
            self._declare_keys()
        with os_errors("cannot list the recordings below", self._root):
            listed = sorted(scan(self._root))
        changes: dict[str, Path | None] = dict.fromkeys(
            catalogued.keys() - {item.relative for item in listed}
        )
        for item in listed:
            path = self._root / item.relative
            # What a live writer's journal holds is in no time stamp.
            if catalogued.get(item.relative) != item.stamp or (item.journal and is_locked(path)):
                changes[item.relative] = path
        return changes

    def _try_to_put(self, relative: str, entry: Entry | None) -> None:
        """Catalogue a recording by its entry, or else read it here."""
        stamp = RecordingStamp(0, 0, 0)
        try:
            if entry is None:
                stamp = stamp_of(self._root, relative)
                with entry_of(self._root, relative) as entry:
                    self._put(relative, entry)
            else:
                self._put(relative, entry)
        except FileNotFoundError:
            self._catalog.remove_recording(relative)
        except (FormatError, RecordingError, OSError) as err:
            if _is_exhausted(err):
                raise StorageError(f"cannot list the recordings below {str(self._root)!r}: {err}") from err
            self._catalog.remove_recording(relative)
            self._skip(relative, stamp, str(err))

    def _skip(self, relative: str, stamp: RecordingStamp, why: str) -> None:
        self.skipped[relative] = why
        if (relative, stamp) not in self._warned:
            self._warned.add((relative, stamp))
            warnings.warn(f"skipped a recording: {why}", stacklevel=6)

    def _put(self, relative: str, entry: Entry) -> int:
        """Catalogue a recording unless it is a copy; returns how many episodes it holds."""
        if not self._is_copy(relative, entry):
            self._catalog.put_recording(
                relative,
                entry.stamp._replace(mixed=LIVE) if entry.live else entry.stamp,
                uuid=entry.uuid,
                benchmark_id=entry.benchmark_id,
                runs=entry.runs,
                rows=entry.rows,
            )
        return len(entry.numbers)

    def _is_copy(self, relative: str, entry: Entry) -> bool:
        """Whether another recording holds the first or the last episode of this one, which then is left out."""
        if not self._catalog.copies(relative, entry.uuid):
            return False
        for number in {*entry.numbers[:1], *entry.numbers[-1:]}:
            for header in self._catalog.episodes(FilterEQ(key="id", value=episode_id(entry.uuid, number))):
                if header.recording != relative:
                    self._catalog.remove_recording(relative)
                    path, original = self._root / relative, f"holds episodes of {header.recording} again"
                    advice = "that one is listed, whatever they hold; verify both, and delete one"
                    self._skip(relative, entry.stamp, f"{path} {original}; {advice}")
                    return True
        return False

    # --- changes ---

    def publish(self, header: EpisodeHeader, group: str) -> None:
        with self._lock:
            path = self.path(header.recording)
            sidecar = Notes.read(path, self._root).about(metadata_at(path))
            if sidecar.uuid != _uuid(header):
                raise NotFoundError(f"episode {header.id} was replaced by somebody else meanwhile")
            groups = sidecar.published_in.get(header.episode, [LOCAL_USER])
            sidecar.published_in[header.episode] = published_in(groups, group)
            sidecar.write(path)  # the next query notices

    def delete(self, headers: Sequence[EpisodeHeader]) -> int:
        """Delete episodes, all of them or none: by notes beside their recordings, or with these where nothing else is
        left in them.

        Returns how many there still were.
        """
        by_recording: dict[tuple[str, str], set[int]] = {}
        for header in headers:
            by_recording.setdefault((header.recording, _uuid(header)), set()).add(header.episode)
        with self._lock:
            self._finish_deletion()
            doomed: dict[str, Sidecar] = {}
            for (relative, uuid), numbers in by_recording.items():
                with contextlib.suppress(NotFoundError):  # somebody else was first
                    left = self._left(self.path(relative), uuid) & numbers
                    if left:
                        doomed[relative] = Sidecar(uuid=uuid, deleted=left)
            if len(doomed) > 1:
                Deletion(
                    deleted={relative: note.deleted for relative, note in doomed.items()},
                    uuids={relative: note.uuid for relative, note in doomed.items()},
                ).write(self._root)
            self._do_deletion(doomed)
        return sum(len(note.deleted) for note in doomed.values())

    def deleted(self) -> list[str]:
        """The ids of the episodes that are deleted and still in their recordings."""
        found = []
        for item in sorted(scan(self._root)):
            notes = Notes.read(self._root / item.relative, self._root)
            if notes.deleted:
                with Recording(self._root / item.relative) as recording:
                    numbers = notes.about(recording.metadata).deleted & set(
                        recording.index["episode"].tolist()
                    )
                    found += [episode_id(recording.uuid, number) for number in sorted(numbers)]
        return found

    def restore(self, ids: Collection[str]) -> int:
        """Take back what is noted of deleted episodes; returns how many there were."""
        restored = 0
        with self._lock:
            self._finish_deletion()
            for item in sorted(scan(self._root)):
                path = self._root / item.relative
                notes = Notes.read(path, self._root)
                if notes.deleted:
                    sidecar = notes.about(metadata_at(path))
                    back = {n for n in sidecar.deleted if episode_id(sidecar.uuid, n) in ids}
                    if back:
                        sidecar.deleted -= back
                        sidecar.write(path)  # the next query notices
                        restored += len(back)
        return restored

    def _finish_deletion(self) -> None:
        """Do what is left of a deletion that was broken off; only recordings that are listed are touched."""
        deletion = Deletion.read(self._root)
        if deletion.deleted:
            listed = {item.relative for item in scan(self._root)}
            self._do_deletion(
                {relative: deletion.of(relative) for relative in deletion.deleted.keys() & listed}
            )

    def _do_deletion(self, deleted: Mapping[str, Sidecar]) -> None:
        for relative, note in deleted.items():
            path = self._root / relative
            try:
                metadata = metadata_at(path)
            except FormatError:  # no more is known of it; a repair may need its note
                metadata = {"uuid": note.uuid}
            if not note.is_about(metadata):  # replaced since
                continue
            sidecar = Notes.read(path, self._root).about(metadata)
            sidecar.deleted |= note.deleted
            # first the note: a crash, or a writer that goes on with the file, must not bring anything back
            sidecar.write(path)  # the next query notices
            with contextlib.suppress(FormatError, RecordingError):  # damaged: its note is enough
                if not self._left(path):
                    self._remove(path)
        Deletion().write(self._root)

    def _left(self, path: Path, uuid: str | None = None) -> set[int]:
        """The numbers of the episodes of a recording that are not deleted; none of another one than that of `uuid`."""
        notes = Notes.read(path, self._root)
        with Recording(path) as recording:
            if uuid not in (None, recording.uuid):
                return set()
            deleted = notes.about(recording.metadata).deleted
            return {int(number) for number in recording.index["episode"]} - deleted

    def _remove(self, path: Path) -> None:
        """Delete a recording, unless somebody is writing to it; the next query notices."""
        try:
            with writers_kept_out(path), os_errors("cannot delete the recording", path):
                if self._left(path):  # somebody has written to it meanwhile
                    return
                for gone in (path, journal_path(path), sidecar_path(path)):
                    gone.unlink(missing_ok=True)
        except RecordingError:
            return
        self.remove_directory(path.parent)

    def remove_directory(self, directory: Path) -> None:
        """Remove the directory of a benchmark's recordings if it is empty and the benchmark gone.

        While there is one, somebody may be about to record to it.
        """
        if directory.parent != self._root / "recordings":
            return
        if not (self._root / "benchmarks" / f"{directory.name}.json").exists():
            with contextlib.suppress(OSError):  # not empty
                directory.rmdir()

    def live(self, benchmark_id: str) -> list[Path]:
        """The recordings of a benchmark that are being written."""
        found = []
        for item in sorted(scan(self._root)):
            path = self._root / item.relative
            if is_locked(path):
                with contextlib.suppress(RecordingError, FormatError), Recording(path) as recording:
                    if recording.benchmark_id == benchmark_id:
                        found.append(path)
        return found

    def compact(self) -> int:
        """Rewrite the recordings that hold deleted episodes, and remove the temporary files of killed processes;
        returns how many bytes that freed.

        Those that are being written are left alone. Episodes that stay keep their ids.
        """
        freed = files.remove_left(files.left_below(self._root))
        with self._lock:
            self._finish_deletion()
        for name in _OLD_CATALOG:  # earlier versions kept it here; it is opened no more
            with contextlib.suppress(OSError):
                (self._root / name).unlink()
        for item in sorted(scan(self._root)):
            path = self._root / item.relative
            with self._lock:
                if not path.exists() or not Notes.read(path, self._root).deleted:
                    continue
                try:
                    with writers_kept_out(path):  # nobody appends meanwhile
                        freed += self._compact(path)
                except RecordingError:
                    if path.exists() and not is_locked(path):
                        raise
                    continue
                self.ingest(path)
        return freed

    def _compact(self, path: Path) -> int:
        notes = Notes.read(path, self._root)
        before = path.stat().st_size
        with os_errors("cannot rewrite the recording", path), Recording(path) as recording:
            sidecar = notes.about(recording.metadata)
            if sidecar.deleted:
                kept = [int(n) for n in recording.index["episode"] if int(n) not in sidecar.deleted]
                rewrite_recording(recording, path, episodes=kept)
                journal_path(path).unlink(missing_ok=True)
                groups = {n: sidecar.published_in[n] for n in kept if n in sidecar.published_in}
                sidecar = Sidecar(uuid=recording.uuid, published_in=groups)
        sidecar.write(path)
        return before - path.stat().st_size


def _is_file(path: Path) -> bool:
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except OSError as err:
        if err.errno in (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP):
            return False
        raise


def _is_exhausted(err: BaseException | None) -> bool:
    """Whether the process has too many open files or no memory: no fault of the recording that met it."""
    while err is not None and not isinstance(err, OSError):
        err = err.__cause__
    return err is not None and err.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM)


def episode_id(uuid: str, episode: int) -> str:
    """The id of an episode: its recording's UUID and its number."""
    return f"{uuid}-{episode}"


def _uuid(header: EpisodeHeader) -> str:
    """The UUID of an episode's recording."""
    return header.id.rpartition("-")[0]
