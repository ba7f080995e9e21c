"""How a server is set up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["Settings"]


@dataclass(frozen=True)
class Settings:
    """directory: what the server keeps, made if it is missing. database: a SQLAlchemy URL, by default SQLite in the
    directory.

    open_signup: whether everybody may make a user. guests: whether what is published in `global` is shown without a
    sign-in. access_seconds, refresh_seconds, ticket_seconds: how long tokens are valid, and addresses of recordings.
    max_upload, max_body: bytes of a recording, and of any other request. max_page: items of a page.
    """

    directory: Path
    database: str = ""
    open_signup: bool = False
    guests: bool = False
    access_seconds: int = 30 * 60
    refresh_seconds: int = 30 * 24 * 3600
    ticket_seconds: int = 24 * 3600
    max_upload: int = 1 << 40
    max_body: int = 256 << 20
    max_page: int = 1000

    @property
    def own(self) -> Path:
        """The directory of what is the server's alone: its database, its secret, uploads that are not finished."""
        return self.directory / "server"
