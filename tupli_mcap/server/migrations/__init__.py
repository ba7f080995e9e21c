"""Migrations of a server's tables from version to version, as revisions of Alembic.

env         the script that Alembic runs
versions/   the revisions; the last one makes the tables of `server.tables` and `storage.catalog.tables`
"""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection, inspect

from tupli_mcap.errors import StorageError

__all__ = ["upgrade"]

_FIRST = "1"  # whose tables were made without Alembic, too


def upgrade(connection: Connection, revision: str = "head") -> None:
    """Upgrades or creates the tables, in the caller's transaction, which has to lock out other writers.

    Raises:
        StorageError: they are of a later version than this one.
    """
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    config.attributes["connection"] = connection
    script = ScriptDirectory.from_config(config)
    found = MigrationContext.configure(connection).get_current_revision()
    if found is None and inspect(connection).has_table("account"):
        command.stamp(config, _FIRST)
    if found is not None and found not in {each.revision for each in script.walk_revisions()}:
        raise StorageError(
            f"the server's database is of a later version (revision {found!r:.40}) than this program; "
            "update tupli-mcap, or restore a backup"
        )
    if found is None or found != script.get_current_head():
        command.upgrade(config, revision)
