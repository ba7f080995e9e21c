"""The recordings that a recording was made of, and how: `made_of.json`, which every command that edits writes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from typing import Any, Final

from tupli_mcap.errors import FormatError
from tupli_mcap.recording.about.described import MADE_OF_NAME, MAX_MADE_OF
from tupli_mcap.recording.about.run import file_name
from tupli_mcap.recording.recording import Recording

_MEDIA_TYPE: Final = "application/json"


def say_made_of(sources: Iterable[Recording], how: str, **facts: Any) -> dict[str, tuple[str, bytes]]:
    """The attachment that names the sources of a new recording.

    Args:
        how: "merge", "filter", "map", "trim".
        facts: other facts: the query, the function's name, the steps.
    """
    sources = list(sources)
    document = {
        "how": how,
        **facts,
        "sources": [
            {
                "name": file_name(
                    recording.name
                ),  # without the folder, or the rest of a URL, which are private
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
    if len(data) > MAX_MADE_OF:
        data = json.dumps(document).encode()
    return {MADE_OF_NAME: (_MEDIA_TYPE, data)}


def _said(recording: Recording) -> dict[str, Any] | None:
    try:
        return made_of(recording)
    except FormatError:  # damage of this attachment does not concern the steps
        return None


def made_of(recording: Recording) -> dict[str, Any] | None:
    """`Recording.made_of`."""
    return recording.made_of
