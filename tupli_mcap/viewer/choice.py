"""Which episodes of which recordings are shown."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

from tupli_mcap.dataset.choose import choose_episodes
from tupli_mcap.errors import FilterError, RecordingError, TupliError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.episode import Episode
from tupli_mcap.schema import BaseFilter, parse_filter
from tupli_mcap.storage.listing import find_recordings
from tupli_mcap.viewer.plan import Chosen

__all__ = ["Source", "chosen_from"]

Source = Recording | str | os.PathLike[str]
_CACHE_BYTES = 64 << 20  # each chunk is read once or twice
_MOST_OPEN = 200


@contextlib.contextmanager
def chosen_from(
    sources: Source | Sequence[Source], episodes: str | Sequence[int] | None, filter: BaseFilter | str | None
) -> Iterator[list[Chosen]]:
    """The chosen episodes of recordings, open within the block.

    Of a directory, "best", "worst", "first" and "last" are one of all its recordings' episodes, and a number is that of
    each recording which has it; a file in it that cannot be read is left out with a warning.

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
        chosen: list[Chosen] = []
        for source in given:
            if isinstance(source, Recording):
                chosen.append(_chosen(source, choose_episodes(source, text, wanted)))
            elif _is_directory(source):
                chosen += _of_directory(Path(source), text, wanted, stack)
            else:
                recording = stack.enter_context(Recording(source, cache_bytes=_CACHE_BYTES))
                chosen.append(_chosen(recording, choose_episodes(recording, text, wanted)))
        if not chosen:
            raise RecordingError("expected a recording to show, found none; give its path")
        yield chosen


def _is_directory(source: str | os.PathLike[str]) -> bool:
    return "://" not in os.fspath(source) and Path(source).is_dir()


def _chosen(recording: Recording, episodes: Sequence[Episode]) -> Chosen:
    return Chosen(recording, [episode.position for episode in episodes])


def _of_directory(
    folder: Path, text: str, filter: BaseFilter | None, stack: contextlib.ExitStack
) -> list[Chosen]:
    found: dict[str, dict[str, list[Episode]]] = {}  # item -> file -> episodes
    items = list(dict.fromkeys(item.strip().lower() for item in text.split(",")))
    for path in find_recordings(folder):
        try:
            with Recording(path, cache_bytes=_CACHE_BYTES) as recording:
                _collect(recording, str(path), items, filter, found)
        except TupliError as err:
            if isinstance(err, FilterError):
                raise
            warnings.warn(f"{err}; it is left out", stacklevel=4)
    positions: dict[str, dict[int, None]] = {}
    for item in items:
        for file, episodes in _one_of(item, found.get(item, {})).items():
            positions.setdefault(file, {}).update((episode.position, None) for episode in episodes)
    if not positions:
        among = "" if filter is None else f" that {filter} is true of"
        raise RecordingError(
            f"{folder} has no episode {text!r}{among} in any recording; see tupli-mcap ls {folder}"
        )
    if len(positions) > _MOST_OPEN:
        raise RecordingError(
            f"expected episodes of at most {_MOST_OPEN} recordings, found {len(positions)} in {folder}; choose fewer"
        )
    return [
        Chosen(stack.enter_context(Recording(file, cache_bytes=_CACHE_BYTES)), list(chosen))
        for file, chosen in positions.items()
    ]


def _collect(
    recording: Recording,
    file: str,
    items: Sequence[str],
    filter: BaseFilter | None,
    found: dict[str, dict[str, list[Episode]]],
) -> None:
    for item in items:
        with contextlib.suppress(RecordingError):  # another one of the directory may have it
            found.setdefault(item, {})[file] = choose_episodes(recording, item, filter)


def _one_of(item: str, found: dict[str, list[Episode]]) -> dict[str, list[Episode]]:
    """Of what each file has, what is meant of all."""
    if not found or item not in ("best", "worst", "first", "last"):
        return found
    files = list(found)
    if item == "first":
        file = files[0]
    elif item == "last":
        file = files[-1]
    else:
        pick = max if item == "best" else min
        file = pick(files, key=lambda name: found[name][0].return_)
    return {file: found[file]}
