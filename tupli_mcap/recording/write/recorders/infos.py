"""Chooses the infos of steps that are recorded, puts them into the journal, and splits those of vector environments.

These are a dict as Gymnasium's environments return it, in which a mask `_<key>` says who has an entry; or, from
`DictInfoToList` and from Stable-Baselines3, a list of infos.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap.errors import RecordingError, StepError, did_you_mean, warn
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.recording.write.options import RecordInfo
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import shorten


def entries_of(given: Any, what: str) -> dict[str, Any]:
    """A copy of a dict of entries, empty for None; RecordingError if it is something else."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise RecordingError(f"{what}: expected a dict, found {shorten(given)}")
    return dict(given)


# Gymnasium's, Gymnasium's before 1.0 and ManiSkill's, Stable-Baselines3's
_STATES = ("final_obs", "final_observation", "terminal_observation")
_FINAL = frozenset([*_STATES, "final_info", *(f"_{name}" for name in (*_STATES, "final_info"))])

_STATISTICS = frozenset("rlt")  # the return, length and time of an episode


class InfoRecorder:
    """Chooses infos and puts them into the journal.

    Args:
        select: True for everything, the names of entries, or a function that returns what to record.

    Attributes:
        codec: encodes the entries of a step.
    """

    def __init__(self, select: RecordInfo) -> None:
        if isinstance(select, str):
            select = [select]
        if not isinstance(select, bool) and not callable(select) and isinstance(select, Iterable):
            select = list(select)
        named = isinstance(select, list) and all(isinstance(name, str) for name in select)
        if not (isinstance(select, bool) or callable(select) or named):
            raise RecordingError(
                f"record_info: expected True, False, a list of names or a function, found {select!r:.80}"
            )
        self._names = [] if isinstance(select, bool) or callable(select) else list(dict.fromkeys(select))
        self._unseen = set(self._names)
        self._last: tuple[Any, ...] | None = None  # keys of the last info, while a name is unseen
        self._select = select
        self.codec = InfoCodec(self._names)

    def chosen(self, info: Mapping[str, Any] | None) -> dict[str, Any]:
        """The entries of an environment's info that are to be recorded."""
        if self._select is False:
            return {}
        info = entries_of(info, "info")
        if callable(self._select):
            return entries_of(self._select(info), "record_info: what the function returns")
        if self._select is True:
            return info
        found = {name: info[name] for name in self._names if name in info}
        if self._unseen:
            self._unseen.difference_update(found)
            self._last = tuple(info)
        return found

    def warn_of_unseen(self, path: Path) -> None:
        """Warns once of names that no step's info had, if there were steps."""
        unseen, self._unseen = sorted(self._unseen), set()
        if unseen and self._last is not None:
            said = ", ".join(f"{name!r}{did_you_mean(name, map(str, self._last))}" for name in unseen)
            warn(f"{path}: record_info: no step's info had {said}")

    def put(self, writer: RecordingWriter, episode: int, step: int, info: Mapping[str, Any]) -> None:
        """Appends the entries of one step to the journal."""
        if writer.infos is None or writer.channels.info is None:
            return
        body = self.codec.encode(episode, step, info)
        writer.infos.append(time.time_ns(), (writer.channels.info, body))


# ---- of a vector environment


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

    StepError if there are not as many as sub-environments.
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

    Where there is no `final_info`, the infos of the batch are those of its steps. Where there is, the others are those
    of resets, but for the statistics of a wrapper.
    """
    found, final = info_of(infos, i, n), (infos if isinstance(infos, Mapping) else infos[i]).get("final_info")
    if final is None:
        return found
    if isinstance(infos, Mapping):  # before Gymnasium 1.0, `final_info` is an array of dicts
        final = info_of(final, i, n) if isinstance(final, Mapping) else final[i] or {}
    return {**{key: value for key, value in found.items() if _is_statistics(value)}, **final}


def reset_info_of(infos: Any, i: int, n: int) -> dict[str, Any]:
    """The info of the reset that a same-step autoreset made; see `final_info_of`."""
    if "final_info" not in (infos if isinstance(infos, Mapping) else infos[i]):
        return {}
    return {key: value for key, value in info_of(infos, i, n).items() if not _is_statistics(value)}


def _is_statistics(value: Any) -> bool:
    """Whether Gymnasium's `vector.RecordEpisodeStatistics` has added an entry, which is of the episode that has ended.

    Only what is in it tells: its name is chosen by the caller, and masks of other entries may be the same.
    """
    return isinstance(value, Mapping) and value.keys() == _STATISTICS
