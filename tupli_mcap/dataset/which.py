"""Finds the episodes of recordings that a user means: by number, by return, by a filter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from tupli_mcap.dataset.sources import deleted_of, episode_headers
from tupli_mcap.errors import FilterError, Gathered, RecordingError
from tupli_mcap.progress import progress
from tupli_mcap.recording import Recording
from tupli_mcap.schema import (
    BaseFilter,
    EpisodeHeader,
    F,
    FilterEQ,
    check_keys,
    compile_predicate,
    format_filter,
    parse_filter,
)
from tupli_mcap.storage.listing import name_at, recordings_at

WORDS: Final = ("best", "worst", "first", "last", "all")
"""Words in place of an episode's number; best and worst are by return, the first of equal ones."""

_MAX_DIGITS: Final = 10  # an episode's number has 32 bits
Positions = np.ndarray[Any, np.dtype[np.int64]]


def check_choice(text: str, filter: BaseFilter | None = None) -> None:
    """Raises FilterError if `named_positions` would raise it for every recording."""
    for item in text.split(","):
        if item.strip().lower() not in WORDS:
            bounds_of(item.strip(), text)
    if filter is not None:
        check_keys(filter, EpisodeHeader)


def candidates(recording: Recording, filter: BaseFilter | None = None, name: str | None = None) -> Positions:
    """The positions of the episodes that match a filter, without those that the storage has deleted. `name` is that of
    the recording in the filter, by default its own."""
    deleted = deleted_of(recording)
    if filter is None:
        return np.flatnonzero(~np.isin(recording.index["episode"], list(deleted)))
    check_keys(filter, EpisodeHeader)
    matches = compile_predicate(filter, EpisodeHeader)
    headers = episode_headers(recording, name or recording.name, deleted)
    numbers = [header.episode for header in headers if matches(header)]
    return np.flatnonzero(np.isin(recording.index["episode"], numbers))


def named_positions(recording: Recording, text: str, filter: BaseFilter | None = None) -> list[int]:
    """The positions of the episodes that a text such as "3,7-9", "best" or "first,last" names, in its order, each once,
    among the `candidates`.

    Args:
        text: numbers of episodes, ranges (of which only existing numbers count) and `WORDS`, separated by commas.

    Raises:
        FilterError: the text is something else.
        RecordingError: there is no such episode, or none at all.
    """
    among = candidates(recording, filter)
    rows = recording.index[among]
    places = named_places(recording.name, rows["episode"], rows["return"], text, filter)
    return list(among[places].tolist())


def named_places(
    name: str, numbers: Any, returns: Any, text: str, filter: BaseFilter | None = None
) -> list[int]:
    """The places that a text names among the episodes of `name` with these numbers and returns, in its order, each
    once. Raises as `named_positions`."""
    why = "" if filter is None else f" that matches {text_of(filter)}"
    if not len(numbers):
        raise RecordingError(f"{name} has no episode{why}")
    chosen: dict[int, None] = {}
    for item in (item.strip().lower() for item in text.split(",")):
        places = _places_of(item, text, numbers, returns)
        if not places:
            raise RecordingError(
                f"{name} has no episode {item}{why}; choose from {range_text(np.unique(numbers))}"
            )
        chosen.update(dict.fromkeys(places))
    return list(chosen)


def as_filter(test: Any) -> Any:
    """What a text, or a key that is a flag (`F("metadata.good")`), says as a filter; all else as it is."""
    if isinstance(test, F):
        return FilterEQ(key=test.key, value=True)
    return parse_filter(test) if isinstance(test, str) else test


def text_of(filter: BaseFilter) -> str:
    """A filter as users write it in a text, or else as an expression."""
    try:
        return format_filter(filter)
    except FilterError:
        return str(filter)


def numbers_in(
    places: Iterable[Path], text: str | None, filter: BaseFilter | None, gathered: Gathered
) -> dict[tuple[str, str], list[int]]:
    """The numbers of the episodes that a text names in some recordings and directories, by the recording's path and
    UUID; without a text, of those that match the filter. Recordings without one are left out.

    Of a directory, "best", "worst", "first" and "last" are one of all its recordings' episodes, and a number is that
    of each recording which has it, as in `dataset.chosen.chosen_from`.

    `gathered` keeps the errors of recordings that cannot be read, and of recordings and directories that have no such
    episode.

    Raises:
        FilterError: the text is something else, or the filter has an unknown key.
        RecordingError: there is no such recording or directory.
    """
    found: dict[tuple[str, str], dict[int, None]] = {}
    for place in places:
        files: list[tuple[str, str]] = []  # of each episode
        numbers: list[int] = []
        returns: list[float] = []
        listed = recordings_at(place)
        with progress(len(listed), "reading recordings") as bar:
            for file in listed:
                with gathered.keep(), Recording(file) as recording:
                    rows = recording.index[candidates(recording, filter, name_at(place, file))]
                    files += [(file, recording.uuid)] * len(rows)
                    numbers += rows["episode"].tolist()
                    returns += rows["return"].tolist()
                bar.advance(1)
        with gathered.keep():
            chosen = list(range(len(files)))
            if text is not None:
                chosen = named_places(str(place), np.array(numbers), np.array(returns), text, filter)
            for at in chosen:
                found.setdefault(files[at], {})[numbers[at]] = None
    return {file: list(named) for file, named in found.items()}


def _places_of(item: str, text: str, numbers: Any, returns: Any) -> list[int]:
    """The places that one item of a text names, among episodes with these numbers and returns; none if there is none.
    FilterError if the item is no number, no range and no word."""
    if item not in WORDS:
        first, last = bounds_of(item, text)
        return np.flatnonzero((numbers >= first) & (numbers <= last)).tolist()
    if item == "all" or not len(numbers):
        return list(range(len(numbers)))
    if item in ("first", "last"):
        return [0 if item == "first" else len(numbers) - 1]
    return [extreme(item, returns)]


def bounds_of(item: str, text: str, words: Sequence[str] = WORDS) -> tuple[int, int]:
    """The first and the last number of `3` or `7-9` in a text; FilterError, which names the `words` that may stand in
    its place, if it is something else."""
    first, dash, last = (part.strip() for part in item.partition("-"))
    if not all(part.isdecimal() and len(part) <= _MAX_DIGITS for part in (first, last if dash else first)):
        named = " or ".join(filter(None, (", ".join(words[:-1]), words[-1])))
        raise FilterError(
            f"expected numbers of episodes such as '3,7-9', or {named}, found {item[:40]!r} in {text[:80]!r}"
        )
    return int(first), int(last or first)


def extreme(word: str, returns: Any) -> int:
    """The index of the best or worst return; NaN is chosen only if there is no other."""
    if word == "best":
        return int(np.nan_to_num(returns, nan=-np.inf).argmax())
    return int(np.nan_to_num(returns, nan=np.inf).argmin())


def range_text(numbers: Any) -> str:
    """The numbers of episodes (ascending), for people; they may have gaps, from deleted episodes or a filter."""
    low, high = int(numbers[0]), int(numbers[-1])
    if high - low + 1 == len(numbers):
        return f"{low} to {high}" if low < high else f"episode {low} only"
    return f"{len(numbers)} episodes between {low} and {high}"
