"""What stays of episodes that begin later or end earlier in a new recording."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tupli_mcap.errors import RecordingError
from tupli_mcap.recording.edit.copy_episodes import Trim
from tupli_mcap.recording.edit.rewrite import return_of
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.index import chosen_numbers
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.write.rows.variable import final_encoder


def trims_of(source: Recording, steps: Mapping[int, slice]) -> dict[int, Trim]:
    """The trims of those episodes of which not all steps stay.

    An episode that loses its end ends as interrupted, and the state that followed is its final state; whether it
    succeeded is not known, so its recorded metadata have no `success`. An episode that loses its beginning has no seed,
    no options and no reset info, because no reset leads to its first state.

    Args:
        steps: by number of the episode, the steps that stay, numbered from 0.

    Raises:
        RecordingError: there is no such episode, none of its steps would stay, or they are not consecutive.
    """
    numbers = chosen_numbers(source.index, steps, source.name)
    places = np.searchsorted(source.index["episode"], numbers).tolist()
    found = {n: _trim(source, source.episodes[i], steps[n]) for n, i in zip(numbers, places, strict=True)}
    return {number: trim for number, trim in found.items() if trim is not None}


def bounds_of_slice(kept: slice, length: int) -> tuple[int, int]:
    """Where the steps of an episode of `length` steps that stay begin, and where they stop; none stay if it stops there
    or before. RecordingError if they are not consecutive."""
    try:
        start, stop, stride = kept.indices(length)
    except (TypeError, ValueError) as err:
        raise RecordingError(f"expected a slice of steps, found {kept}: {err}") from err
    if stride != 1:
        raise RecordingError(f"expected consecutive steps, found a stride of {stride}")
    return start, stop


def _trim(source: Recording, episode: Episode, kept: slice) -> Trim | None:
    """The trim of an episode; None if all steps stay."""
    start, stop = bounds_of_slice(kept, len(episode))
    if stop <= start:
        raise RecordingError(
            f"{source.name}: no step of episode {episode.number} would stay, which has {len(episode)}; "
            "leave it out, or keep more"
        )
    if (start, stop) == (0, len(episode)):
        return None
    layout = source.layout
    rewards = source.read_steps(episode.position, start, stop, ["rewards"]).rewards
    total = return_of(layout, rewards, stop - start)
    final = None if stop == len(episode) else final_encoder(layout)(episode[stop].state)
    return Trim(start, stop, total, final)
