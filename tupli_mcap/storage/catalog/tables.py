"""The tables of a catalog, the same in any SQL database."""

from __future__ import annotations

from typing import Final

from sqlalchemy import BigInteger, Column, Float, ForeignKey, Index, Integer, MetaData, Table, Text, and_
from sqlalchemy.sql.elements import ColumnElement

__all__ = [
    "APPLICATION_ID",
    "DECLARED",
    "EPISODE",
    "EPISODE_BITS",
    "METADATA",
    "RECORDING",
    "VALUE",
    "VERSION",
    "in_order",
    "of_one_recording",
]

APPLICATION_ID: Final = 0x7475_706C  # "tupl": how SQLite tells whose file this is
VERSION: Final = 5

EPISODE_BITS: Final = 32
"""An episode's row id is its recording's id shifted left by this, plus its number: rows lie in file order."""

METADATA: Final = MetaData()

_ID: Final = BigInteger().with_variant(
    Integer, "sqlite"
)  # SQLite numbers rows by themselves in an INTEGER only

RECORDING: Final = Table(
    "recording",
    METADATA,
    Column("id", _ID, primary_key=True),
    Column("path", Text, nullable=False, unique=True),
    Column("size", BigInteger, nullable=False),
    Column("mtime_ns", BigInteger, nullable=False),
    Column("mixed", BigInteger, nullable=False),
    Column("uuid", Text, nullable=False, index=True),
    Column("benchmark_id", Text, nullable=False, index=True),
    Column("runs", Text, nullable=False),  # JSON: those that its episodes are of
)

EPISODE: Final = Table(
    "episode",
    METADATA,
    Column("id", _ID, primary_key=True),
    Column("recording_id", _ID, ForeignKey("recording.id"), nullable=False),
    Column("episode", Integer, nullable=False),
    Column("env", Integer, nullable=False),
    Column("n_tuples", Integer, nullable=False),
    Column("end", Text, nullable=False),
    Column("episode_return", Float),  # NULL for NaN, too
    Column("seed", Float),  # the nearest one
    Column("created_at", BigInteger, nullable=False),  # ns since 1970 in UTC, whole microseconds
    Column("created_by", Text, nullable=False),
    Column("published_in", Text, nullable=False),
    Column("metadata", Text, nullable=False),
    Column("run", Integer, nullable=False),  # its place among the recording's
    Column("exact", Text),  # JSON of the fields of which the columns do not say all
)

DECLARED: Final = Table(
    "declared",
    METADATA,
    Column("key", Text, primary_key=True),
    Column("number", Integer, nullable=False),
)

# What episodes hold at declared keys: the nearest float of a number or a flag, or a text; neither for anything else.
VALUE: Final = Table(
    "value",
    METADATA,
    Column("episode_id", _ID, primary_key=True, autoincrement=False),
    Column("key", Integer, primary_key=True, autoincrement=False),  # its number in `declared`
    Column("number", Float),
    Column("text", Text),
    Index("ix_value", "key", "number", "text", "episode_id"),
    sqlite_with_rowid=False,
)


def of_one_recording() -> ColumnElement[bool]:
    """The join of episodes and recordings, cheap from either side."""
    return and_(RECORDING.c.id == EPISODE.c.recording_id, in_order())


def in_order() -> ColumnElement[bool]:
    """The same join, cheap from recordings to their episodes only: SQLite then walks all in order."""
    first = RECORDING.c.id.op("<<")(EPISODE_BITS)
    return and_(EPISODE.c.id >= first, EPISODE.c.id < first + (1 << EPISODE_BITS))
