"""The tables of a catalog, the same in any SQL database."""

from __future__ import annotations

from typing import Final

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
    and_,
    false,
)
from sqlalchemy.sql.elements import ColumnElement

APPLICATION_ID: Final = 0x7475_706C  # "tupl": how SQLite tells whose file this is
VERSION: Final = 13

EPISODE_BITS: Final = 32
"""An episode's row id is its recording's id shifted left by this, plus its number: rows lie in file order."""

LAST_EPISODE: Final = (1 << EPISODE_BITS) - 1

METADATA: Final = MetaData()

TEXT: Final = Text().with_variant(Text(collation="C"), "postgresql")
"""A text that is ordered by code points."""
NUMBER: Final = BigInteger().with_variant(Integer, "sqlite")
"""A whole number of 64 bits. SQLite numbers rows by themselves in an INTEGER only."""

RECORDING: Final = Table(
    "recording",
    METADATA,
    Column("id", NUMBER, primary_key=True),
    Column("path", TEXT, nullable=False, unique=True),
    Column("size", NUMBER, nullable=False),
    Column("mtime_ns", NUMBER, nullable=False),
    Column("mixed", NUMBER, nullable=False),
    Column("uuid", TEXT, nullable=False, index=True),
    Column("benchmark_id", TEXT, nullable=False, index=True),
    # that of its first run, "" if it does not say
    Column("environment", TEXT, nullable=False, server_default=""),
    Column("runs", TEXT, nullable=False),  # JSON: those that its episodes are of
)

EPISODE: Final = Table(
    "episode",
    METADATA,
    Column("id", NUMBER, primary_key=True),
    Column("recording_id", NUMBER, ForeignKey("recording.id"), nullable=False),
    Column("episode", NUMBER, nullable=False),
    Column("env", NUMBER, nullable=False),
    Column("n_tuples", NUMBER, nullable=False),
    Column("end", TEXT, nullable=False),
    Column("episode_return", Float),  # NULL for NaN, too
    Column("seed", Float),  # the nearest one
    Column("created_at", NUMBER, nullable=False),  # ns since 1970 in UTC, whole microseconds
    Column("created_by", TEXT, nullable=False),
    Column("published_in", TEXT, nullable=False),
    Column("metadata", TEXT, nullable=False),
    # whether SQL may look into the metadata
    Column("readable", Boolean, nullable=False, server_default=false()),
    Column("success", NUMBER),  # 0 or 1 where the metadata say it
    Column("run", NUMBER, nullable=False),  # its place among the recording's
    Column("exact", TEXT),  # JSON of the fields that the columns cannot hold exactly
)

INDEXED_FACTS: Final = ("n_tuples", "episode_return", "created_at")
"""The columns of episodes that have an index, for filters and orders."""
for _name in INDEXED_FACTS:
    Index(f"ix_episode_{_name}", EPISODE.c[_name], EPISODE.c.id)

# Sums over the episodes of a recording that the same people see, so that a list of many recordings reads no episodes.
# `tallies.tally` computes them again in each transaction that changes episodes of the recording.
TALLY: Final = Table(
    "tally",
    METADATA,
    Column("recording_id", NUMBER, ForeignKey("recording.id"), primary_key=True),
    Column("created_by", TEXT, primary_key=True),
    Column("published_in", TEXT, primary_key=True),
    Column("episodes", NUMBER, nullable=False),
    Column("steps", Float, nullable=False),  # a file may claim more than an integer of a database holds
    Column("returns", NUMBER, nullable=False),  # how many are numbers
    Column("return_sum", Float),  # of those
    Column("return_least", Float),
    Column("return_most", Float),
    Column("told", NUMBER, nullable=False),  # number of episodes that say whether they succeeded
    Column("succeeded", NUMBER, nullable=False),
    Column("first", NUMBER, nullable=False),  # the least and greatest `created_at`
    Column("last", NUMBER, nullable=False),
)

DECLARED: Final = Table(
    "declared", METADATA, Column("key", TEXT, primary_key=True), Column("number", NUMBER, nullable=False)
)

FLAGGED_KEYS: Final = 31
"""So many declared keys, the first ones, have a place in `flags`: two bits each."""

# What episodes hold at declared keys: the nearest float of a number or a flag, or a text; neither for anything else.
# Each of an episode's rows has all of its flags, so that the index of one key finds what meets a condition on it and
# on flags: either alone may be true of most episodes.
VALUE: Final = Table(
    "value",
    METADATA,
    Column("episode_id", NUMBER, primary_key=True, autoincrement=False),
    Column("key", NUMBER, primary_key=True, autoincrement=False),  # its number in `declared`
    Column("number", Float),
    Column("text", TEXT),
    # Of the declared key n, bit 2n says that it may be true, bit 2n + 1 that it may be false: a list may hold both.
    Column("flags", NUMBER, nullable=False),
    Index("ix_value", "key", "number", "text", "episode_id", "flags"),
    sqlite_with_rowid=False,
)


def episodes_of(recording_id: int, row_id: ColumnElement[int]) -> ColumnElement[bool]:
    """The condition that a column of row ids names an episode of a recording."""
    first = recording_id << EPISODE_BITS
    return and_(row_id >= first, row_id < first + (1 << EPISODE_BITS))


def of_one_recording() -> ColumnElement[bool]:
    """The join of episodes and recordings, cheap from either side."""
    return and_(RECORDING.c.id == EPISODE.c.recording_id, in_order())


def in_order() -> ColumnElement[bool]:
    """The same join, cheap from recordings to their episodes only: SQLite then walks all in order."""
    first = first_of(RECORDING.c.id)
    return and_(EPISODE.c.id >= first, EPISODE.c.id < first + (1 << EPISODE_BITS))


def first_of(recording: ColumnElement[int]) -> ColumnElement[int]:
    """The smallest possible id of an episode of a recording."""
    return recording * (1 << EPISODE_BITS)
