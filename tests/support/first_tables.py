"""The tables of a server's first version, with rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sqlalchemy import Boolean, MetaData, create_engine, text

from tupli_mcap.server import migrations

GOLDEN = Path(__file__).parents[1] / "golden"


def fill_first(url: str) -> None:
    """The tables and the rows of the first version, which knew no Alembic."""
    engine = create_engine(url)
    with engine.begin() as connection:
        migrations.upgrade(connection, "1")
        connection.execute(text("DROP TABLE alembic_version"))
        found = MetaData()
        found.reflect(connection)
        content: dict[str, list[dict[str, Any]]] = json.loads((GOLDEN / "server_1.json").read_bytes())
        for table in found.sorted_tables:
            flags = [column.name for column in table.columns if isinstance(column.type, Boolean)]
            for row in content[table.name]:
                connection.execute(table.insert().values(row | {name: bool(row[name]) for name in flags}))
            (key, *_) = table.primary_key.columns
            if url.startswith("postgresql") and key.autoincrement is True:
                sequence = f"pg_get_serial_sequence('{table.name}', '{key.name}')"
                connection.execute(
                    text(f'SELECT setval({sequence}, 1 + max("{key.name}")) FROM {table.name}')
                )
    engine.dispose()
