"""The infos of a vector environment, taken apart by sub-environment.

`infos` are a dict as Gymnasium's environments return it, in which a mask `_<key>` says who has an entry; or, from
`DictInfoToList` and from Stable-Baselines3, a list of infos.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tupli_mcap.errors import StepError
from tupli_mcap.spaces.exact import shorten

# Gymnasium's, Gymnasium's before 1.0 and ManiSkill's, Stable-Baselines3's
_STATES = ("final_obs", "final_observation", "terminal_observation")
_FINAL = frozenset([*_STATES, "final_info", *(f"_{name}" for name in (*_STATES, "final_info"))])


def check_infos(infos: Any, n: int) -> Any:
    """The infos of a batch of `n`; StepError if they are neither a dict nor a list of dicts."""
    if isinstance(infos, Mapping):
        return infos
    if infos is None:
        return {}
    if isinstance(infos, list | tuple) and len(infos) in (0, n):
        found = [{} if info is None else info for info in infos]
        if all(isinstance(info, Mapping) for info in found):
            return found or {}
    raise StepError(f"infos: expected a dict, or a list of {n} dicts, found {shorten(infos)}")


def info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The info of sub-environment `i` of `n`, without what autoreset adds.

    Where a dict has no mask (inside what wrappers add, and in custom environments), an array or list of length `n` has
    an item for each, and anything else belongs to all.
    """
    if not isinstance(infos, Mapping):
        return {key: value for key, value in infos[i].items() if key not in _FINAL}
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


def final_states(infos: Any, done: Any, each: Callable[[Any], list[Any]]) -> dict[int, Any]:
    """The final states that the infos of a batch hold of the sub-environments that are `done`, as far as they do.

    `each` takes a batch of states apart.

    Raises:
        StepError: there are not as many as sub-environments.
    """
    ended = done.nonzero()[0].tolist()
    if not isinstance(infos, Mapping):
        states = ((i, infos[i].get(name)) for i in ended for name in _STATES)
        return {i: state for i, state in states if state is not None}
    for name in _STATES:
        given = infos.get(name)
        if given is None:
            continue
        if isinstance(given, dict | tuple):
            given = each(given)
        if len(given) != len(done):
            raise StepError(f"infos[{name!r}]: expected {len(done)} states, found {len(given)}")
        mask = infos.get(f"_{name}")
        return {i: given[i] for i in ended if (mask is None or mask[i]) and given[i] is not None}
    return {}


def final_info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The last info of sub-environment `i` of `n`, whose episode a same-step autoreset ended.

    Where there is no `final_info`, the infos of the batch are those of its steps.
    """
    if not isinstance(infos, Mapping):
        final = infos[i].get("final_info")
        return info_of(infos, i, n) if final is None else dict(final)
    final = infos.get("final_info")
    if final is None:
        return info_of(infos, i, n)
    if isinstance(final, Mapping):
        return info_of(final, i, n)
    return dict(final[i] or {})  # before Gymnasium 1.0: an array of dicts


def reset_info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The info of the reset that a same-step autoreset made; see `final_info_of`."""
    there = "final_info" in (infos if isinstance(infos, Mapping) else infos[i])
    return info_of(infos, i, n) if there else {}
