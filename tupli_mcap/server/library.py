"""`Library`: the data of a server, and the changes that touch its database and its files at once."""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, select

from tupli_mcap.environment import sha256
from tupli_mcap.errors import FormatError, NotFoundError, StorageError, TupliError, warn
from tupli_mcap.recording import Recording
from tupli_mcap.schema import (
    ArtifactMetadata,
    ArtifactMetadataItem,
    BaseFilter,
    BenchmarkQuery,
    Episode,
    EpisodeHeader,
    EpisodeItem,
    FilterEQ,
    Right,
)
from tupli_mcap.server.blobs import blobs_of, lost, open_stored
from tupli_mcap.server.database import (
    Database,
    UnavailableError,
    audit,
    demand_pending,
    pend,
    pending,
    settle,
)
from tupli_mcap.server.people import accounts, limits
from tupli_mcap.server.people.access import Caller, DeniedError
from tupli_mcap.server.people.tokens import SignInError, Tokens
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.stored import arrivals, episodes
from tupli_mcap.server.stored.items import Items, artifact_key
from tupli_mcap.server.tables import FILE, ITEM, MEMBERSHIP, USER
from tupli_mcap.server.uploads import Incoming, Upload, Uploads
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.atomic import os_errors
from tupli_mcap.storage.base import with_tuples
from tupli_mcap.storage.from_values import write_episodes
from tupli_mcap.storage.listing import is_storage, scan
from tupli_mcap.storage.sidecar import Notes
from tupli_mcap.storage.texts import escape_text, unescape_text

_ADMIN = "admin"
_PASSWORD_VARIABLE = "TUPLI_MCAP_ADMIN_PASSWORD"
_MOST_OF_A_USER, _MOST_OF_AN_ADDRESS = 10, 100  # failures a minute
_MOST_SIGN_UPS = 60  # a minute from an address


