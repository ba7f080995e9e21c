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
    "TALLY",
    "VALUE",
    "VERSION",
    "episodes_of",
    "in_order",
    "of_one_recording",
]

APPLICATION_ID: Final = 0x7475_706C  # "tupl": how SQLite tells whose file this is
VERSION: Final = 6

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
    Column("environment", Text, nullable=False),  # that of its first run, "" if it does not say
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
    Column("success", Integer),  # 0 or 1 where the metadata say it
    Column("run", Integer, nullable=False),  # its place among the recording's
    Column("exact", Text),  # JSON of the fields of which the columns do not say all
)

# Sums over the episodes of a recording that the same people see: what is shown of many recordings looks at no episode.
# They are made anew, by `tallies.tally`, in each transaction that changes episodes of the recording.
TALLY: Final = Table(
    "tally",
    METADATA,
    Column("recording_id", _ID, ForeignKey("recording.id"), primary_key=True),
    Column("created_by", Text, primary_key=True),
    Column("published_in", Text, primary_key=True),
    Column("episodes", BigInteger, nullable=False),
    Column("steps", Float, nullable=False),  # a file may claim more than an integer of a database holds
    Column("returns", BigInteger, nullable=False),  # how many are numbers
    Column("return_sum", Float),  # of those
    Column("return_least", Float),
    Column("return_most", Float),
    Column("told", BigInteger, nullable=False),  # how many say whether they succeeded
    Column("succeeded", BigInteger, nullable=False),
    Column("first", BigInteger, nullable=False),  # the least and greatest `created_at`
    Column("last", BigInteger, nullable=False),
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


def episodes_of(recording_id: int, row_id: ColumnElement[int]) -> ColumnElement[bool]:
    """Where a column of row ids names an episode of a recording."""
    first = recording_id << EPISODE_BITS
    return and_(row_id >= first, row_id < first + (1 << EPISODE_BITS))


def of_one_recording() -> ColumnElement[bool]:
    """The join of episodes and recordings, cheap from either side."""
    return and_(RECORDING.c.id == EPISODE.c.recording_id, in_order())


def in_order() -> ColumnElement[bool]:
    """The same join, cheap from recordings to their episodes only: SQLite then walks all in order."""
    first = RECORDING.c.id.op("<<")(EPISODE_BITS)
    return and_(EPISODE.c.id >= first, EPISODE.c.id < first + (1 << EPISODE_BITS))
