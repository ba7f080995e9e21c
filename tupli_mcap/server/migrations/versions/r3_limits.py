"""Uploads and failed sign-ins are in the database, where all processes of a server see them; users have quotas, and
benchmarks and artifacts a size. That of what was stored before is not known, and counts as 0.
"""

from __future__ import annotations

from alembic import op
from sqlalchemy import BigInteger, Column, Integer, MetaData, Table, Text

revision = "3"
down_revision = "2"

_NUMBER = BigInteger().with_variant(Integer, "sqlite")
_TEXT = Text().with_variant(Text(collation="C"), "postgresql")


def upgrade() -> None:
    """Adds two tables and two columns."""
    metadata = MetaData()
    Table(
        "upload",
        metadata,
        Column("id", _TEXT, primary_key=True),
        Column("user", _TEXT, nullable=False, index=True),
        Column("length", _NUMBER, nullable=False),
        Column("digest", _TEXT, nullable=False),
        Column("sent_before", _NUMBER, nullable=False),
        Column("since", _NUMBER, nullable=False),
    )
    Table(
        "failure",
        metadata,
        Column("number", _NUMBER, primary_key=True),
        Column("key", _TEXT, nullable=False, index=True),
        Column("time", _NUMBER, nullable=False, index=True),
    )
    metadata.create_all(op.get_bind())
    op.add_column("account", Column("quota", _NUMBER))
    op.add_column("item", Column("size", _NUMBER, nullable=False, server_default="0"))
