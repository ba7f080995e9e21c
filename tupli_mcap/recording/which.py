"""Which episodes are meant by a text: their numbers, or words such as "best"."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from tupli_mcap.errors import FilterError, RecordingError
from tupli_mcap.recording.recording import Recording

__all__ = ["WORDS", "Positions", "named_positions"]

WORDS: Final = ("best", "worst", "first", "last", "all")
"""What may stand in place of an episode's number; best and worst are by return, the first of equals."""

_MAX_DIGITS: Final = 10  # an episode's number has 32 bits
Positions = np.ndarray[Any, np.dtype[np.int64]]


def named_positions(recording: Recording, among: Positions, text: str, told: str = "") -> list[int]:
    """The positions that a text such as "3,7,9", "best" or "first,last" names, in its order, each once.

    Args:
        among: the positions there are to choose from.
        told: what is true of those and of no others (" that reward > 0 is true of"), for the error.

    Raises:
        FilterError: the text is none of this.
        RecordingError: there is no such episode, or none at all.
    """
    if not len(among):
        raise RecordingError(f"{recording.name} has no episode{told}")
    chosen: dict[int, None] = {}
    for item in text.split(","):
        chosen.update(dict.fromkeys(_named(recording, among, item.strip().lower(), text, told)))
    return list(chosen)


def _named(recording: Recording, among: Positions, item: str, text: str, told: str) -> list[int]:
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
        raise RecordingError(f"{recording.name} has no episode {item}{told}; choose from {_range(numbers)}")
    return [int(found[0])]


def _range(numbers: Any) -> str:
    """The numbers there are: they may have gaps, where episodes were deleted or the filter leaves some out."""
    low, high = int(numbers[0]), int(numbers[-1])
    if high - low + 1 == len(numbers):
        return f"{low} to {high}" if low < high else f"episode {low} only"
    return f"{len(numbers)} episodes between {low} and {high}"
