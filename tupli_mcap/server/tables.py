"""The tables of a server, beside those of its catalog: users and their rights, items and who sees them."""

from __future__ import annotations

from typing import Final

from sqlalchemy import BigInteger, Boolean, Column, Index, Integer, MetaData, Table, Text, UniqueConstraint

__all__ = [
    "API_TOKEN",
    "AUDIENCE",
    "AUDIT",
    "FILE",
    "GROUP",
    "ITEM",
    "MEMBERSHIP",
    "METADATA",
    "PENDING",
    "PRINCIPAL",
    "REFRESH_TOKEN",
    "ROLE",
    "USER",
]

METADATA: Final = MetaData()
_NUMBER: Final = BigInteger().with_variant(Integer, "sqlite")

# Users and groups have one name space: a group that is named like a user would see what is that user's alone.
PRINCIPAL: Final = Table(
    "principal",
    METADATA,
    Column("name", Text, primary_key=True),
    Column("kind", Text, nullable=False),  # user, group or reserved
)

USER: Final = Table(
    "account",
    METADATA,
    Column("name", Text, primary_key=True),
    Column("password", Text, nullable=False),  # its hash
    Column("epoch", Integer, nullable=False),  # tokens of an earlier one are void
    Column("created_at", BigInteger, nullable=False),  # seconds since 1970, as all times here
)

GROUP: Final = Table(
    "team",
    METADATA,
    Column("name", Text, primary_key=True),
    Column("description", Text),
)

ROLE: Final = Table(
    "role",
    METADATA,
    Column("name", Text, primary_key=True),
    Column("rights", Text, nullable=False),  # JSON: a list
    Column("description", Text),
    Column("builtin", Boolean, nullable=False),
)

MEMBERSHIP: Final = Table(
    "membership",
    METADATA,
    Column("user", Text, primary_key=True),
    Column("team", Text, primary_key=True, index=True),
    Column("role", Text, primary_key=True),
)

REFRESH_TOKEN: Final = Table(
    "refresh_token",
    METADATA,
    Column("digest", Text, primary_key=True),  # SHA-256: who reads the table has no token
    Column("user", Text, nullable=False, index=True),
    Column("family", Text, nullable=False, index=True),  # of one sign-in
    Column("used", Boolean, nullable=False),
    Column("expires", BigInteger, nullable=False),
)

API_TOKEN: Final = Table(
    "api_token",
    METADATA,
    Column("id", Text, primary_key=True),
    Column("digest", Text, nullable=False, unique=True),
    Column("user", Text, nullable=False, index=True),
    Column("name", Text, nullable=False),
    Column("scope", Text, nullable=False),  # read or write
    Column("created_at", BigInteger, nullable=False),
    Column("expires", BigInteger),
)

# A benchmark or an artifact of one owner. Two users may have the same content, each under their own name.
ITEM: Final = Table(
    "item",
    METADATA,
    Column("number", _NUMBER, primary_key=True),
    Column("kind", Text, nullable=False),  # benchmark or artifact
    Column("id", Text, nullable=False),
    Column("created_by", Text, nullable=False),
    Column("published_in", Text, nullable=False),  # JSON: a list of groups
    Column("header", Text, nullable=False),  # JSON: what is listed of it, but who made it and who sees it
    Column("content", Text),  # a benchmark's environment as text
    Column("needs", Text, nullable=False),  # JSON: ids of the artifacts that a benchmark needs
    UniqueConstraint("kind", "id", "created_by"),
    Index("ix_item_id", "id"),
)

# Which groups a list of groups names: how SQL looks into `published_in`.
AUDIENCE: Final = Table(
    "audience",
    METADATA,
    Column("published_in", Text, primary_key=True),
    Column("team", Text, primary_key=True, index=True),
)

# The file of a recording of the catalog, which has its path.
FILE: Final = Table(
    "file",
    METADATA,
    Column("path", Text, primary_key=True),
    Column("created_by", Text, nullable=False, index=True),
    Column("uuid", Text, nullable=False, index=True),
    Column("place", Text, nullable=False),  # its name among the blobs: another one for each version
    Column("digest", Text, nullable=False),  # SHA-256 in hex digits
    Column("size", BigInteger, nullable=False),
    Column("episodes", Integer, nullable=False),  # in the file, deleted ones too
    Column("deleted", Text, nullable=False),  # JSON: numbers of episodes
)

# Files on their way in or out: what nothing names by the next start is deleted then, and never taken for a new one.
PENDING: Final = Table(
    "pending",
    METADATA,
    Column("path", Text, primary_key=True),
    Column("since", BigInteger, nullable=False),
)

AUDIT: Final = Table(
    "audit",
    METADATA,
    Column("number", _NUMBER, primary_key=True),
    Column("time", BigInteger, nullable=False),
    Column("user", Text, nullable=False),
    Column("action", Text, nullable=False),
    Column("target", Text, nullable=False),
)
