"""Episodes with their tuples, read from recordings."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence

from tupli_mcap.recording import Recording
from tupli_mcap.schema import EpisodeHeader, EpisodeItem, RLTuple

__all__ = ["with_tuples"]


def with_tuples(
    headers: Sequence[EpisodeHeader], open_recording: Callable[[str], Recording]
) -> Iterator[EpisodeItem]:
    """The episodes of headers that are sorted by recording, each with its tuples; a recording is opened once.

    A tuple's values have the type of the space's own samples; the info is empty where none was recorded.
    """
    for name, group in itertools.groupby(headers, key=lambda header: header.recording):
        with open_recording(name) as recording:
            positions = {int(number): i for i, number in enumerate(recording.index["episode"])}
            for header in group:
                episode = recording.episodes[positions[header.episode]]
                tuples = [
                    RLTuple.from_env_step(s.state, s.action, s.reward, s.terminal, s.timeout, s.info or {})
                    for s in episode
                ]
                # Both are valid already; validating each step again would cost more than reading it.
                yield EpisodeItem.model_construct(**dict(header), tuples=tuples)
