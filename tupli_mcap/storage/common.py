"""Small things that the files of a storage have in common: ids, groups, JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from tupli_mcap.errors import StorageError

__all__ = ["LOCAL_USER", "first_defect", "is_hash", "published_in", "to_json"]

LOCAL_USER = "local_storage"
"""Who creates what is in a directory; also the name of the only group that sees it."""


def is_hash(value: object) -> bool:
    """Whether something is 64 lower-case hex digits: only such ids become file names."""
    return isinstance(value, str) and len(value) == 64 and set(value) <= set("0123456789abcdef")


def published_in(groups: Sequence[str], group: str) -> list[str]:
    """The groups that see an item, and one more.

    Raises:
        StorageError: That is no name of a group.
    """
    if not isinstance(group, str) or not group or not group.isprintable():
        raise StorageError(f"expected the name of a group to publish in, found {group!r:.80}")
    return [*groups, *([] if group in groups else [group])]


def to_json(value: Mapping[str, Any]) -> bytes:
    """JSON to be read by people too."""
    return json.dumps(value, indent=2, ensure_ascii=False).encode("utf-8")


def first_defect(err: ValidationError) -> str:
    """Where data is wrong, and what is."""
    first = err.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(str(part) for part in first['loc']) or 'the whole'}: {first['msg']}"
