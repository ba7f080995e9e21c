"""The settings of a server."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Settings:
    """The settings of a server; times in seconds, sizes in bytes.

    directory: the directory of all data; created if missing. database: a SQLAlchemy URL; by default, SQLite in the
    directory. blobs: the URL of a bucket for recordings and artifacts; by default, the directory. presigned: whether
    clients can reach the bucket, and are redirected there. accel: the internal location of nginx for the directory.

    open_signup: whether everybody may create a user. min_password: least characters of a new password. guests: whether
    what is published in `global` is shown without a sign-in. access_seconds, refresh_seconds, ticket_seconds: how long
    tokens and tickets are valid. max_upload, max_body, max_message: most bytes of a recording, of a benchmark or an
    artifact, and of any other request. max_marks: most commas and opening brackets in a body of JSON: a short value
    takes up to a hundred times the memory of its text. max_page: most items of a page. max_uploads: most unfinished
    uploads of a user. max_requests: most requests of a user that a process answers at a time. quota: most bytes that
    each user may store; None without a limit. query_seconds: how long a query may take.
    head_seconds, stall_seconds: how long a client may keep the server waiting, see `patience`. pending_seconds: after
    this time, a pending file counts as left by a killed process. upkeep_seconds: time between two clean-ups.
    open_metrics: whether metrics are shown without a sign-in. loader: the address of a remote data loader of Foxglove
    that reads this server; empty for none.
    """

    directory: Path
    database: str = ""
    blobs: str = ""
    presigned: bool = False
    accel: str = ""
    open_signup: bool = False
    min_password: int = 8  # as NIST SP 800-63B demands
    guests: bool = False
    access_seconds: int = 30 * 60
    refresh_seconds: int = 30 * 24 * 3600
    ticket_seconds: int = 24 * 3600
    max_upload: int = 1 << 40
    max_body: int = 256 << 20
    max_message: int = 4 << 20
    max_marks: int = 4_000_000
    max_page: int = 1000
    max_uploads: int = 100
    max_requests: int = 4
    quota: int | None = None
    query_seconds: float = 30
    head_seconds: float = 20
    stall_seconds: float = 60
    pending_seconds: float = 24 * 3600
    upkeep_seconds: float = 3600
    open_metrics: bool = False
    loader: str = ""

    @property
    def own(self) -> Path:
        """The directory of the server's own files: its database, its secret, unfinished uploads."""
        return self.directory / "server"

    @property
    def secret(self) -> Path:
        """The file of the key that signs tokens; it is there from the server's first start on, and in no backup."""
        return self.own / "secret"

    @property
    def database_place(self) -> str | Path:
        """The SQLAlchemy URL of the database, or its file."""
        return self.database or self.own / "server.sqlite"

    @property
    def next_database(self) -> Path:
        """The database of a backup that is being made or restored, or was interrupted: some of its files are there
        already."""
        return self.own / "server.sqlite.new"

    @property
    def making(self) -> Path:
        """The directory of files in the making; leftovers of killed processes are deleted later."""
        return self.own / "making"
