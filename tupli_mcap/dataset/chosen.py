"""Finds the episodes that a user means in files, directories, servers, datasets and storages."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple, Protocol, TypeAlias, Union, runtime_checkable

import numpy as np

from tupli_mcap.dataset.items import ListedEpisodes
from tupli_mcap.dataset.items.index import positions_of
from tupli_mcap.dataset.sources import EpisodeSource, FilesSource, StorageSource
from tupli_mcap.dataset.which import Positions, candidates, extreme, named_places, named_positions
from tupli_mcap.errors import RecordingError, TupliError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.index import whole_numbers
from tupli_mcap.remote import is_server, is_url, path_of, shown_name
from tupli_mcap.schema import BaseFilter, EpisodeHeader, parse_filter
from tupli_mcap.storage import TupliStorage
from tupli_mcap.storage.base import by_recording
from tupli_mcap.storage.listing import is_of_several, is_storage, name_at, recordings_at

_CACHE_BYTES: Final = 64 << 20  # each chunk is read once or twice
_MOST_OPEN: Final = 200
Viewable: TypeAlias = Union[Recording, str, os.PathLike[str], "Listed"]
Examinable: TypeAlias = Viewable | TupliStorage


@runtime_checkable
class Listed(Protocol):
    """The part of a `Dataset` or `TupliDataset` that this module needs; it may not import `dataset`."""

    def _episodes(self, filter: BaseFilter | None) -> tuple[EpisodeSource, Sequence[EpisodeHeader]]:
        """The source that opens its recordings, and its episodes that match the filter."""


class Chosen(NamedTuple):
    """Episodes of a recording, by position."""

    recording: Recording
    positions: Sequence[int]


@dataclass(frozen=True)
class Subject:
    """A recording and how to open it.

    Attributes:
        choose: returns the positions of the chosen episodes in order.
        error: why it cannot be opened, if that is known already.
    """

    name: str
    open: Callable[[], AbstractContextManager[Recording]]
    choose: Callable[[Recording], Positions]
    error: TupliError | None = None


def subjects_of(
    source: Examinable | Chosen | Iterable[Examinable | Chosen], episode_filter: BaseFilter | None
) -> Iterator[Subject]:
    """The recordings of a path, a directory, a recording, a dataset (each once), a storage, or several of those.

    The filter does not apply to `Chosen`, which are chosen already.

    Raises:
        RecordingError: it is none of those.
        FilterError: the filter names an unknown field.
    """
    from tupli_mcap.storage import TupliStorage

    if isinstance(source, TupliStorage) or (isinstance(source, str) and is_server(source)):
        stored = _stored(source)
        yield from _of_headers(stored, stored.episodes(episode_filter))
    elif isinstance(source, str | os.PathLike):
        yield from _of_path(os.fspath(source), partial(candidates, filter=episode_filter))
    elif isinstance(source, Recording):
        choose = _all if episode_filter is None else partial(candidates, filter=episode_filter)
        yield Subject(source.name, lambda: nullcontext(source), choose)
    elif isinstance(source, Listed):
        yield from _of_headers(*source._episodes(episode_filter))
    elif isinstance(source, Chosen):  # before other iterables, since it is a tuple
        recording, positions = source
        yield Subject(
            recording.name, lambda: nullcontext(recording), lambda _: np.asarray(positions, np.int64)
        )
    elif isinstance(source, Iterable):
        for item in source:
            yield from subjects_of(item, episode_filter)
    else:
        raise RecordingError(f"expected a path, Recording, Dataset or storage, found {source!r:.80}")


def subjects_once(
    source: Examinable | Iterable[Examinable], episode_filter: BaseFilter | None
) -> Iterator[Subject]:
    """As `subjects_of`, but an episode that is in two files of a directory counts once, and a file in it that cannot be
    read is left out, both with a warning, as in a dataset."""
    if isinstance(source, str | os.PathLike):
        many = _many_at(os.fspath(source))
        if many is not None:
            yield from _of_headers(many, many.episodes(episode_filter))
            return
    elif not isinstance(source, Recording | Listed) and isinstance(source, Iterable):
        for item in source:
            yield from subjects_once(item, episode_filter)
        return
    yield from subjects_of(source, episode_filter)


def _of_path(name: str, choose: Callable[..., Positions]) -> Iterator[Subject]:
    error: TupliError = RecordingError(f"{name} holds no recording (.mcap)")
    try:
        files = recordings_at(name)
    except TupliError as err:
        files, error = [], err
    for file in files:
        named = partial(choose, name=name_at(name, file))
        yield Subject(file, partial(Recording, file, cache_bytes=_CACHE_BYTES), named)
    if not files:
        yield Subject(name, _unopened, _all, error)


def _of_headers(source: EpisodeSource, headers: Iterable[EpisodeHeader]) -> Iterator[Subject]:
    for name, group in by_recording(headers).items():
        listed = ListedEpisodes.of(name, group)
        yield Subject(name, partial(source.open, name, listed.numbers.tolist()), partial(_listed_in, listed))


def _listed_in(listed: ListedEpisodes, recording: Recording) -> Positions:
    """The positions of listed episodes, in order, each once. NotFoundError if it has not all of them any more."""
    return np.unique(positions_of(recording, listed))


def _all(recording: Recording) -> Positions:
    return np.arange(len(recording.index))


def _unopened() -> AbstractContextManager[Recording]:
    raise RecordingError("there is nothing to open")


@contextlib.contextmanager
def chosen_from(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None,
    filter: BaseFilter | str | None,
) -> Iterator[list[Chosen]]:
    """The chosen episodes of recordings, which are open within the block.

    Of a directory, a dataset or a server, "best", "worst", "first" and "last" are one of all its recordings' episodes,
    and a number is that of each recording which has it; a file in a directory that cannot be read is left out with a
    warning.

    Raises:
        RecordingError: a source cannot be opened, or has no such episode.
        FilterError: the choice of episodes, or the filter, is invalid.
    """
    given = [sources] if isinstance(sources, Recording | str | os.PathLike | Listed) else _listed(sources)
    text = "all" if episodes is None else episodes
    if not isinstance(text, str):
        text = ",".join(map(str, whole_numbers(text)))
    wanted = parse_filter(filter) if isinstance(filter, str) else filter
    with ExitStack() as stack:
        chosen: list[Chosen] = []
        for source in given:
            if isinstance(source, Listed):
                chosen += _of_many(*source._episodes(wanted), "the dataset", text, wanted, stack)
                continue
            if not isinstance(source, Recording):
                many = _many_at(os.fspath(source))
                if many is not None:
                    headers = many.episodes(wanted)
                    chosen += _of_many(many, headers, shown_name(os.fspath(source)), text, wanted, stack)
                    continue
                source = stack.enter_context(Recording(source, cache_bytes=_CACHE_BYTES))
            chosen.append(Chosen(source, named_positions(source, text, wanted)))
        if not chosen:
            raise RecordingError("expected a recording to show, found none; give its path")
        yield chosen


@contextlib.contextmanager
def chosen_among(sources: Sequence[str], episodes: str, filter: BaseFilter | None) -> Iterator[list[Chosen]]:
    """As `chosen_from`, but several sources are as one directory of them: "best" is one of all their episodes."""
    if len(sources) == 1:
        with chosen_from(sources, episodes, filter) as chosen:
            yield chosen
        return
    with ExitStack() as stack:
        many = FilesSource(sources)
        where = ", ".join(map(shown_name, sources))
        yield _of_many(many, many.episodes(filter), where, episodes, filter, stack)


def _listed(sources: Any) -> list[Viewable]:
    found = list(sources) if isinstance(sources, Iterable) else [sources]
    for source in found:
        if not isinstance(source, Recording | str | os.PathLike | Listed):
            raise RecordingError(f"expected a recording, its path or a dataset, found {source!r:.80}")
    return found


def extremes(chosen: Sequence[Chosen], title_of: Callable[[Chosen], str]) -> tuple[list[Chosen], list[str]]:
    """The last, the best and the worst of some episodes, each with a caption: `199 (last, best)`, or with a title,
    if they are of several: `199 of ppo-seed3 (last, best)`."""
    returns = np.concatenate([item.recording.index["return"][list(item.positions)] for item in chosen])
    bounds = np.cumsum([0, *(len(item.positions) for item in chosen)])
    words: dict[int, list[str]] = {}
    for word in ("last", "best", "worst"):
        at = len(returns) - 1 if word == "last" else extreme(word, returns)
        words.setdefault(at, []).append(word)
    found: dict[int, list[int]] = {}
    told = []
    for at, said in words.items():
        which = int(np.searchsorted(bounds, at, side="right")) - 1
        recording, positions = chosen[which]
        position = positions[at - int(bounds[which])]
        found.setdefault(which, []).append(position)
        of = f" of {title_of(chosen[which])}" if len(chosen) > 1 else ""
        told.append(f"{recording.index['episode'][position]}{of} ({', '.join(said)})")
    return [Chosen(chosen[which].recording, positions) for which, positions in found.items()], told


def _many_at(place: str) -> EpisodeSource | None:
    """The episodes of a server, a directory or a pattern; None for the place of one recording."""
    if is_server(place):
        return _stored(place)
    if is_url(place) or not is_of_several(place):
        return None
    if is_storage(path_of(place)):
        return _stored(place)
    if not (files := recordings_at(place)):
        raise RecordingError(f"{place} holds no recording (.mcap)")
    return FilesSource(files, of_directory=True)


def _of_many(
    source: EpisodeSource,
    headers: Sequence[EpisodeHeader],
    where: str,
    text: str,
    filter: BaseFilter | None,
    stack: ExitStack,
) -> list[Chosen]:
    """The episodes that a text names among those of a source that match the filter."""
    numbers = np.array([header.episode for header in headers])
    returns = np.array([header.episode_return for header in headers], np.float64)  # None becomes NaN
    named = named_places(where, numbers, returns, text, filter)
    listed = [ListedEpisodes.of(*same) for same in by_recording(headers[i] for i in named).items()]
    if len(listed) > _MOST_OPEN:
        raise RecordingError(
            f"expected episodes of at most {_MOST_OPEN} recordings, found {len(listed)} in {where}; choose fewer"
        )
    chosen = []
    for of in listed:
        recording = stack.enter_context(source.open(of.recording, of.numbers.tolist()))
        chosen.append(Chosen(recording, positions_of(recording, of).tolist()))
    return chosen


def _stored(storage: TupliStorage | str) -> EpisodeSource:
    from tupli_mcap.storage import storage_at

    return StorageSource(storage_at(storage))
