"""PostgreSQL orders texts by code points and has numbers of 64 bits, too, as SQLite has by itself. Recordings have
their environment and the sums of their episodes; of an episode it is known whether it succeeded, and whether SQL may
look into its metadata.
"""

from __future__ import annotations

import json
import re
from typing import Any

from alembic import op
from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Integer,
    MetaData,
    Table,
    Text,
    bindparam,
    column,
    false,
    func,
    inspect,
    select,
    table,
    text,
    update,
)

revision = "2"
down_revision = "1"

_UNREADABLE = re.compile(r"\\u0000|[eE][+-]?[0-9]{3}|[0-9]{100}")
_ROWS_AT_ONCE = 500
_INDEXED_CHARACTERS = 500
_NUMBER = BigInteger().with_variant(Integer, "sqlite")
_TEXT = Text().with_variant(Text(collation="C"), "postgresql")
_VALUE = table("value", column("text", Text))
_RECORDING = table("recording", column("id", BigInteger), column("runs", Text), column("environment", Text))
_EPISODE = table(
    "episode",
    column("id", BigInteger),
    column("metadata", Text),
    column("readable", Boolean),
    column("success", BigInteger),
)


def upgrade() -> None:
    """Changes types, and adds columns and a table."""
    connection = op.get_bind()
    if connection.dialect.name == "postgresql":
        _retype()
    short = func.substr(_VALUE.c.text, 1, _INDEXED_CHARACTERS)
    long = func.length(_VALUE.c.text) > _INDEXED_CHARACTERS
    connection.execute(update(_VALUE).where(long).values(text=short))
    op.add_column("episode", Column("readable", Boolean, nullable=False, server_default=false()))
    op.add_column("episode", Column("success", _NUMBER))
    op.add_column("recording", Column("environment", _TEXT, nullable=False, server_default=""))
    _fill()
    _tally()


def _retype() -> None:
    found = inspect(op.get_bind())
    for name in found.get_table_names():
        for each in found.get_columns(name):
            if isinstance(each["type"], Text):
                op.alter_column(name, each["name"], type_=Text(collation="C"))
            elif isinstance(each["type"], Integer) and not isinstance(each["type"], BigInteger):
                op.alter_column(name, each["name"], type_=BigInteger())


def _fill() -> None:
    connection = op.get_bind()
    change = update(_EPISODE).where(_EPISODE.c.id == bindparam("of"))
    last = -1
    while page := connection.execute(
        select(_EPISODE.c.id, _EPISODE.c.metadata)
        .where(_EPISODE.c.id > last)
        .order_by(_EPISODE.c.id)
        .limit(_ROWS_AT_ONCE)
    ).all():
        last = page[-1].id
        told = [
            {
                "of": row.id,
                "readable": not _UNREADABLE.search(row.metadata),
                "success": _success(row.metadata),
            }
            for row in page
        ]
        connection.execute(change, told)
    for number, runs in connection.execute(select(_RECORDING.c.id, _RECORDING.c.runs)).all():
        named = (json.loads(runs) or [{}])[0].get("environment", "")
        told_of = {"environment": named if isinstance(named, str) and named.isprintable() else ""}
        connection.execute(update(_RECORDING).where(_RECORDING.c.id == number).values(**told_of))


def _success(metadata: str) -> int | None:
    told: dict[str, Any] = json.loads(metadata) if 'success"' in metadata else {}
    found = [told[key] for key in ("is_success", "success") if told.get(key) in (0, 1)]
    return int(found[0]) if found else None


def _tally() -> None:
    metadata = MetaData()
    Table("recording", metadata, Column("id", _NUMBER, primary_key=True))
    Table(
        "tally",
        metadata,
        Column("recording_id", _NUMBER, ForeignKey("recording.id"), primary_key=True),
        Column("created_by", _TEXT, primary_key=True),
        Column("published_in", _TEXT, primary_key=True),
        Column("episodes", _NUMBER, nullable=False),
        Column("steps", Float, nullable=False),
        Column("returns", _NUMBER, nullable=False),
        Column("return_sum", Float),
        Column("return_least", Float),
        Column("return_most", Float),
        Column("told", _NUMBER, nullable=False),
        Column("succeeded", _NUMBER, nullable=False),
        Column("first", _NUMBER, nullable=False),
        Column("last", _NUMBER, nullable=False),
    )
    metadata.create_all(op.get_bind())
    usual = "CASE WHEN abs(episode_return) < 1e290 THEN episode_return ELSE 0 END"
    op.execute(
        text(
            "INSERT INTO tally SELECT recording_id, created_by, published_in, count(*), sum(n_tuples * 1e0), "
            f"count(episode_return), sum({usual}), min(episode_return), max(episode_return), count(success), "
            "coalesce(sum(success), 0), min(created_at), max(created_at) "
            "FROM episode GROUP BY recording_id, created_by, published_in"
        )
    )
