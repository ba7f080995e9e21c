"""Which episodes of which recordings are shown."""

from __future__ import annotations

import contextlib
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from tupli_mcap.errors import FilterError, RecordingError, TupliError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.which import named_positions
from tupli_mcap.viewer.plan import Chosen

if TYPE_CHECKING:
    from tupli_mcap.schema import BaseFilter

__all__ = ["Source", "chosen_from"]

Source = Recording | str | os.PathLike[str]
_CACHE_BYTES = 64 << 20  # each chunk is read once or twice
_MOST_OPEN = 200


class _Found(NamedTuple):
    """What an item names in one file."""

    positions: list[int]
    first_return: float


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
    wanted = _parsed(filter) if isinstance(filter, str) else filter
    with contextlib.ExitStack() as stack:
        chosen: list[Chosen] = []
        for source in given:
            if isinstance(source, Recording):
                chosen.append(Chosen(source, _positions(source, text, wanted)))
            elif _is_directory(source):
                chosen += _of_directory(Path(source), text, wanted, stack)
            else:
                recording = stack.enter_context(Recording(source, cache_bytes=_CACHE_BYTES))
                chosen.append(Chosen(recording, _positions(recording, text, wanted)))
        if not chosen:
            raise RecordingError("expected a recording to show, found none; give its path")
        yield chosen


def _is_directory(source: str | os.PathLike[str]) -> bool:
    return "://" not in os.fspath(source) and Path(source).is_dir()


def _parsed(text: str) -> BaseFilter:
    from tupli_mcap.schema import parse_filter

    return parse_filter(text)


def _positions(recording: Recording, text: str, filter: BaseFilter | None) -> list[int]:
    # The storage, and with it its notes of what was deleted, takes half a second to import: a file that was never in
    # one has no such note beside it.
    noted = recording.path is not None and recording.path.with_name(f"{recording.path.name}.json").exists()
    if filter is None and not noted:
        return named_positions(recording, np.arange(len(recording.index)), text)
    from tupli_mcap.dataset.choose import candidates, choose_among

    return choose_among(recording, candidates(recording, filter), text, filter)


def _of_directory(
    folder: Path, text: str, filter: BaseFilter | None, stack: contextlib.ExitStack
) -> list[Chosen]:
    from tupli_mcap.storage.listing import find_recordings

    found: dict[str, dict[str, _Found]] = {}  # item -> file -> what it has
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
        for file, of_file in _one_of(item, found.get(item, {})).items():
            positions.setdefault(file, {}).update(dict.fromkeys(of_file.positions))
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
    found: dict[str, dict[str, _Found]],
) -> None:
    for item in items:
        with contextlib.suppress(RecordingError):  # another one of the directory may have it
            positions = _positions(recording, item, filter)
            first = float(recording.index["return"][positions[0]])
            found.setdefault(item, {})[file] = _Found(positions, first)


def _one_of(item: str, found: dict[str, _Found]) -> dict[str, _Found]:
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
        file = pick(files, key=lambda name: found[name].first_return)
    return {file: found[file]}
