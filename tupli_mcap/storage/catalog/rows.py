"""Rows of a catalog: an episode as it is stored, and back as a header."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, Final, NamedTuple

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.schema.models import unchecked_header
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.schema.values import classify, tag_float
from tupli_mcap.storage.catalog.tables import EPISODE_BITS
from tupli_mcap.storage.common import _TO_ESCAPE, escape_text, unescape_text

INT64_MIN: Final = -(2**63)
INT64_MAX: Final = 2**63 - 1

# What SQLite's JSON functions or its text would see differently from Python: escapes (in keys, of NUL, of
# surrogates), tags, and the characters that `escape_text` itself uses.
_UNUSUAL: Final = re.compile('[\\\\\x01\ud7ff\ud800-\udfff]|"\\$')


class EpisodeRow(NamedTuple):
    """An episode to catalogue.

    `end` is `terminal`, `timeout` or `interrupted`; `created_at` is in ns since 1970 (UTC); `published_in` is the JSON
    text of a list of group names and `metadata` that of an object, strict JSON as `tupli_mcap.jsonvalue`
    writes it.
    """

    episode: int
    env: int
    n_tuples: int
    end: str
    episode_return: float | None
    seed: int | None
    created_at: int
    created_by: str
    published_in: str
    metadata: str


class StoredRow(NamedTuple):
    """A row of the table `episode`, in the order of its columns."""

    id: int
    recording_id: int
    episode: int
    env: int
    n_tuples: int
    end: str
    episode_return: float | str | None
    seed: float | str | None
    created_at: int
    created_by: str
    published_in: str
    metadata: str
    original: str | None


def store_row(recording_id: int, row: EpisodeRow) -> StoredRow:
    """The row as the catalog holds it.

    Raises:
        FormatError: The episode's number is no 32-bit number, or its metadata no JSON object.
    """
    if not 0 <= row.episode < 1 << EPISODE_BITS:
        raise FormatError(f"expected an episode number below 2**{EPISODE_BITS}, found {row.episode!r}")
    metadata, original = searchable(row.metadata)
    return StoredRow(
        id=(recording_id << EPISODE_BITS) + row.episode,
        recording_id=recording_id,
        episode=row.episode,
        env=row.env,
        n_tuples=row.n_tuples,
        end=row.end,
        episode_return=store_number(row.episode_return),
        seed=store_number(row.seed),
        created_at=max(row.created_at // 1000 * 1000, INT64_MIN),
        created_by=escape_text(row.created_by),
        published_in=row.published_in,
        metadata=metadata,
        original=original,
    )


def header(row: StoredRow, uuid: str, benchmark_id: str, path: str) -> EpisodeHeader:
    """The header of a stored row; the other arguments come from its recording, as stored."""
    return unchecked_header(
        {
            "id": f"{uuid}-{row.episode}",
            "created_by": unescape_text(row.created_by),
            "published_in": list(_published_in(row.published_in)),
            "created_at": iso_utc(row.created_at),
            "benchmark_id": unescape_text(benchmark_id),
            "metadata": load_metadata(row.metadata if row.original is None else row.original),
            "n_tuples": row.n_tuples,
            "terminated": row.end == "terminal",
            "timeout": row.end == "timeout",
            "end": row.end,
            "episode_return": load_number(row.episode_return),
            "seed": load_number(row.seed),
            "env": row.env,
            "episode": row.episode,
            "recording": unescape_text(path),
        }
    )


def searchable(text: str) -> tuple[str, str | None]:
    """Metadata as SQLite can search it, and as it was given where that differs (else None).

    Raises:
        FormatError: The text is no strict JSON object.
    """
    if not _is_unusual(text):
        try:
            value, end = _SCAN(text, 0)
            if end == len(text) and isinstance(value, dict):
                return text, None
        except (ValueError, StopIteration, RecursionError):
            pass  # a defect, or a key twice: the slow way below decides
    value = jsonvalue.loads(text)
    if not isinstance(value, dict):
        raise FormatError(f"expected the metadata of an episode to be a JSON object, found {text!r:.60}")
    original = json.dumps(json.loads(text)) if _TO_ESCAPE.search(text) else text
    return json.dumps(_search_form(value), ensure_ascii=False, allow_nan=False), original


def load_metadata(text: str) -> dict[str, Any]:
    """The metadata that a stored text stands for."""
    value: dict[str, Any] = jsonvalue.loads(text) if '"$' in text else json.loads(text)
    return value


def load_number(value: float | str | None) -> Any:
    """The number that a stored one stands for: NaN and integers beyond 64 bits are stored as text."""
    if not isinstance(value, str):
        return value
    return math.nan if value == "nan" else int(value)


def _is_unusual(text: str) -> bool:
    if text.isascii():  # the usual case, and several times faster than the expression
        return "\\" in text or '"$' in text
    return _UNUSUAL.search(text) is not None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        raise ValueError("a key occurs twice")  # Python takes the last one, SQLite the first
    return value


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON")


# What `decode` calls, without the time it takes around it.
_SCAN: Final = json.JSONDecoder(object_pairs_hook=_unique, parse_constant=_refuse_constant).scan_once  # type: ignore[attr-defined]


def _search_form(value: object) -> Any:
    """A value as plain JSON that says to SQLite what filters see in it."""
    scalar = classify(value)
    if scalar.kind == "text":
        return escape_text(scalar.value)
    if isinstance(scalar.value, float):
        return tag_float(scalar.value)
    if scalar.kind != "other":
        return scalar.value
    if isinstance(value, Mapping):
        # A key of the user's never is a tag; paths with such keys are not searched by SQLite.
        return {_search_key(key): _search_form(item) for key, item in value.items() if isinstance(key, str)}
    return []


def _search_key(key: str) -> str:
    return f"${key}" if key.startswith("$") else escape_text(key)


def store_number(value: float | None) -> float | str | None:
    if value is None or (isinstance(value, int) and INT64_MIN <= value <= INT64_MAX):
        return value
    return str(value) if isinstance(value, int) or math.isnan(value) else float(value)


@lru_cache(maxsize=1024)
def _published_in(text: str) -> tuple[str, ...]:
    return tuple(json.loads(text))
