"""How a server is set up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """directory: what the server keeps, made if it is missing. database: a SQLAlchemy URL, by default SQLite in the
    directory. blobs: the URL of a bucket for recordings and artifacts, by default the directory. presigned: whether
    clients can reach the bucket, and are sent there. accel: where nginx, before this server, has the directory.

    open_signup: whether everybody may make a user. guests: whether what is published in `global` is shown without a
    sign-in. access_seconds, refresh_seconds, ticket_seconds: how long tokens are valid, and addresses of recordings.
    max_upload, max_body, max_message: bytes of a recording, of a benchmark or an artifact, and of any other request.
    max_page: items of a page. max_uploads: unfinished ones of a user. quota: bytes that each user may keep, if that is
    limited. query_seconds: how long a question may take. head_seconds, stall_seconds: how long a client may keep the
    server waiting, see `patience`. pending_seconds: by then, a file has come or gone, or who moved it was killed.
    upkeep_seconds: between two times of looking after what nobody needs. open_metrics: whether everybody may see them.
    """

    directory: Path
    database: str = ""
    blobs: str = ""
    presigned: bool = False
    accel: str = ""
    open_signup: bool = False
    guests: bool = False
    access_seconds: int = 30 * 60
    refresh_seconds: int = 30 * 24 * 3600
    ticket_seconds: int = 24 * 3600
    max_upload: int = 1 << 40
    max_body: int = 256 << 20
    max_message: int = 4 << 20
    max_page: int = 1000
    max_uploads: int = 100
    quota: int | None = None
    query_seconds: float = 30
    head_seconds: float = 20
    stall_seconds: float = 60
    pending_seconds: float = 24 * 3600
    upkeep_seconds: float = 3600
    open_metrics: bool = False

    @property
    def own(self) -> Path:
        """The directory of what is the server's alone: its database, its secret, uploads that are not finished."""
        return self.directory / "server"

    @property
    def making(self) -> Path:
        """The directory of what is being made; what a killed process has left there is deleted some time."""
        return self.own / "making"
