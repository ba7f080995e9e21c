"""Rows of a catalog: an episode as it is stored, what is indexed of it, and back as a header."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from functools import reduce
from operator import or_
from typing import Any, Final, NamedTuple

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError
from tupli_mcap.recording.about.success import success_of
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.schema.models import unchecked_header
from tupli_mcap.schema.predicate import MISSING, look_up
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.schema.values import Scalar, classify
from tupli_mcap.storage.base import episode_id
from tupli_mcap.storage.catalog.tables import EPISODE_BITS, FLAGGED_KEYS
from tupli_mcap.storage.texts import escape_text, unescape_text

_INT64_MIN: Final = -(2**63)
_INDEXED_CHARACTERS: Final = 500
_MOST_EXACT: Final = 2.0**53  # below, integers have floats of their own
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
_LARGE: Final = re.compile(r"[eE][+-]?[0-9]{3}|[0-9]{100}")
_TEXT: Final = re.compile(r'"(?:[^"\\]|\\.)*"')


class EpisodeRow(NamedTuple):
    """An episode to catalogue.

    `end` is `terminal`, `timeout` or `interrupted`; `created_at` is in ns since 1970 (UTC); `published_in` is the JSON
    text of a list of group names and `metadata` that of an object, strict JSON as `tupli_mcap.jsonvalue`
    writes it. `run` is the place of its run among those of the recording.
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
    run: int = 0


class StoredRow(NamedTuple):
    """A row of the table `episode`, in the order of its columns."""

    id: int
    recording_id: int
    episode: int
    env: int
    n_tuples: int
    end: str
    episode_return: float | None
    seed: float | None
    created_at: int
    created_by: str
    published_in: str
    metadata: str
    readable: bool
    success: int | None
    run: int
    exact: str | None


_INDEXED: Final = (
    "episode", "env", "n_tuples", "end", "episode_return", "seed", "created_at", "created_by"
)  # fmt: skip


