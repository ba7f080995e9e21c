"""The tables of a server, beside those of its catalog: users and their rights, items and who sees them."""

from __future__ import annotations

from typing import Final

from sqlalchemy import Boolean, Column, Index, MetaData, Table, UniqueConstraint

from tupli_mcap.storage.catalog.tables import NUMBER, TEXT

METADATA: Final = MetaData()

# Users and groups share one name space: a group with the name of a user would see what is private to that user.
PRINCIPAL: Final = Table(
    "principal",
    METADATA,
    Column("name", TEXT, primary_key=True),
    Column("kind", TEXT, nullable=False),  # user, group or reserved
)

USER: Final = Table(
    "account",
    METADATA,
    Column("name", TEXT, primary_key=True),
    Column("password", TEXT, nullable=False),  # its hash
    Column("epoch", NUMBER, nullable=False),  # tokens of an earlier one are void
    Column("created_at", NUMBER, nullable=False),  # seconds since 1970, as all times here
    Column("quota", NUMBER),  # bytes; NULL where that of the settings holds
)

GROUP: Final = Table("team", METADATA, Column("name", TEXT, primary_key=True), Column("description", TEXT))

ROLE: Final = Table(
    "role",
    METADATA,
    Column("name", TEXT, primary_key=True),
    Column("rights", TEXT, nullable=False),  # JSON: a list
    Column("description", TEXT),
    Column("builtin", Boolean, nullable=False),
)

MEMBERSHIP: Final = Table(
    "membership",
    METADATA,
    Column("user", TEXT, primary_key=True),
    Column("team", TEXT, primary_key=True, index=True),
    Column("role", TEXT, primary_key=True),
)

REFRESH_TOKEN: Final = Table(
    "refresh_token",
    METADATA,
    Column("digest", TEXT, primary_key=True),  # SHA-256: who reads the table has no token
    Column("user", TEXT, nullable=False, index=True),
    Column("family", TEXT, nullable=False, index=True),  # of one sign-in
    Column("used", Boolean, nullable=False),
    Column("expires", NUMBER, nullable=False),
    Column("successor", TEXT),  # the digest of the one for which it was exchanged last
)

API_TOKEN: Final = Table(
    "api_token",
    METADATA,
    Column("id", TEXT, primary_key=True),
    Column("digest", TEXT, nullable=False, unique=True),
    Column("user", TEXT, nullable=False, index=True),
    Column("name", TEXT, nullable=False),
    Column("scope", TEXT, nullable=False),  # read or write
    Column("created_at", NUMBER, nullable=False),
    Column("expires", NUMBER),
)

# A benchmark or an artifact of one owner. Two users may have the same content, each under their own name.
ITEM: Final = Table(
    "item",
    METADATA,
    Column("number", NUMBER, primary_key=True),
    Column("kind", TEXT, nullable=False),  # benchmark or artifact
    Column("id", TEXT, nullable=False),
    Column("created_by", TEXT, nullable=False),
    Column("published_in", TEXT, nullable=False),  # JSON: a list of groups
    Column("header", TEXT, nullable=False),  # JSON: its header, without owner and groups
    Column("content", TEXT),  # a benchmark's environment as text
    Column("needs", TEXT, nullable=False),  # JSON: ids of the artifacts that a benchmark needs
    Column("size", NUMBER, nullable=False, server_default="0"),  # bytes of its content and header
    UniqueConstraint("kind", "id", "created_by"),
    Index("ix_item_id", "id"),
)

# The groups in each list of groups, with which SQL searches `published_in`.
AUDIENCE: Final = Table(
    "audience",
    METADATA,
    Column("published_in", TEXT, primary_key=True),
    Column("team", TEXT, primary_key=True, index=True),
)

# The file of a recording of the catalog, which has its path.
FILE: Final = Table(
    "file",
    METADATA,
    Column("path", TEXT, primary_key=True),
    Column("created_by", TEXT, nullable=False, index=True),
    Column("uuid", TEXT, nullable=False),
    Column("place", TEXT, nullable=False),  # its name among the blobs; a new one for each version
    Column("digest", TEXT, nullable=False),  # SHA-256 in hex digits
    Column("size", NUMBER, nullable=False),
    Column("episodes", NUMBER, nullable=False),  # in the file, deleted ones too
    Column("deleted", TEXT, nullable=False),  # JSON: numbers of episodes
    Column("rank", NUMBER, nullable=False, server_default="0", index=True),  # as in the claim of its owner
    Index("ix_file_uuid_created_by", "uuid", "created_by"),
    Index("ix_file_uuid_rank", "uuid", "rank"),
)

# The users who have stored a recording of a UUID. A claim stays when the recording is deleted: who has waited for that
# does not become the first.
CLAIM: Final = Table(
    "claim",
    METADATA,
    Column("uuid", TEXT, primary_key=True),
    Column("created_by", TEXT, primary_key=True),
    Column("rank", NUMBER, nullable=False),  # how many other users did so before
)

# Files that are being stored or deleted. A clean-up deletes those that the other tables do not name.
PENDING: Final = Table(
    "pending", METADATA, Column("path", TEXT, primary_key=True), Column("since", NUMBER, nullable=False)
)

# Unfinished uploads of recordings; the received bytes are in a file named by the id.
UPLOAD: Final = Table(
    "upload",
    METADATA,
    Column("id", TEXT, primary_key=True),
    Column("user", TEXT, nullable=False, index=True),
    Column("length", NUMBER, nullable=False),
    Column("digest", TEXT, nullable=False),
    Column("sent_before", NUMBER, nullable=False),
    Column("since", NUMBER, nullable=False),
)

# Sign-ups, and passwords that were wrong, of the last minute.
FAILURE: Final = Table(
    "failure",
    METADATA,
    Column("number", NUMBER, primary_key=True),
    Column("key", TEXT, nullable=False, index=True),
    Column("time", NUMBER, nullable=False, index=True),
)

AUDIT: Final = Table(
    "audit",
    METADATA,
    Column("number", NUMBER, primary_key=True),
    Column("time", NUMBER, nullable=False),
    Column("user", TEXT, nullable=False),
    Column("action", TEXT, nullable=False),
    Column("target", TEXT, nullable=False),
    Index("ix_audit_user_action", "user", "action"),
)
