"""The tables of a catalog."""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy import BigInteger, Column, ForeignKey, Integer, MetaData, Table, Text, and_
from sqlalchemy.sql.elements import ColumnElement
from sqlalchemy.types import UserDefinedType

APPLICATION_ID: Final = 0x7475_706C  # "tupl": how SQLite tells whose file this is
VERSION: Final = 3

EPISODE_BITS: Final = 32
"""An episode's row id is its recording's id shifted left by this, plus its number: rows lie in file order."""


class AsStored(UserDefinedType[Any]):
    """A column without affinity: SQLite keeps and compares each value as the type it was given."""

    cache_ok = True

    def get_col_spec(self, **_: Any) -> str:
        return ""


METADATA: Final = MetaData()

RECORDING: Final = Table(
    "recording",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("path", Text, nullable=False, unique=True),
    Column("size", BigInteger, nullable=False),
    Column("mtime_ns", BigInteger, nullable=False),
    Column("mixed", BigInteger, nullable=False),
    Column("uuid", Text, nullable=False, index=True),
    Column("benchmark_id", Text, nullable=False, index=True),
)

EPISODE: Final = Table(
    "episode",
    METADATA,
    Column("id", Integer, primary_key=True),
    Column("recording_id", Integer, ForeignKey("recording.id"), nullable=False),
    Column("episode", Integer, nullable=False),
    Column("env", Integer, nullable=False),
    Column("n_tuples", Integer, nullable=False),
    Column("end", Text, nullable=False),
    # Numbers that SQLite cannot hold (NaN, integers beyond 64 bits) are their JSON text in these two.
    Column("episode_return", AsStored),
    Column("seed", AsStored),
    Column("created_at", BigInteger, nullable=False),  # ns since 1970 in UTC, whole microseconds
    Column("created_by", Text, nullable=False),
    Column("published_in", Text, nullable=False),
    Column("metadata", Text, nullable=False),
    # The metadata as it was given, where `metadata` had to be rewritten for SQLite to see what it says.
    Column("original", Text),
)

DECLARED: Final = Table(
    "declared",
    METADATA,
    Column("key", Text, primary_key=True),
    Column("number", Integer, nullable=False),
)


def of_one_recording() -> ColumnElement[bool]:
    """The join of episodes and recordings, cheap from either side."""
    return and_(RECORDING.c.id == EPISODE.c.recording_id, in_order())


def in_order() -> ColumnElement[bool]:
    """The same join, cheap from recordings to their episodes only: SQLite then walks all in order."""
    first = RECORDING.c.id.op("<<")(EPISODE_BITS)
    return and_(EPISODE.c.id >= first, EPISODE.c.id < first + (1 << EPISODE_BITS))


def declared_columns(number: int) -> tuple[str, str]:
    """The names of the generated columns (kind, value) of a declared metadata key."""
    return f"key_{number}_kind", f"key_{number}_value"


def declared_index(number: int) -> str:
    """The name of the index of a declared key."""
    return f"ix_key_{number}"


__all__ = [
    "APPLICATION_ID",
    "DECLARED",
    "EPISODE",
    "EPISODE_BITS",
    "METADATA",
    "RECORDING",
    "VERSION",
    "AsStored",
    "declared_columns",
    "declared_index",
    "in_order",
    "of_one_recording",
]
