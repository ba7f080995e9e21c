"""The first tables."""

from __future__ import annotations

from alembic import op
from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    Table,
    Text,
    UniqueConstraint,
)

revision = "1"
down_revision = None

_NUMBER = BigInteger().with_variant(Integer, "sqlite")


def upgrade() -> None:
    """Makes them."""
    metadata = MetaData()
    _of_people(metadata)
    _of_content(metadata)
    _of_catalog(metadata)
    metadata.create_all(op.get_bind())


def _of_people(metadata: MetaData) -> None:
    Table("principal", metadata, Column("name", Text, primary_key=True), Column("kind", Text, nullable=False))
    Table(
        "account",
        metadata,
        Column("name", Text, primary_key=True),
        Column("password", Text, nullable=False),
        Column("epoch", Integer, nullable=False),
        Column("created_at", BigInteger, nullable=False),
    )
    Table("team", metadata, Column("name", Text, primary_key=True), Column("description", Text))
    Table(
        "role",
        metadata,
        Column("name", Text, primary_key=True),
        Column("rights", Text, nullable=False),
        Column("description", Text),
        Column("builtin", Boolean, nullable=False),
    )
    Table(
        "membership",
        metadata,
        Column("user", Text, primary_key=True),
        Column("team", Text, primary_key=True, index=True),
        Column("role", Text, primary_key=True),
    )
    Table(
        "refresh_token",
        metadata,
        Column("digest", Text, primary_key=True),
        Column("user", Text, nullable=False, index=True),
        Column("family", Text, nullable=False, index=True),
        Column("used", Boolean, nullable=False),
        Column("expires", BigInteger, nullable=False),
    )
    Table(
        "api_token",
        metadata,
        Column("id", Text, primary_key=True),
        Column("digest", Text, nullable=False, unique=True),
        Column("user", Text, nullable=False, index=True),
        Column("name", Text, nullable=False),
        Column("scope", Text, nullable=False),
        Column("created_at", BigInteger, nullable=False),
        Column("expires", BigInteger),
    )


def _of_content(metadata: MetaData) -> None:
    Table(
        "item",
        metadata,
        Column("number", _NUMBER, primary_key=True),
        Column("kind", Text, nullable=False),
        Column("id", Text, nullable=False),
        Column("created_by", Text, nullable=False),
        Column("published_in", Text, nullable=False),
        Column("header", Text, nullable=False),
        Column("content", Text),
        Column("needs", Text, nullable=False),
        UniqueConstraint("kind", "id", "created_by"),
        Index("ix_item_id", "id"),
    )
    Table(
        "audience",
        metadata,
        Column("published_in", Text, primary_key=True),
        Column("team", Text, primary_key=True, index=True),
    )
    Table(
        "file",
        metadata,
        Column("path", Text, primary_key=True),
        Column("created_by", Text, nullable=False, index=True),
        Column("uuid", Text, nullable=False, index=True),
        Column("place", Text, nullable=False),
        Column("digest", Text, nullable=False),
        Column("size", BigInteger, nullable=False),
        Column("episodes", Integer, nullable=False),
        Column("deleted", Text, nullable=False),
    )
    Table(
        "pending",
        metadata,
        Column("path", Text, primary_key=True),
        Column("since", BigInteger, nullable=False),
    )
    Table(
        "audit",
        metadata,
        Column("number", _NUMBER, primary_key=True),
        Column("time", BigInteger, nullable=False),
        Column("user", Text, nullable=False),
        Column("action", Text, nullable=False),
        Column("target", Text, nullable=False),
    )


def _of_catalog(metadata: MetaData) -> None:
    Table(
        "recording",
        metadata,
        Column("id", _NUMBER, primary_key=True),
        Column("path", Text, nullable=False, unique=True),
        Column("size", BigInteger, nullable=False),
        Column("mtime_ns", BigInteger, nullable=False),
        Column("mixed", BigInteger, nullable=False),
        Column("uuid", Text, nullable=False, index=True),
        Column("benchmark_id", Text, nullable=False, index=True),
        Column("runs", Text, nullable=False),
    )
    Table(
        "episode",
        metadata,
        Column("id", _NUMBER, primary_key=True),
        Column("recording_id", _NUMBER, ForeignKey("recording.id"), nullable=False),
        Column("episode", Integer, nullable=False),
        Column("env", Integer, nullable=False),
        Column("n_tuples", Integer, nullable=False),
        Column("end", Text, nullable=False),
        Column("episode_return", Float),
        Column("seed", Float),
        Column("created_at", BigInteger, nullable=False),
        Column("created_by", Text, nullable=False),
        Column("published_in", Text, nullable=False),
        Column("metadata", Text, nullable=False),
        Column("run", Integer, nullable=False),
        Column("exact", Text),
    )
    Table(
        "declared", metadata, Column("key", Text, primary_key=True), Column("number", Integer, nullable=False)
    )
    Table(
        "value",
        metadata,
        Column("episode_id", _NUMBER, primary_key=True, autoincrement=False),
        Column("key", Integer, primary_key=True, autoincrement=False),
        Column("number", Float),
        Column("text", Text),
        Index("ix_value", "key", "number", "text", "episode_id"),
        sqlite_with_rowid=False,
    )
