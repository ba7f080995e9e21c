"""Keeps in an episode's metadata whether it succeeded, as the info of its last step says.

`schema.success` decides what infos and metadata say.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tupli_mcap import jsonvalue
from tupli_mcap.errors import plural, warn
from tupli_mcap.schema.success import KEYS as KEYS, success_of as success_of


def names_success(info: Any) -> bool:
    """Whether an info has a key of `KEYS`."""
    return bool(info) and isinstance(info, Mapping) and any(key in info for key in KEYS)


class FlagCheck:
    """Warns once if the info of a step that ended an episode has a key of `KEYS` with a value that is neither None nor
    a success flag."""

    def __init__(self) -> None:
        self._has_warned = False

    def __call__(self, path: Path, info: Any) -> None:
        if self._has_warned or not names_success(info) or success_of(info) is not None:
            return
        odd = [f"{key}={info[key]!r:.80}" for key in KEYS if info.get(key) is not None]
        if odd:
            self._has_warned = True
            warn(
                f"{path}: expected True, False, 0, 1, or an array of one of these in the info of an episode's last "
                f"step, found {', '.join(odd)}; the episode gets no success (a metadata_callback can say what it is)"
            )


def with_success(metadata: str, info: Any) -> str:
    """Metadata (a JSON text) with `success` from the info of the last step, unless they have such a key."""
    said = success_of(info)
    if said is None:
        return metadata
    known = jsonvalue.loads(metadata)
    return (
        metadata if any(key in known for key in KEYS) else jsonvalue.dumps_plain({**known, "success": said})
    )


def without_success(metadata: str) -> str:
    """Metadata (a JSON text) without the keys of `KEYS`, for an episode that has lost its end."""
    known = jsonvalue.loads(metadata)
    if not isinstance(known, dict) or known.keys().isdisjoint(KEYS):
        return metadata
    return jsonvalue.dumps_plain({key: value for key, value in known.items() if key not in KEYS})


def success_text(share: float, known: int, episodes: int) -> str:
    """The share of successes; with the number of episodes that say it, unless all do."""
    return (
        f"{share:.0%}"
        if known == episodes
        else f"{share:.0%} ({known:,} of {plural(episodes, 'episode')} say it)"
    )


def tells_success(infos: Any) -> bool:
    """Whether the infos of a batch have a key of `KEYS` for any sub-environment."""
    found = [infos] if isinstance(infos, Mapping) else infos
    finals = [info["final_info"] for info in found if info and "final_info" in info]
    finals = [one for final in finals for one in ([final] if isinstance(final, Mapping | None) else final)]
    return any(key in info for info in [*found, *finals] if isinstance(info, Mapping) for key in KEYS)