class Library:
    """The data of a server: database and files. Thread-safe. StorageError if they cannot be used, RecordingError if the
    URL of the bucket is not valid, MissingExtraError without obstore."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        with os_errors("cannot use the directory", settings.own):
            settings.own.mkdir(parents=True, exist_ok=True, mode=0o700)
            settings.making.mkdir(exist_ok=True)
        self.database = Database(settings.database_place, settings.query_seconds)
        self.blobs = blobs_of(settings)
        self.items = Items(settings)
        self.tokens = Tokens(settings)
        self.uploads = Uploads(settings.own / "uploads")
        with self.database.writing() as connection:
            accounts.prepare(connection)
        self.look_after()

    def first_password(self) -> str | None:
        """Creates the user `admin` if there is none; returns its password if that is a random one."""
        with self.database.writing() as connection:
            if connection.execute(select(USER.c.name)).first():
                return None
            chosen = os.environ.get(_PASSWORD_VARIABLE)
            password = chosen or secrets.token_urlsafe(12)
            hashed = accounts.hash_password(password, self.settings.min_password)
            accounts.create_user(connection, _ADMIN, hashed)
            connection.execute(MEMBERSHIP.insert().values(user=_ADMIN, team="global", role=_ADMIN))
        return None if chosen else password

    def adopt(self) -> int:
        """Catalogs a `FileStorage` in the directory as the admin's; returns the number of new recordings. Files stay
        where they are. Changes there while the server runs are noticed at its next start. What was deleted from the
        server stays deleted, although the directory still describes it."""
        with self.database.reading() as connection:
            admin = accounts.caller_named(connection, _ADMIN)
            gone = self.items.deleted_of(connection, _ADMIN)
        if admin is None or self.settings.blobs or not is_storage(self.settings.directory):
            return 0
        if self.settings.next_database.exists():
            return 0  # what an interrupted backup has left is of other users
        with FileStorage(self.settings.directory) as storage:
            for item in storage.list_artifacts():
                with _or_skipped():
                    if item.id not in gone:
                        told = ArtifactMetadata.model_validate(item.model_dump())
                        self.store_artifact(admin, storage.load_artifact(item.id), told)
            for header in storage.list_benchmarks():
                with _or_skipped(), self.database.writing() as connection:
                    if header.id not in gone:
                        found = storage.load_benchmark(header.id)
                        query = BenchmarkQuery(
                            hash=found.hash, serialized=found.serialized, metadata=found.stored_metadata
                        )
                        self.items.store_benchmark(connection, admin, query)
        there = sorted(scan(self.settings.directory))
        # Asked afterwards: what another process of the server stores meanwhile is known before it is there.
        with self.database.reading() as connection:
            coming = set(pending(connection, seconds=0))
            sizes = {row.place: row.size for row in connection.execute(select(FILE.c.place, FILE.c.size))}
        new = [
            item.relative
            for item in there
            if not item.relative.startswith(f"{self.settings.own.name}/")
            and sizes.get(escape_text(item.relative)) != item.stamp.size
            and item.relative not in coming
        ]
        return sum(self._adopt(admin, name) for name in new)

    def _adopt(self, admin: Caller, name: str) -> bool:
        """Catalogs a recording of the directory; returns whether it could. Unfinished ones are skipped."""
        path = self.settings.directory / name
        try:
            name.encode()  # addresses and JSON are in UTF-8
            with Recording(path) as recording, path.open("rb") as file:
                if not recording.complete or not len(recording):
                    return False
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                deleted = Notes.read(path, self.settings.directory).about(recording.metadata).deleted
                with self.database.writing() as connection:
                    arrivals.register(connection, admin, recording, name, digest, deleted=deleted)
        except (TupliError, OSError) as err:
            warn(f"not served: {err}")
            return False
        except UnicodeEncodeError:
            warn(f"not served: {name!r}: expected a name in UTF-8; rename it")
            return False
        return True

    def sign_in(self, username: str, password: str, address: str) -> dict[str, Any]:
        """Tokens for a user, see `Tokens.pair`. SignInError for a wrong name or password, TooManyError if it was wrong
        too often."""
        # Failures are counted by user and address: failures at another address must not lock the user out.
        most = {f"{username[:80]} at {address}": _MOST_OF_A_USER, address: _MOST_OF_AN_ADDRESS}
        with self.database.reading() as connection:
            limits.demand_few_failures(connection, most)
            epoch = accounts.epoch_of(connection, username)
            right = accounts.verify_password(connection, username, password)
        with self.database.writing() as connection:
            limits.note_attempt(connection, most, failed=not right)
            if right:
                return self.tokens.pair(connection, username, epoch=epoch)
        raise SignInError("Incorrect username or password")

    def create_user(self, caller: Caller, name: str, password: str, address: str) -> None:
        """Creates a user. DeniedError unless the caller has the right to, or everybody may sign up; TooManyError if
        there were too many from this address. Raises as `accounts.hash_password` and `accounts.create_user` do."""
        if not caller.may(Right.USER_CREATE):
            if not self.settings.open_signup:
                raise DeniedError(
                    "an admin creates the users of this server (or --open-signup lets everybody)"
                )
            most = {f"sign-up at {address}": _MOST_SIGN_UPS}
            with self.database.writing() as connection:
                limits.note_attempt(connection, most, failed=True)
        hashed = accounts.hash_password(password, self.settings.min_password)
        with self.database.writing() as connection:
            accounts.create_user(connection, name, hashed)
            audit(connection, name if caller.is_guest else caller.name, "create_user", name)

    def change_password(self, caller: Caller, name: str, password: str, *, old: str | None) -> None:
        """Changes a user's password, and ends all sign-ins and tokens of the user. old: to be checked before.

        Raises:
            DeniedError: `old` is not the password; or it is another user, and the caller lacks the right, or a right of
                theirs.
            SignInError: the password has been changed meanwhile.
            TooManyError: it was wrong too often.
            StorageError: the new one is not valid.
            NotFoundError: there is no such user.
        """
        caller.demand(Right.USER_UPDATE, name)
        # Failures are counted by sign-in: who has got hold of one must not keep the user from changing the password.
        most = {f"{name} by {caller.sign_in}": _MOST_OF_A_USER}
        with self.database.reading() as connection:
            accounts.demand_over(connection, caller, name)
            limits.demand_few_failures(connection, most)
            right = old is None or accounts.verify_password(connection, name, old)
        hashed = accounts.hash_password(password, self.settings.min_password) if right else ""
        with self.database.writing() as connection:
            limits.note_attempt(connection, most, failed=not right)
            if right:
                accounts.demand_over(connection, caller, name)
                if name == caller.name and accounts.epoch_of(connection, name) != caller.epoch:
                    raise SignInError("the password was changed at the same time; sign in again")
                accounts.change_password(connection, name, hashed)
                audit(connection, caller.name, "change_password", name)
        if not right:
            raise DeniedError("the old password is not right; nothing was changed")

    def begin_upload(self, caller: Caller, length: int, digest: str, sent_before: int) -> Upload | str:
        """A new upload, or the caller's unfinished upload of the same bytes; the name of the recording if the caller
        has stored it already. FullError if the caller's quota is used up."""
        with self.database.writing() as connection:
            known = arrivals.stored_already(connection, caller, digest)
            if known is not None:
                return known
            most = self.settings.max_uploads
            found = self.uploads.begin(connection, caller, length, digest, sent_before=sent_before, most=most)
            limits.demand_room(connection, self.settings, caller, 0)  # the upload is counted already
        return found

    def take_in(self, caller: Caller, incoming: Incoming, file: str = "") -> str:
        """Stores a recording whose upload is complete; returns its name. If the server fails, the upload stays.

        file: the name of the caller's file, which becomes part of the recording's name.

        Raises:
            ChecksumError: its bytes do not have the announced SHA-256.
            GoneError: it was given up, or its user deleted, while the last bytes arrived.
            FormatError: it is no finished recording, or it is damaged.
            StorageError: it has no episodes.
        """
        upload = incoming.upload
        try:
            incoming.verify()
            with self.database.reading() as connection:
                self.uploads.find(connection, caller, upload.id)
                known = arrivals.stored_already(connection, caller, upload.digest)
            if known is None:
                name = self._keep(
                    caller,
                    upload.path,
                    upload.digest,
                    file=file,
                    sent_before=upload.sent_before,
                    upload=upload.id,
                )
                upload.drop()
                return name
        except UnavailableError:
            raise
        except TupliError:
            self.forget_upload(upload)
            raise
        self.forget_upload(upload)
        return known

    def forget_upload(self, upload: Upload) -> None:
        with self.database.writing() as connection:
            self.uploads.forget(connection, upload)
        upload.drop()

    def record(self, caller: Caller, episode: Episode) -> str:
        """Stores an episode that was built by hand as a recording; returns its name.

        Raises:
            NotFoundError: its benchmark is not stored, or the caller may not read it.
            SpaceError: its values have no space.
            StorageError: it has no tuples.
        """
        if not episode.tuples:
            raise StorageError("an episode needs at least one tuple, found none")
        with self.database.reading() as connection:
            benchmark = self.items.load_benchmark(connection, caller, episode.benchmark_id)
        with tempfile.TemporaryDirectory(dir=self.settings.making) as folder:
            path = Path(folder) / "episode.mcap"
            write_episodes(path, [episode], benchmark)
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            return self._keep(caller, path, digest, room=path.stat().st_size)

    def _keep(
        self,
        caller: Caller,
        path: Path,
        digest: str,
        *,
        file: str = "",
        sent_before: int = 0,
        room: int = 0,
        upload: str = "",
    ) -> str:
        """Moves a recording to the blobs, and catalogs its episodes; returns its name.

        room: the bytes for which the caller's quota needs room; that of an upload is counted already. upload: that by
        which it has come, which ends as it is stored, but for its file; GoneError if there is no such upload of the
        caller any more.
        """
        with _unnamed(path):
            arrivals.demand_finished(path)
        with _unnamed(path), Recording(path) as recording:
            arrivals.demand_short(recording)
            arrivals.demand_undamaged(recording)
            with self.database.writing() as connection:
                if room:
                    limits.demand_room(connection, self.settings, caller, room)
                # before it becomes part of a path: an id in a file may hold anything
                arrivals.demand_benchmark(connection, caller, recording.benchmark_id)
                place = arrivals.new_place(recording.benchmark_id, file)
                pend(connection, place)
            try:
                self.blobs.keep(place, path)
                with self.database.writing() as connection:
                    demand_pending(connection, place)
                    if upload:
                        self.uploads.forget(connection, self.uploads.find(connection, caller, upload))
                    if room:  # once more: what the user has sent at the same time may have taken it
                        limits.demand_room(connection, self.settings, caller, room)
                    name, replaced = arrivals.register(
                        connection, caller, recording, place, digest, sent_before=sent_before
                    )
            except BaseException:
                self.sweep([place])
                raise
        self.sweep(replaced)
        return name

    def with_tuples(self, headers: Sequence[EpisodeHeader]) -> Iterator[EpisodeItem]:
        """Episodes of the catalog with their tuples."""

        def opened(name: str, _: Sequence[int]) -> Recording:
            with self.database.reading() as connection:
                found = select(FILE.c.place).where(FILE.c.path == escape_text(name))
                place = connection.execute(found).scalar()
            if place is None:
                raise NotFoundError(f"there is no recording {name[:200]!r}")
            return open_stored(self.blobs, unescape_text(place), name)

        return with_tuples(headers, opened)

    def delete_episodes(self, caller: Caller, filter: BaseFilter, *, dry_run: bool = False) -> int:
        """Deletes episodes, and files without any episode left; returns the number of episodes."""
        if dry_run:
            with self.database.reading() as connection:
                return len(episodes.deletable(connection, caller, filter))
        with self.database.writing() as connection:
            count, empty = episodes.delete_episodes(connection, caller, filter)
        self.sweep(empty)
        return count

    def delete_benchmark(self, caller: Caller, uri: str, *, with_episodes: bool) -> int:
        """Deletes a benchmark, and `with_episodes` also the caller's episodes of it; returns how many episodes."""
        own = FilterEQ(key="benchmark_id", value=uri) & FilterEQ(key="created_by", value=caller.name)
        with self.database.writing() as connection:
            self.items.delete_benchmark(connection, caller, uri)
            found = episodes.delete_episodes(connection, caller, own) if with_episodes else (0, [])
            count, empty = found
        self.sweep(empty)
        return count

    def store_artifact(self, caller: Caller, data: bytes, metadata: ArtifactMetadata) -> ArtifactMetadataItem:
        """As `TupliStorage.store_artifact`."""
        key = artifact_key(sha256(data))
        with self.database.writing() as connection:
            if self.items.has_artifact(connection, caller, data):
                return self.items.store_artifact(connection, caller, data, metadata)
            limits.demand_room(connection, self.settings, caller, len(data))
        try:
            while True:
                with self.database.writing() as connection:
                    pend(connection, key)
                self.blobs.write(key, data)
                with self.database.writing() as connection:
                    # else another user's deletion of the same bytes has removed them meanwhile
                    if self.blobs.size(key) is not None:
                        settle(connection, key)
                        return self.items.store_artifact(connection, caller, data, metadata)
        except BaseException:
            self.sweep([key])
            raise

    def delete_artifact(self, caller: Caller, uri: str, *, force: bool) -> None:
        """Deletes an artifact, and its bytes if no other user has the same."""
        with self.database.writing() as connection:
            self.items.delete_artifact(connection, caller, uri, force=force)
        self.sweep([artifact_key(uri)])

    def sweep(self, names: Iterable[str]) -> None:
        """Deletes pending files that the database does not name, in a write transaction, so that nobody adds them
        meanwhile. A file that cannot be deleted stays pending."""
        for name in names:
            with contextlib.suppress(StorageError), self.database.writing() as connection:
                if not _is_named(connection, name):
                    self.blobs.delete(name)
                settle(connection, name)

    def missing(self, name: str) -> TupliError:
        """What to raise for a file that is not there: LostError if the database names it, else NotFoundError, as it was
        deleted after the caller had found it."""
        with self.database.reading() as connection:
            if _is_named(connection, name):
                return lost(name)
        return NotFoundError("this was deleted, or replaced, at this moment; list what is there now")

    def delete_user(self, caller: Caller, name: str) -> None:
        """Deletes a user, and what only they could see; nothing happens if there is no such user. DeniedError if it is
        another user, and the caller lacks the right to delete users, or a right of theirs, and for the only admin."""
        caller.demand(Right.USER_DELETE, name)
        with self.database.writing() as connection:
            accounts.demand_over(connection, caller, name)
            if accounts.delete_user(connection, name):
                audit(connection, caller.name, "delete_user", name)
            unseen = self._forget_unseen(connection)
        self.sweep(unseen)

    def _forget_unseen(self, connection: Connection) -> list[str]:
        return [*self.items.forget_unseen(connection), *episodes.forget_unseen(connection)]

    def look_after(self) -> None:
        """Cleans up: deletes files that the database does not name, abandoned uploads, what only deleted users could
        see, and leftovers of killed processes. To be called now and then. What cannot be deleted stays until then.
        StorageError if the database or a directory cannot be used."""
        with self.database.writing() as connection, os_errors("cannot clean up", self.settings.own):
            self.uploads.forget_old(connection)
            unseen = self._forget_unseen(connection)
        self.sweep(unseen)
        with self.database.reading() as connection:
            old = pending(connection, seconds=self.settings.pending_seconds)
        self.sweep(old)
        with os_errors("cannot clean up", self.settings.making):
            folders = list(self.settings.making.iterdir())
        for folder in folders:
            with contextlib.suppress(OSError):  # another process has deleted it
                if folder.stat().st_mtime <= time.time() - self.settings.pending_seconds:
                    shutil.rmtree(folder)

    def reach(self) -> None:
        """Raises UnavailableError if the database, or the bucket, does not answer."""
        with self.database.reading() as connection:
            connection.exec_driver_sql("SELECT 1")
        self.blobs.size("artifacts/none")

    def close(self) -> None:
        self.database.close()


def _is_named(connection: Connection, name: str) -> bool:
    """Whether the database names a file."""
    files = select(FILE.c.path).where(FILE.c.place == escape_text(name))
    uri = name.removeprefix("artifacts/")
    items = select(ITEM.c.number).where(ITEM.c.kind == "artifact", ITEM.c.id == uri)
    return any(connection.execute(of).first() for of in (files, items))


@contextlib.contextmanager
def _or_skipped() -> Iterator[None]:
    """Warns of a benchmark or an artifact of a directory that cannot be served; the others are."""
    try:
        yield
    except UnavailableError:
        raise
    except TupliError as err:
        warn(f"not served: {err}")


@contextlib.contextmanager
def _unnamed(path: Path) -> Iterator[None]:
    """Errors in what a user has sent do not name its place on the server."""
    try:
        yield
    except FormatError as err:
        raise FormatError(str(err).replace(str(path), "the file")) from err
