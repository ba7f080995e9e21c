"""Which episodes of a recording are meant: by number, by return, by a filter."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tupli_mcap.dataset.sources import episode_headers
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.which import WORDS, Positions, named_positions
from tupli_mcap.schema import BaseFilter, EpisodeHeader, check_keys, compile_predicate
from tupli_mcap.storage.sidecar import Notes

__all__ = ["WORDS", "candidates", "choose_among", "choose_episodes"]


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
    told = "" if filter is None else f" that {filter} is true of"
    return named_positions(recording, among, text, told)


def candidates(recording: Recording, filter: BaseFilter | None) -> Positions:
    """The positions of the episodes that a filter is true of, without those that the storage has deleted."""
    path = recording.path
    deleted = set() if path is None else Notes.read(Path(path)).about(recording.metadata).deleted
    numbers = recording.index["episode"].astype(np.int64)
    if filter is None:
        return np.flatnonzero(~np.isin(numbers, list(deleted)))
    check_keys(filter, EpisodeHeader)
    matches = compile_predicate(filter, EpisodeHeader)
    kept = {h.episode for h in episode_headers(recording, recording.name, deleted) if matches(h)}
    return np.flatnonzero(np.isin(numbers, list(kept)))
