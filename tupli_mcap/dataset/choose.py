"""Which episodes of a recording are meant: by number, by return, by a filter."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from tupli_mcap.dataset.sources import episode_headers
from tupli_mcap.errors import FilterError, RecordingError
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.reader import Recording
from tupli_mcap.schema import BaseFilter, EpisodeHeader, check_keys, compile_predicate
from tupli_mcap.storage.sidecar import Sidecar

__all__ = ["WORDS", "candidates", "choose_among", "choose_episodes"]

WORDS: Final = ("best", "worst", "first", "last", "all")
"""What may stand in place of an episode's number; best and worst are by return, the first of equals."""

_MAX_DIGITS: Final = 10  # an episode's number has 32 bits
Positions = np.ndarray[Any, np.dtype[np.int64]]


def choose_episodes(
    recording: Recording, text: str = "all", filter: BaseFilter | None = None
) -> list[Episode]:
    """The episodes that a text such as "3,7,9", "best" or "first,last" names, in its order, each once.

    Args:
        text: numbers of episodes and `WORDS`, with commas between them.
        filter: the choice is among the episodes it is true of; a number it leaves out is an error.

    Episodes that the recording's storage has deleted are not there.

    Raises:
        FilterError: the text is none of this, or the filter has an unknown key.
        RecordingError: there is no such episode, or none at all.
    """
    among = candidates(recording, filter)
    return [recording.episodes[position] for position in choose_among(recording, among, text, filter)]


def choose_among(
    recording: Recording, among: Positions, text: str, filter: BaseFilter | None = None
) -> list[int]:
    """The positions that a text names, as for `choose_episodes`, among some positions in the recording.

    `filter` is why there are no others; errors say so.

    Raises:
        FilterError: the text is none of this.
        RecordingError: there is no such episode, or none at all.
    """
    if not len(among):
        why = "no episode" if filter is None else f"no episode that {filter} is true of"
        raise RecordingError(f"{recording.name} has {why}")
    chosen: dict[int, None] = {}
    for item in text.split(","):
        chosen.update(dict.fromkeys(_positions(recording, among, item.strip().lower(), text, filter)))
    return list(chosen)


def candidates(recording: Recording, filter: BaseFilter | None) -> Positions:
    """The positions of the episodes that a filter is true of, without those that the storage has deleted."""
    path = recording.path
    deleted = set() if path is None else Sidecar.read(Path(path)).deleted
    numbers = recording.index["episode"].astype(np.int64)
    if filter is None:
        return np.flatnonzero(~np.isin(numbers, list(deleted)))
    check_keys(filter, EpisodeHeader)
    matches = compile_predicate(filter, EpisodeHeader)
    kept = {h.episode for h in episode_headers(recording, recording.name, deleted) if matches(h)}
    return np.flatnonzero(np.isin(numbers, list(kept)))


def _positions(
    recording: Recording, among: Positions, item: str, text: str, filter: BaseFilter | None
) -> list[int]:
    if item == "all":
        return [int(position) for position in among]
    if item in ("first", "last"):
        return [int(among[0 if item == "first" else -1])]
    if item in ("best", "worst"):
        # a return that is not a number is neither
        returns = np.nan_to_num(recording.index["return"][among], nan=-np.inf if item == "best" else np.inf)
        return [int(among[returns.argmax() if item == "best" else returns.argmin()])]
    if not item.isdecimal() or len(item) > _MAX_DIGITS:
        raise FilterError(
            f"expected numbers of episodes such as '3,7,9', or {', '.join(WORDS[:-1])} or {WORDS[-1]}, "
            f"found {item[:40]!r} in {text[:80]!r}"
        )
    numbers = recording.index["episode"][among]
    found = among[numbers == int(item)]
    if not len(found):
        told = "" if filter is None else f" that {filter} is true of"
        raise RecordingError(f"{recording.name} has no episode {item}{told}; choose from {_range(numbers)}")
    return [int(found[0])]


def _range(numbers: Any) -> str:
    """The numbers there are: they may have gaps, where episodes were deleted or the filter leaves some out."""
    low, high = int(numbers[0]), int(numbers[-1])
    if high - low + 1 == len(numbers):
        return f"{low} to {high}" if low < high else f"episode {low} only"
    return f"{len(numbers)} episodes between {low} and {high}"
