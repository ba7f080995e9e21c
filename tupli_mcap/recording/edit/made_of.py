"""What a recording was made of: kept as `made_of.json` by whoever makes one out of others."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any, Final

from tupli_mcap.errors import FormatError
from tupli_mcap.recording.about.run import file_name
from tupli_mcap.recording.recording import Recording

MADE_OF_NAME: Final = "made_of.json"
_MEDIA_TYPE: Final = "application/json"
_MOST: Final = 1 << 22  # bytes of `made_of.json`


def say_made_of(sources: Iterable[Recording], how: str, **facts: Any) -> dict[str, tuple[str, bytes]]:
    """The attachment that names the sources of a new recording.

    Args:
        how: "merge", "filter", "map", "trim".
        facts: what else was decided: the query, the function's name, the steps.
    """
    sources = list(sources)
    document = {
        "how": how,
        **facts,
        "sources": [
            {
                "name": file_name(
                    recording.name
                ),  # folders, and what a URL says besides, are nobody else's business
                "uuid": recording.uuid,
                "episodes": len(recording),
                "sha256": hashlib.sha256(
                    bytes.fromhex(recording.uuid) + recording.index.tobytes()
                ).hexdigest(),
            }
            for recording in sources
        ],
    }
    earlier = [said for recording in sources if (said := _said(recording)) is not None]
    data = json.dumps({**document, "earlier": earlier} if earlier else document).encode()
    if len(data) > _MOST:
        data = json.dumps(document).encode()
    return {MADE_OF_NAME: (_MEDIA_TYPE, data)}


def _said(recording: Recording) -> dict[str, Any] | None:
    try:
        return made_of(recording)
    except FormatError:  # damaged, which says nothing of the steps
        return None


def made_of(recording: Recording) -> dict[str, Any] | None:
    """What a recording says that it was made of, as `schemas/made_of.schema.json` has it; None if it says nothing.

    Raises:
        FormatError: it says something else.
    """
    info = recording.attachments.get(MADE_OF_NAME)
    if info is None:
        return None
    where = f"{recording.name}: {MADE_OF_NAME}"
    if info.size > _MOST:
        raise FormatError(f"{where}: expected at most {_MOST} bytes, found {info.size}")
    try:
        document = json.loads(recording.read_attachment(MADE_OF_NAME))
    except (ValueError, RecursionError) as err:
        raise FormatError(f"{where}: expected JSON, found something else: {err}") from err
    if not isinstance(document, dict) or not isinstance(document.get("sources"), list):
        raise FormatError(f"{where}: expected the sources of a recording, found {document!r:.80}")
    return document
