"""Commands that copy all data of a server: backup-server, restore-server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import Json
from tupli_mcap.cli.output import bytes_of, counted, print_result
from tupli_mcap.cli.share.serve import Blobs, Database, Served
from tupli_mcap.errors import missing_extra

__all__ = ["backup_server", "restore_server"]


def backup_server(
    directory: Served,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="The backup's directory: a new one, or an earlier backup."),
    ],
    database: Database = "",
    blobs: Blobs = "",
    as_json: Json = False,
) -> None:
    """Back up a server's data into a directory, while it runs.

    Into an earlier backup, only new files are copied. `serve` can serve a backup as it is.
    """
    _copy(directory, output, database, blobs, "backed up", as_json=as_json)


def restore_server(
    backup: Annotated[Path, typer.Argument(metavar="BACKUP", help="The directory that backup-server wrote.")],
    directory: Served,
    database: Database = "",
    blobs: Blobs = "",
    as_json: Json = False,
) -> None:
    """Restore a server's data from a backup.

    DIR, the database and the bucket have to be empty. They may be others than those of the
    backup: this is how to move a server.
    """
    _copy(directory, backup, database, blobs, "restored", as_json=as_json)


def _copy(directory: Path, backup: Path, database: str, blobs: str, done: str, *, as_json: bool) -> None:
    try:
        from tupli_mcap.server.backup import back_up, restore
        from tupli_mcap.server.settings import Settings
    except ImportError as err:
        raise missing_extra("a server's data need SQLAlchemy and Alembic", "server") from err
    settings = Settings(directory.absolute(), database=database, blobs=blobs)
    copied = restore(backup, settings) if done == "restored" else back_up(settings, backup)
    contents = ", ".join(
        counted(count, what)
        for count, what in (
            (copied.users, "user"),
            (copied.recordings, "recording"),
            (copied.artifacts, "artifact"),
        )
    )
    print_result(
        {"directory": str(directory), "backup": str(backup), **copied._asdict()},
        f"{done} {contents} ({bytes_of(copied.bytes)}); {counted(copied.copied, 'file')} copied",
        as_json=as_json,
    )
