"""The catalog of a directory, updated with its recordings before each query."""

from __future__ import annotations

import contextlib
import errno
import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from sqlalchemy import Connection

from tupli_mcap.cache import cache_dir
from tupli_mcap.errors import FormatError, RecordingError, StorageError, warn
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.progress import progress
from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.database import CatalogDamagedError, CatalogMovedError, CatalogUnusableError
from tupli_mcap.storage.catalog.entries import Entry, entry_of
from tupli_mcap.storage.catalog.order import Sort
from tupli_mcap.storage.catalog.place import catalog_path
from tupli_mcap.storage.catalog.queries import find_episodes
from tupli_mcap.storage.listing import scan

_T = TypeVar("_T")
_ATTEMPTS = 100  # at a catalog that is deleted or replaced again and again

_TROUBLE = (CatalogMovedError, CatalogDamagedError, CatalogUnusableError)


class SyncedCatalog:
    """The catalog of the recordings below a storage's root. Several processes may query and record at once.

    The files alone count. Before each query the catalog is updated with files that have appeared, changed (by size,
    time stamps and inode) or gone; recordings that are being written are read anew each time. An episode that several
    files hold is listed once, for the file that was catalogued first (new files are catalogued in order of their
    paths): if one of them changes, all are read anew. The catalog is in this user's cache directory, or in memory: a
    query writes nothing below the root.
    """

    def __init__(self, root: Path, declared_keys: Iterable[str]) -> None:
        self._root = root
        self._declared_keys = list(declared_keys)
        self._opened: Catalog | None = None
        self._synced = -1  # identity of the catalog that is up to date
        self._undeclared = True  # its keys have yet to be declared
        self._warned: set[str] = set()
        self.skipped: dict[str, str] = {}
        """Recordings that the last query did not list, and why."""
        self.unreadable: dict[str, str] = {}
        """Those of them that it could not read."""

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
            self._opened = None

    def known(self, filter: BaseFilter | str, *, limit: int | None = None) -> list[EpisodeHeader]:
        """The episodes in the catalog, without an update; they may be out of date, or none."""
        with contextlib.suppress(*_TROUBLE):
            return self._catalog.episodes(filter, limit=limit)
        return []

    def headers(
        self,
        filter: BaseFilter | str | None,
        *,
        limit: int | None = None,
        offset: int = 0,
        sort: str | None = None,
    ) -> list[EpisodeHeader]:
        order = Sort.parse(sort or "")
        return self.ask(
            lambda connection: list(find_episodes(connection, filter, limit=limit, offset=offset, sort=order))
        )

    def ask(self, question: Callable[[Connection], _T]) -> _T:
        """The result of a function of a connection to the up-to-date catalog."""
        return self._with_usable_catalog(lambda: self._synced_answer(lambda: self._catalog.ask(question)))

    def declare_key(self, key: str) -> None:
        self._with_usable_catalog(lambda: self._catalog.declare_key(key))
        if key not in self._declared_keys:
            self._declared_keys.append(key)

    def reindex(self) -> None:
        """Empty the catalog and fill it from the files."""

        def make() -> None:
            with self._catalog.alone():  # nobody sees an incomplete catalog
                self._catalog.reset()
                self._warned.clear()
                self._synced_answer(lambda: None)

        self._with_usable_catalog(make)

    def put(self, relative: str) -> int:
        """Catalogue one recording; returns its number of episodes, -1 if it is not known yet.
        FormatError if it is damaged."""

        def put() -> int:
            alone = self._catalog.alone()
            with alone, contextlib.suppress(CatalogMovedError), entry_of(self._root, relative) as entry:
                self._catalog.forget_copies([relative])
                return self._put(relative, entry)
            return -1  # the next query fills the new catalog

        return self._with_usable_catalog(put)

    def _synced_answer(self, ask: Callable[[], _T]) -> _T:
        """Brings the catalog up to date with the files and queries it, again if somebody replaced it meanwhile."""
        for _ in range(_ATTEMPTS):
            with contextlib.suppress(CatalogMovedError):
                if self._sync_once():
                    found = ask()
                    if self._catalog.identity == self._synced and self._catalog.is_current():
                        return found
        raise StorageError(
            f"the catalog of {str(self._root)!r} was replaced during each of {_ATTEMPTS} attempts; try again later"
        )

    def _with_usable_catalog(self, work: Callable[[], _T]) -> _T:
        """The result of `work`; if the catalog fails, with a new one if it was damaged, else with one in memory."""
        try:
            try:
                return work()
            except CatalogDamagedError:
                self._catalog.reset()
                return work()
        except (CatalogDamagedError, CatalogUnusableError) as err:
            self._use_memory(err)
            return work()

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
        """An empty catalog, for the time before the first write makes the directory."""
        return Catalog(None)

    def _use_memory(self, err: StorageError) -> Catalog:
        """Go on with a catalog in memory, so that recordings can be listed even if nothing can be written."""
        advice = "TUPLI_MCAP_CACHE_DIR names another place; meanwhile the catalog is made in memory"
        warn(f"{err}; {advice}")
        self.close()
        self._opened = Catalog(None)
        return self._opened

    def _declare_keys(self) -> None:
        """Declares the keys in a catalog that was just opened, or made anew by any process.

        This comes after its rows are in it: to index all at once is faster than to add each.
        """
        if self._undeclared:
            for key in self._declared_keys:
                self._catalog.declare_key(key)
            self._undeclared = False

    def _sync_once(self) -> bool:
        """False if the catalog was replaced meanwhile."""
        self.skipped, self.unreadable = {}, {}  # the catalog does not hold them: each update finds them again
        if not self._changes():
            self._declare_keys()
            return True
        with self._catalog.alone():
            changes = self._changes()
            if self._catalog.forget_copies(changes):
                changes = self._changes()
            self._follow(changes)
            self._declare_keys()
            return self._catalog.identity == self._synced

    def _follow(self, changes: Mapping[str, Path | None]) -> None:
        """Applies changes of files to the catalog."""
        later = set(changes)
        with progress(len(changes), "Cataloguing recordings") as bar:
            for relative, path in changes.items():
                later.remove(relative)
                if path is None:
                    self._catalog.remove_recording(relative)
                else:
                    self._try_to_put(relative, later)
                bar.advance(1)

    def _changes(self) -> dict[str, Path | None]:
        """Recordings that are new or have changed, by path; None for those that are gone.

        The latter come first, so that a moved file does not count as a copy of itself; then those that have changed,
        since a copy of one is compared with the episodes that it has now.
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
        for item in sorted(listed, key=lambda item: item.relative not in catalogued):
            path = self._root / item.relative
            # A live writer's journal changes without a new time stamp.
            if catalogued.get(item.relative) != item.stamp or (item.journal and is_locked(path)):
                changes[item.relative] = path
        return changes

    def _try_to_put(self, relative: str, later: Collection[str]) -> None:
        """Catalogue a recording; one that cannot be read is skipped. `later`: what the catalog has of these is out of
        date."""
        try:
            with entry_of(self._root, relative) as entry:
                self._put(relative, entry, later)
        except FileNotFoundError:
            self._catalog.remove_recording(relative)
        except (FormatError, RecordingError, OSError) as err:
            if _is_exhausted(err):
                raise StorageError(f"cannot list the recordings below {str(self._root)!r}: {err}") from err
            self._catalog.remove_recording(relative)
            self.unreadable[relative] = str(err)
            self._skip(relative, str(err))

    def _skip(self, relative: str, why: str, what: str = "a recording") -> None:
        self.skipped[relative] = why
        if why not in self._warned:
            self._warned.add(why)
            warn(f"skipped {what}: {why}")

    def _put(self, relative: str, entry: Entry, later: Collection[str] = ()) -> int:
        """Catalogue the episodes of a recording that no other one lists; returns its number of episodes.
        A recording that has no such episode is left out."""
        listed = self._catalog.listed_elsewhere(relative, entry.uuid)
        moved = set(listed.values()).intersection(later)  # this file may have been there, and another is now
        for path in moved:
            self._catalog.remove_recording(path)
        listed = {number: path for number, path in listed.items() if path not in moved}
        if listed.keys().isdisjoint(entry.numbers):
            self._catalog.put_recording(relative, entry)
            return len(entry.numbers)
        rows = list(entry.rows)  # all of them, before another recording is left out because of them
        listed = self._without_parts(relative, {row.episode for row in rows}, listed)
        others = [row for row in rows if row.episode not in listed]
        again = [listed[row.episode] for row in rows if row.episode in listed]
        if again and not others:
            self._skip_copy(relative, again[0])
            return len(entry.numbers)
        self._catalog.put_recording(relative, entry._replace(rows=others))
        if again:
            told = f"{self._root / relative} holds episodes of {again[0]} again"
            warn(f"{told}; they are listed once, and the {len(others)} others too")
        return len(entry.numbers)

    def _without_parts(self, relative: str, numbers: set[int], listed: dict[int, str]) -> dict[int, str]:
        """The episodes that other recordings of the same UUID list, by number, without those of recordings that list
        only a part of this one's, such as filtered copies: these are skipped, as the largest one counts.

        numbers: of this one's episodes, without deleted ones, which hide none of another recording.
        """
        of_others: dict[str, set[int]] = {}
        for number, path in listed.items():
            of_others.setdefault(path, set()).add(number)
        gone = {path for path, theirs in of_others.items() if theirs < numbers}
        for path in sorted(gone):
            self._skip_copy(path, relative)
        return {number: path for number, path in listed.items() if path not in gone}

    def _skip_copy(self, relative: str, counted: str) -> None:
        """Leaves out a recording whose episodes are all listed of another one."""
        self._catalog.remove_recording(relative)
        told = f"{self._root / relative} holds episodes of {counted} again"
        self._skip(relative, f"{told}; only that recording is listed; move or delete one of them", "a copy")


def _is_exhausted(err: BaseException | None) -> bool:
    """Whether the process has too many open files or no memory, which is no fault of the recording."""
    while err is not None and not isinstance(err, OSError):
        err = err.__cause__
    return err is not None and err.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
