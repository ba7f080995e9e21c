"""`Library`: all that a server keeps, and the changes that touch its database and its files at once."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from sqlalchemy import select

from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter
from tupli_mcap.server import episodes
from tupli_mcap.server.blobs import DirectoryBlobs
from tupli_mcap.server.database import Database
from tupli_mcap.server.items import Items, artifact_key
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.access import Caller
from tupli_mcap.server.people.throttle import Throttle
from tupli_mcap.server.people.tokens import Tokens
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FILE, ITEM, MEMBERSHIP, USER
from tupli_mcap.server.uploads import Upload, Uploads
from tupli_mcap.storage.texts import escape_text

__all__ = ["Library"]

_ADMIN = "admin"
_PASSWORD_VARIABLE = "TUPLI_MCAP_ADMIN_PASSWORD"


class Library:
    """What a server keeps. Usable from any thread.

    Raises:
        StorageError: the directory or the database cannot be used.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        settings.own.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.database = Database(settings.database or f"sqlite:///{settings.own / 'server.sqlite'}")
        self.blobs = DirectoryBlobs(settings.directory)
        self.items = Items(self.blobs)
        self.tokens = Tokens(settings)
        self.throttle = Throttle()
        self.uploads = Uploads(settings.own / "uploads")
        with self.database.writing() as connection:
            accounts.prepare(connection)
        self.uploads.forget_old()

    def first_password(self) -> str | None:
        """Makes the user `admin` where there is none; returns the password if nobody has chosen it."""
        with self.database.writing() as connection:
            if connection.execute(select(USER.c.name)).first():
                return None
            chosen = os.environ.get(_PASSWORD_VARIABLE)
            password = chosen or secrets.token_urlsafe(12)
            accounts.create_user(connection, _ADMIN, password)
            connection.execute(MEMBERSHIP.insert().values(user=_ADMIN, team="global", role=_ADMIN))
        return None if chosen else password

    def take_in(self, caller: Caller, upload: Upload) -> str:
        """Stores a recording that was uploaded as a whole; returns its name.

        Raises:
            StorageError: its bytes are not those that were announced, or it is no recording, or has no episodes.
        """
        self.uploads.verify(upload)
        with self.database.reading() as connection:
            known = episodes.stored_already(connection, caller, upload.digest)
        if known is not None:
            self.uploads.forget(upload)
            return known
        try:
            with Recording(upload.path) as recording:
                if not recording.complete:
                    raise FormatError(
                        "expected a finished recording; close or recover it, then send it again"
                    )
                name = episodes.new_name(recording.benchmark_id)
                self.blobs.take(name, upload.path)
                try:
                    with self.database.writing() as connection:
                        replaced = episodes.register(connection, caller, recording, name, upload.digest)
                except BaseException:
                    self.blobs.delete(name)
                    raise
        finally:
            self.uploads.forget(upload)
        self.sweep(replaced)
        return name

    def delete_episodes(self, caller: Caller, filter: BaseFilter) -> int:
        """Deletes episodes, and files of which none is left; returns how many episodes."""
        with self.database.writing() as connection:
            count, empty = episodes.delete_episodes(connection, caller, filter)
        self.sweep(empty)
        return count

    def delete_artifact(self, caller: Caller, uri: str, *, force: bool) -> None:
        """Deletes an artifact, and its bytes if nobody else has it."""
        with self.database.writing() as connection:
            self.items.delete_artifact(connection, caller, uri, force=force)
        self.sweep([artifact_key(uri)])

    def sweep(self, names: list[str]) -> None:
        """Deletes files that nothing in the database names, while nobody adds any."""
        for name in names:
            with self.database.writing() as connection:
                uri = name.removeprefix("artifacts/")
                files = select(FILE.c.path).where(FILE.c.path == escape_text(name))
                items = select(ITEM.c.number).where(ITEM.c.kind == "artifact", ITEM.c.id == uri)
                if not connection.execute(files).first() and not connection.execute(items).first():
                    self.blobs.delete(name)

    def path_of(self, name: str) -> Path:
        """The file of a recording, or of an artifact."""
        path = Path(self.blobs.place(name))
        if not path.is_file():
            raise StorageError(f"the server has lost {name}; restore it from a backup")
        return path

    def close(self) -> None:
        """Close the database."""
        self.database.close()
