"""Which episodes of which recordings are shown."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence

from tupli_mcap.dataset.choose import choose_episodes
from tupli_mcap.errors import RecordingError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, parse_filter
from tupli_mcap.viewer.plan import Chosen

__all__ = ["Source", "chosen_from"]

Source = Recording | str | os.PathLike[str]
_CACHE_BYTES = 64 << 20  # each chunk is read once or twice


@contextlib.contextmanager
def chosen_from(
    sources: Source | Sequence[Source], episodes: str | Sequence[int] | None, filter: BaseFilter | str | None
) -> Iterator[list[Chosen]]:
    """The chosen episodes of recordings, open within the block.

    Raises:
        RecordingError: a source cannot be opened, or has no such episode.
        FilterError: what names the episodes, or the filter, has no meaning.
    """
    given = [sources] if isinstance(sources, Recording | str | os.PathLike) else list(sources)
    text = (
        "all" if episodes is None else episodes if isinstance(episodes, str) else ",".join(map(str, episodes))
    )
    wanted = parse_filter(filter) if isinstance(filter, str) else filter
    with contextlib.ExitStack() as stack:
        chosen = []
        for source in given:
            recording = (
                source
                if isinstance(source, Recording)
                else stack.enter_context(Recording(source, cache_bytes=_CACHE_BYTES))
            )
            found = choose_episodes(recording, text, wanted)
            chosen.append(Chosen(recording, [episode.position for episode in found]))
        if not chosen:
            raise RecordingError("expected a recording to show, found none; give its path")
        yield chosen
