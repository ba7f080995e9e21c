"""Chooses the infos of steps that are recorded, puts them into the journal, and splits those of vector environments.

These are a dict as Gymnasium's environments return it, in which a mask `_<key>` says who has an entry; or, from
`DictInfoToList` and from Stable-Baselines3, a list of infos.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue
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


def metadata_json(given: Any, what: str) -> str:
    """The metadata of an episode as JSON; RecordingError unless it is None, or a dict that JSON can hold."""
    try:
        return jsonvalue.dumps_plain(entries_of(given, what))
    except (TypeError, ValueError) as err:
        raise RecordingError(f"{what}: {err}") from err


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


def infos_of(infos: Any, chosen: Sequence[int], n: int) -> list[dict[str, Any]]:
    """The infos of the sub-environments `chosen` of `n`, without what autoreset adds.

    Where a dict has no mask (inside what wrappers add, and in custom environments), an array, tensor or list of length
    `n` has an item for each, and anything else belongs to all.
    """
    if not isinstance(infos, Mapping):
        return [{key: value for key, value in (infos[i] or {}).items() if key not in _FINAL} for i in chosen]
    found: list[dict[str, Any]] = [{} for _ in chosen]
    masks = _masks(infos, n)
    for key, value in infos.items():
        if key in _FINAL or key in masks:
            continue
        if isinstance(value, dict):
            values: Sequence[Any] = infos_of(value, chosen, n)
        else:
            items = _items(value, n)
            values = [value] * len(chosen) if items is None else [items[i] for i in chosen]
        mask = masks.get(f"_{key}")
        for i, info, one in zip(chosen, found, values, strict=True):
            if mask is None or mask[i]:
                info[key] = one
    return found


def _masks(infos: Mapping[str, Any], n: int) -> dict[str, Any]:
    """The entries `_<key>` that are `n` flags, which say who has the entry `<key>`."""
    found = {}
    for key, value in infos.items():
        if not isinstance(key, str) or key[:1] != "_" or key[1:] not in infos:
            continue
        flags = _items(value, n)
        if isinstance(flags, np.ndarray):
            kind = flags.dtype.type
            is_mask = flags.ndim == 1 and (kind is np.bool_ or (kind is np.uint8 and flags.max() <= 1))
        else:
            is_mask = flags is not None and all(isinstance(flag, bool | np.bool_) for flag in flags)
        if is_mask:
            found[key] = flags
    return found


def _items(value: Any, n: int) -> Any:
    """The array, tensor (as an array) or list that has an item for each of `n`; None if the value is no such thing."""
    if isinstance(value, np.ndarray):
        return value if value.shape[:1] == (n,) else None
    if isinstance(value, list | tuple):
        return value if len(value) == n else None
    shape = getattr(value, "shape", None)
    return jsonvalue.array_in(value) if isinstance(shape, tuple) and shape[:1] == (n,) else None


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
        try:
            count = len(given)
        except TypeError:
            raise StepError(f"infos[{name!r}]: expected {len(done)} states, found {shorten(given)}") from None
        if count != len(done):
            raise StepError(f"infos[{name!r}]: expected {len(done)} states, found {count}")
        mask = infos.get(f"_{name}")
        return {i: given[i] for i in ended if (mask is None or mask[i]) and given[i] is not None}
    return {}


def final_infos_of(infos: Any, chosen: Sequence[int], n: int) -> list[dict[str, Any]]:
    """The last infos of the sub-environments `chosen` of `n`, whose episodes a same-step autoreset ended.

    Where there is no `final_info`, the infos of the batch are those of its steps. Where there is, the others are those
    of resets, but for the statistics of a wrapper.
    """
    given = (
        infos.get("final_info")
        if isinstance(infos, Mapping)
        else [(one or {}).get("final_info") for one in infos]
    )
    found = infos_of(infos, chosen, n)
    if given is None:
        return found
    # before Gymnasium 1.0, it is an array of dicts
    finals = infos_of(given, chosen, n) if isinstance(given, Mapping) else [given[i] for i in chosen]
    return [
        info if final is None else {**{key: info[key] for key in info if _is_statistics(info[key])}, **final}
        for info, final in zip(found, finals, strict=True)
    ]


def reset_infos_of(infos: Any, chosen: Sequence[int], n: int) -> list[dict[str, Any]]:
    """The infos of the resets that a same-step autoreset made; see `final_infos_of`."""
    there = ["final_info" in (infos if isinstance(infos, Mapping) else infos[i] or {}) for i in chosen]
    return [
        {key: value for key, value in info.items() if is_there and not _is_statistics(value)}
        for info, is_there in zip(infos_of(infos, chosen, n), there, strict=True)
    ]


def _is_statistics(value: Any) -> bool:
    """Whether Gymnasium's `vector.RecordEpisodeStatistics` has added an entry, which is of the episode that has ended.

    Only what is in it tells: its name is chosen by the caller, and masks of other entries may be the same.
    """
    return isinstance(value, Mapping) and value.keys() == _STATISTICS
