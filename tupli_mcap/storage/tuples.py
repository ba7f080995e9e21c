"""Episodes with their tuples, read from recordings."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from tupli_mcap.errors import NotFoundError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import EpisodeHeader, EpisodeItem, RLTuple

__all__ = ["anew", "with_tuples"]

_ATTEMPTS = 5
_T = TypeVar("_T")


def anew(read: Callable[[], _T]) -> _T:
    """What a function lists and reads, asked again if what it had listed was deleted before it was read.

    Raises:
        NotFoundError: that happened five times.
    """
    for _ in range(_ATTEMPTS - 1):
        with contextlib.suppress(NotFoundError):
            return read()
    return read()


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
                if header.episode not in positions:
                    raise NotFoundError(f"episode {header.id} was deleted meanwhile")
                episode = recording.episodes[positions[header.episode]]
                tuples = [
                    RLTuple.from_env_step(s.state, s.action, s.reward, s.terminal, s.timeout, s.info or {})
                    for s in episode
                ]
                # Both are valid already; validating each step again would cost more than reading it.
                yield EpisodeItem.model_construct(**dict(header), tuples=tuples)
