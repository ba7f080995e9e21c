"""Whether an episode succeeded, as an info or metadata say it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

KEYS = ("is_success", "success")
"""The keys that infos and metadata use."""


def success_of(said: Any) -> bool | None:
    """Whether the episode succeeded, from an info or from metadata; None if they have no success flag.

    That is a bool, a number that is 0 or 1, or an array of one of these, as `success` or `is_success`.
    """
    if isinstance(said, Mapping):
        for key in KEYS:
            value = said.get(key)
            if isinstance(value, np.ndarray) and value.size == 1:
                value = value.item()
            if isinstance(value, bool | np.bool_) or (
                isinstance(value, int | float | np.number) and value in (0, 1)
            ):
                return bool(value)
    return None
