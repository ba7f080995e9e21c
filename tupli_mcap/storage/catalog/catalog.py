"""The catalog: an index of episodes in SQLite, which can always be rebuilt from the recordings."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeVar

from sqlalchemy import Connection, func, select

from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.database import Database, MemoryDatabase
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, of_one_recording
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.storage.texts import escape_text, unescape_text

_T = TypeVar("_T")


class Catalog:
    """The episodes of a storage's recordings, to be filtered without opening a file.

    Safe to use from several threads and several processes at once; usable in a forked child. Errors of SQLite
    become StorageErrors.
    """

    def __init__(self, path: Path | None) -> None:
        """Open or create the catalog at `path`; None makes one in memory, which is lost when it is closed.

        An empty catalog replaces a file that is no catalog, is of another version, or that somebody else could write.

        Raises:
            StorageError: The file cannot be opened or written.
        """
        self.path = path
        self._database = MemoryDatabase() if path is None else Database(path)
        self._finalizer = weakref.finalize(self, self._database.close)
        try:
            self._database.open()
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> int:
        """Tells the file of the last transaction from all others that were at its path."""
        return self._database.identity

    def is_current(self) -> bool:
        """Whether the file of the last transaction is still at its path."""
        return self._database.is_current()

    def alone(self) -> AbstractContextManager[None]:
        """The lock to hold while the catalog is brought up to date, so that nothing older replaces what is newer.
        CatalogUnusableError if the lock cannot be taken."""
        return self._database.alone()

    def close(self) -> None:
        """Release the file; closing twice is fine."""
        self._finalizer()

    def __enter__(self) -> Catalog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def reset(self) -> None:
        """Empty the catalog, even a damaged one; declared keys are forgotten too."""
        self._database.replace()

    def recordings(self) -> dict[str, RecordingStamp]:
        """The catalogued recordings: path relative to the storage -> stamp of the file."""
        columns = (RECORDING.c.path, *(RECORDING.c[name] for name in RecordingStamp._fields))
        with self._read() as connection:
            rows = connection.execute(select(*columns).order_by(RECORDING.c.path))
            return {unescape_text(path): RecordingStamp(*stamp) for path, *stamp in rows}

    def listed_elsewhere(self, relpath: str, uuid: str) -> dict[int, str]:
        """The numbers of the episodes that other recordings of the same UUID list, and the paths of those."""
        listed = select(EPISODE.c.episode, RECORDING.c.path).join(RECORDING, of_one_recording())
        others = RECORDING.c.uuid == uuid, RECORDING.c.path != escape_text(relpath)
        with self._read() as connection:
            return {number: unescape_text(path) for number, path in connection.execute(listed.where(*others))}

    def forget_copies(self, relpaths: Collection[str]) -> bool:
        """Removes the recordings that have the UUID of another one, if one of them is among the given ones; each may
        hold episodes that the catalog lists of another. Returns whether there were some."""
        if not relpaths:
            return False
        uuids = select(RECORDING.c.uuid).group_by(RECORDING.c.uuid).having(func.count() > 1)
        copies = select(RECORDING.c.uuid, RECORDING.c.path).where(RECORDING.c.uuid.in_(uuids))
        with self._read() as connection:
            found = [(uuid, unescape_text(path)) for uuid, path in connection.execute(copies)]
        changed = {uuid for uuid, path in found if path in relpaths}
        for uuid, path in found:
            if uuid in changed:
                self.remove_recording(path)
        return bool(changed)

    def put_recording(self, relpath: str, entry: Entry) -> None:
        """Catalogue a recording, see `queries.put_recording`. Its rows are consumed a chunk at a time while the catalog
        is locked for other writers.
        StorageError if two rows have one episode number, or SQLite refuses."""
        remaining = iter(entry.rows)
        first = list(itertools.islice(remaining, queries.ROWS_AT_ONCE))  # read before the lock is taken
        with self._write() as connection:
            rows = itertools.chain(first, remaining)
            queries.put_recording(connection, relpath, entry._replace(rows=rows))

    def remove_recording(self, relpath: str) -> None:
        """See `queries.remove_recording`."""
        with self._write() as connection:
            queries.remove_recording(connection, relpath)

    def episodes(
        self, filter: BaseFilter | str | None = None, *, limit: int | None = None, offset: int = 0
    ) -> list[EpisodeHeader]:
        """See `queries.find_episodes`."""
        with self._read() as connection:
            return list(queries.find_episodes(connection, filter, limit=limit, offset=offset))

    def count(self, filter: BaseFilter | str | None = None) -> int:
        """See `queries.count_episodes`."""
        with self._read() as connection:
            return queries.count_episodes(connection, filter)

    def ask(self, question: Callable[[Connection], _T]) -> _T:
        """The result of a function of a connection, such as those of `queries`, called in one transaction."""
        with self._read() as connection:
            return question(connection)

    def explain(self, filter: BaseFilter | str | None) -> str:
        """See `queries.plan_of`."""
        with self._read() as connection:
            return queries.plan_of(connection, filter)

    def declare_key(self, key: str) -> None:
        """See `queries.declare_key`."""
        with self._write() as connection:
            queries.declare_key(connection, key)

    def _read(self) -> AbstractContextManager[Connection]:
        return self._database.transaction()

    def _write(self) -> AbstractContextManager[Connection]:
        return self._database.transaction(write=True)
