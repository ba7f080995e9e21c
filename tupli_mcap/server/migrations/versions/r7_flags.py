"""The index of declared keys has the flags of each episode."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from alembic import op
from sqlalchemy import BigInteger, Column, Integer, Text, bindparam, column, select, table, update

from tupli_mcap.schema import split_key
from tupli_mcap.storage.texts import unescape_text

revision = "7"
down_revision = "6"

_NUMBER = BigInteger().with_variant(Integer, "sqlite")
_FLAGGED_KEYS = 31
_ROWS_AT_ONCE = 500
_DECLARED = table("declared", column("key", Text), column("number", BigInteger))
_EPISODE = table("episode", column("id", BigInteger), column("metadata", Text))
_VALUE = table("value", column("episode_id", BigInteger), column("flags", BigInteger))


def upgrade() -> None:
    """Adds a column, fills it, and makes the index anew."""
    op.add_column("value", Column("flags", _NUMBER, nullable=False, server_default="0"))
    op.drop_index("ix_value", "value")
    op.create_index("ix_value", "value", ["key", "number", "text", "episode_id", "flags"])
    connection = op.get_bind()
    declared = connection.execute(select(_DECLARED.c.key, _DECLARED.c.number)).all()
    keys = {split_key(unescape_text(key)): number for key, number in declared if number < _FLAGGED_KEYS}
    keys = {path[1:]: number for path, number in keys.items() if path[0] == "metadata"}
    change = update(_VALUE).where(_VALUE.c.episode_id == bindparam("of")).values(flags=bindparam("told"))
    last = -1
    while page := connection.execute(
        select(_EPISODE.c.id, _EPISODE.c.metadata)
        .where(_EPISODE.c.id > last)
        .order_by(_EPISODE.c.id)
        .limit(_ROWS_AT_ONCE if keys else 0)
    ).all():
        last = page[-1].id
        told = [{"of": row.id, "told": _flags(json.loads(row.metadata), keys)} for row in page]
        if changed := [each for each in told if each["told"]]:
            connection.execute(change, changed)


def _flags(metadata: Any, keys: Mapping[tuple[str, ...], int]) -> int:
    flags = 0
    for path, number in keys.items():
        value = metadata
        for segment in path:
            value = value.get(segment) if isinstance(value, dict) else None
        if isinstance(value, bool | list):
            flags |= (3 if isinstance(value, list) else 1 if value else 2) << 2 * number
    return flags
