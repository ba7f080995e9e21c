"""Whether an episode succeeded, as the info of its last step says it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue

KEYS = ("is_success", "success")
"""What infos and metadata call it."""


def success_of(said: Any) -> bool | None:
    """Whether an info or metadata say that the episode succeeded; None if they do not say."""
    if isinstance(said, dict) and said:
        for key in KEYS:
            value = said.get(key)
            if isinstance(value, bool | np.bool_) or (
                isinstance(value, int | float | np.number) and value in (0, 1)
            ):
                return bool(value)
    return None


def with_success(metadata: str, info: Any) -> str:
    """Metadata (a JSON text) with what the info of the last step says, unless they say it already."""
    said = success_of(info)
    if said is None:
        return metadata
    known = jsonvalue.loads(metadata)
    return (
        metadata if any(key in known for key in KEYS) else jsonvalue.dumps_plain({**known, "success": said})
    )


def tells_success(infos: Any) -> bool:
    """Whether the infos of a batch of sub-environments say it of one of them."""
    found = [infos] if isinstance(infos, Mapping) else infos
    finals = [info["final_info"] for info in found if "final_info" in info]
    finals = [one for final in finals for one in ([final] if isinstance(final, Mapping | None) else final)]
    return any(key in info for info in [*found, *finals] if isinstance(info, Mapping) for key in KEYS)
