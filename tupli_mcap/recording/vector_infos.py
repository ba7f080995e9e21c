"""The infos of a vector environment, taken apart by sub-environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

__all__ = ["final_info_of", "info_of"]

_FINAL = ("final_obs", "final_observation", "final_info")


def info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The info of sub-environment `i` of `n`, without what autoreset adds.

    `infos` is a dict as Gymnasium's environments return it, in which a mask `_<key>` says who has an entry; or, from
    `DictInfoToList`, a list of infos. Where there is no mask (inside what wrappers add, and in custom environments), an
    array or list of length `n` has an item for each, and anything else belongs to all.
    """
    if not isinstance(infos, Mapping):
        return {key: value for key, value in (infos[i] or {}).items() if key not in _FINAL}
    found = {}
    for key, value in infos.items():
        if key in _FINAL or _is_mask(infos, key):
            continue
        mask = infos.get(f"_{key}")
        if isinstance(mask, np.ndarray) and not mask[i]:
            continue
        if isinstance(value, dict):
            found[key] = info_of(value, i, n)
        elif isinstance(mask, np.ndarray) or _has_items(value, n):
            found[key] = value[i]
        else:
            found[key] = value
    return found


def _has_items(value: Any, n: int) -> bool:
    if isinstance(value, np.ndarray):
        return bool(value.shape[:1] == (n,))
    return isinstance(value, list | tuple) and len(value) == n


def _is_mask(infos: Mapping[str, Any], key: Any) -> bool:
    if not isinstance(key, str) or not key.startswith("_") or key[1:] not in infos:
        return False
    value = infos[key]
    return isinstance(value, np.ndarray) and value.dtype.type is np.bool_


def final_info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The last info of sub-environment `i` of `n`, whose episode a same-step autoreset ended."""
    if isinstance(infos, Mapping):
        return info_of(infos.get("final_info", {}), i, n)
    return dict((infos[i] or {}).get("final_info") or {})
