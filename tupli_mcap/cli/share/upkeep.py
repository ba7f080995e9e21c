"""Commands that copy all that a server keeps: backup-server, restore-server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import Json
from tupli_mcap.cli.output import bytes_of, counted, print_json
from tupli_mcap.cli.share.serve import Blobs, Database, Served
from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import missing_extra

__all__ = ["backup_server", "restore_server"]


def backup_server(
    directory: Served,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="A directory: a new one, or the backup before.")
    ],
    database: Database = "",
    blobs: Blobs = "",
    as_json: Json = False,
) -> None:
    """Copy a server's data into a directory, while it runs.

    Files that the directory has already are not copied again. A backup can be
    served as it is.
    """
    _copy(directory, output, database, blobs, "backed up", as_json=as_json)


def restore_server(
    backup: Annotated[Path, typer.Argument(metavar="BACKUP", help="What backup-server has written.")],
    directory: Served,
    database: Database = "",
    blobs: Blobs = "",
    as_json: Json = False,
) -> None:
    """Restore a backup to where a server keeps its data.

    Nothing may be there yet. It may be another database and another bucket than
    before, so that this moves a server, too.
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
    if as_json:
        print_json({"directory": str(directory), "backup": str(backup), **copied._asdict()})
        return
    contents = ", ".join(
        counted(count, what)
        for count, what in (
            (copied.users, "user"),
            (copied.recordings, "recording"),
            (copied.artifacts, "artifact"),
        )
    )
    say(f"{done} {contents} ({bytes_of(copied.bytes)}); {counted(copied.copied, 'file')} copied")
