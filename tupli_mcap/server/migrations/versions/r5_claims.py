"""It is known who was the first to store a recording of a UUID. Of earlier recordings, the audit table tells the order;
those that it does not name were found in the directory, and come first.
"""

from __future__ import annotations

from collections import Counter

from alembic import op
from sqlalchemy import (
    BigInteger,
    Column,
    Integer,
    MetaData,
    Table,
    Text,
    and_,
    column,
    func,
    insert,
    select,
    table,
    update,
)

revision = "5"
down_revision = "4"

_NUMBER = BigInteger().with_variant(Integer, "sqlite")
_TEXT = Text().with_variant(Text(collation="C"), "postgresql")
_FILE = table("file", column("path"), column("uuid"), column("created_by"), column("rank"))
_AUDIT = table("audit", column("number"), column("action"), column("target"))


def upgrade() -> None:
    """Makes a table, and fills it; files have the rank of their owner."""
    connection = op.get_bind()
    claim = Table(
        "claim",
        MetaData(),
        Column("uuid", _TEXT, primary_key=True),
        Column("created_by", _TEXT, primary_key=True),
        Column("rank", _NUMBER, nullable=False),
    )
    claim.create(connection)
    op.add_column("file", Column("rank", _NUMBER, nullable=False, server_default="0"))
    op.drop_index("ix_file_uuid", "file")
    for columns in (["rank"], ["uuid", "created_by"], ["uuid", "rank"]):
        op.create_index("_".join(["ix_file", *columns]), "file", columns)
    stored = and_(_AUDIT.c.target == _FILE.c.path, _AUDIT.c.action == "store_recording")
    since = func.coalesce(func.min(_AUDIT.c.number), 0)
    owners = select(_FILE.c.uuid, _FILE.c.created_by).select_from(_FILE.outerjoin(_AUDIT, stored))
    owners = owners.group_by(_FILE.c.uuid, _FILE.c.created_by).order_by(since)
    counts = Counter[str]()
    for uuid, created_by in connection.execute(owners).all():
        row = {"uuid": uuid, "created_by": created_by, "rank": counts[uuid]}
        connection.execute(insert(claim).values(**row))
        if counts[uuid]:
            of = and_(_FILE.c.uuid == uuid, _FILE.c.created_by == created_by)
            connection.execute(update(_FILE).where(of).values(rank=counts[uuid]))
        counts[uuid] += 1