def store_row(recording_id: int, row: EpisodeRow) -> StoredRow:
    """The row as the catalog holds it.
    FormatError if the episode's number is no 32-bit number, or its metadata no JSON object."""
    if not 0 <= row.episode < 1 << EPISODE_BITS:
        raise FormatError(f"expected an episode number below 2**{EPISODE_BITS}, found {row.episode!r}")
    number, seed = row.episode_return, row.seed
    exact: dict[str, Any] = {}
    if number is not None and math.isnan(number):
        exact["episode_return"], number = number, None
    if seed is not None and nearest_float(seed) != seed:
        exact["seed"] = seed
    metadata = _searchable(row.metadata)
    succeeded = success_of(load_metadata(metadata)) if 'success"' in metadata else None
    return StoredRow(
        id=(recording_id << EPISODE_BITS) + row.episode,
        recording_id=recording_id,
        episode=row.episode,
        env=row.env,
        n_tuples=row.n_tuples,
        end=row.end,
        episode_return=number,
        seed=None if seed is None else nearest_float(seed),
        created_at=max(row.created_at // 1000 * 1000, _INT64_MIN),
        created_by=escape_text(row.created_by),
        published_in=row.published_in,
        metadata=metadata,
        readable=_is_readable(metadata),
        success=None if succeeded is None else int(succeeded),
        run=row.run,
        exact=json.dumps(exact) if exact else None,
    )


def header(row: StoredRow, uuid: str, benchmark_id: str, path: str, run: dict[str, Any]) -> EpisodeHeader:
    """The header of a stored row; the other arguments come from its recording, as stored."""
    values = {
        "id": episode_id(uuid, row.episode),
        "created_by": unescape_text(row.created_by),
        "published_in": json.loads(row.published_in),
        "created_at": iso_utc(row.created_at),
        "benchmark_id": unescape_text(benchmark_id),
        "metadata": load_metadata(row.metadata),
        "n_tuples": row.n_tuples,
        "terminated": row.end == "terminal",
        "timeout": row.end == "timeout",
        "end": row.end,
        "episode_return": row.episode_return,
        "seed": None if row.seed is None or math.isinf(row.seed) else int(row.seed),
        "env": row.env,
        "episode": row.episode,
        "recording": unescape_text(path),
        "run": run,
    }
    if row.exact is not None:
        values.update(json.loads(row.exact))
    return unchecked_header(values)


def is_indexed(path: tuple[str, ...]) -> bool:
    """Whether declaring a key puts its values into the table `value`."""
    return len(path) > 1 if path[0] == "metadata" else path[0] in _INDEXED


def indexed_values(row: StoredRow, indexed: Mapping[tuple[str, ...], int]) -> list[tuple[Any, ...]]:
    """The rows of `value` of an episode: its id, a key, number and text at that key, and all flags.

    indexed: the paths of keys, and their numbers.
    """
    metadata, flags, found = load_metadata(row.metadata), 0, []
    for path, key in indexed.items():
        if path[0] != "metadata":
            stored = getattr(row, path[0])
            found.append(
                (key, None, indexed_text(stored)) if isinstance(stored, str) else (key, stored, None)
            )
            continue
        value = look_up(metadata, path[1:])
        if value is MISSING:
            continue
        scalar = classify(value)
        if scalar.kind == "text":
            found.append((key, None, indexed_text(scalar.value)))
        elif scalar.kind in ("number", "bool"):
            found.append((key, nearest_float(scalar.value), None))
        else:
            found.append((key, None, None))
        flags |= _flags(scalar, key)
    return [(row.id, *values, flags) for values in found]


def _flags(scalar: Scalar, key: int) -> int:
    if scalar.kind == "bool":
        return flag_bits([scalar.value], key)
    return flag_bits([True, False], key) if scalar.kind == "other" else 0


def flag_bits(flags: Iterable[bool], key: int) -> int:
    """The bits in `value.flags` which say that the value at a key may be one of some flags; 0 for one of the keys that
    have no place there."""
    if key >= FLAGGED_KEYS:
        return 0
    return reduce(or_, ((1 if flag else 2) << 2 * key for flag in flags), 0)


def indexed_text(text: str) -> str:
    """The indexed part of a text: its beginning, since PostgreSQL indexes no long texts. It has the order of the texts,
    but two texts may have the same beginning."""
    return escape_text(text)[:_INDEXED_CHARACTERS]


def nearest_float(number: float) -> float:
    """The nearest float, which keeps the order of numbers; an infinity for an integer beyond all floats."""
    try:
        return float(number)
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def is_whole(stored: float | str) -> bool:
    """Whether no two numbers have this nearest float, or no two texts this beginning."""
    if isinstance(stored, str):
        return len(stored) < _INDEXED_CHARACTERS
    return abs(stored) < _MOST_EXACT


def load_metadata(text: str) -> Any:
    """The metadata in a stored text."""
    return jsonvalue.loads(text) if '"$' in text else json.loads(text)


def _is_readable(metadata: str) -> bool:
    """Whether PostgreSQL can look into metadata, which have no NUL in a text, and no number that may be beyond its
    floats."""
    if "\\u0000" in metadata:
        return False
    return not (_LARGE.search(metadata) and _LARGE.search(_TEXT.sub("", metadata)))


def _searchable(text: str) -> str:
    """Metadata as a database can hold them, with keys that it reads as Python does.
    FormatError if the text is not a strict JSON object."""
    plain = "\\" not in text and '"$' not in text and (text.isascii() or not _SURROGATE.search(text))
    if plain and text.count("[") + text.count("{") <= jsonvalue.MAX_DEPTH:
        try:
            if isinstance(_STRICT.decode(text), dict):
                return text
        except ValueError:
            pass  # a defect, or a key that occurs twice: the slow way below decides
    value = jsonvalue.loads(text)
    if not isinstance(value, dict):
        raise FormatError(f"expected the metadata of an episode to be a JSON object, found {text!r:.60}")
    return jsonvalue.dumps(value)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        raise ValueError("a key occurs twice")  # Python takes the last one, SQLite the first
    return value


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no JSON")


_STRICT: Final = json.JSONDecoder(object_pairs_hook=_unique, parse_constant=_refuse_constant)
