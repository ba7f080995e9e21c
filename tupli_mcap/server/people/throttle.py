"""Limits failed sign-ins. Every function works in the transaction of its caller."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

from sqlalchemy import Connection, delete, func, insert, select

from tupli_mcap.errors import TupliError
from tupli_mcap.server.tables import FAILURE
from tupli_mcap.storage.texts import escape_text

__all__ = ["TooManyError", "note_failure", "seconds_to_wait"]

_SECONDS: Final = 60


class TooManyError(TupliError):
    """There were too many attempts; wait for `seconds`."""

    def __init__(self, seconds: float) -> None:
        super().__init__("too many attempts; wait a minute")
        self.seconds = seconds


def seconds_to_wait(connection: Connection, most: Mapping[str, int]) -> int:
    """The seconds until the next attempt is allowed; 0 for now. most: by key, how many failures a minute may have."""
    now = int(time.time())
    counted = select(FAILURE.c.key, func.count(), func.min(FAILURE.c.time)).group_by(FAILURE.c.key)
    recent = counted.where(FAILURE.c.time > now - _SECONDS, FAILURE.c.key.in_(map(escape_text, most)))
    full = {escape_text(key): allowed for key, allowed in most.items()}
    first = [since for key, count, since in connection.execute(recent) if count >= full[key]]
    return max((since + _SECONDS - now for since in first), default=0)


def note_failure(connection: Connection, most: Mapping[str, int]) -> None:
    """Notes a failure of each key."""
    now = int(time.time())
    connection.execute(delete(FAILURE).where(FAILURE.c.time <= now - _SECONDS))
    rows = [{"key": escape_text(key), "time": now} for key in most]
    if rows:
        connection.execute(insert(FAILURE), rows)
