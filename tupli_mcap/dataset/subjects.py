"""What is to be looked at: recordings and which of their episodes, opened one at a time."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset import TupliDataset
from tupli_mcap.dataset.choose import candidates
from tupli_mcap.errors import RecordingError, TupliError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, EpisodeHeader
from tupli_mcap.storage import TupliStorage
from tupli_mcap.storage.listing import find_recordings
from tupli_mcap.storage.sidecar import Notes

__all__ = ["Examinable", "Subject", "subjects_of"]

Examinable: TypeAlias = str | os.PathLike[str] | Recording | TupliDataset | TupliStorage
_CACHE_BYTES = 64 << 20


@dataclass(frozen=True)
class Subject:
    """A recording and how to open it; `choose` gives the positions of the episodes that are meant, in their order.

    error: why it cannot be opened, where that is known already.
    """

    name: str
    open: Callable[[], AbstractContextManager[Recording]]
    choose: Callable[[Recording], Array]
    error: TupliError | None = None


def subjects_of(
    source: Examinable | Iterable[Examinable], episode_filter: BaseFilter | None
) -> Iterator[Subject]:
    """The recordings of a path, a directory, a recording, a dataset, a storage, or several of those.

    Raises:
        RecordingError: it is none of those.
        FilterError: the filter names an unknown field.
    """
    if isinstance(source, str | os.PathLike):
        yield from _of_path(source, episode_filter)
    elif isinstance(source, Recording):
        choose = _all if episode_filter is None else partial(candidates, filter=episode_filter)
        yield Subject(source.name, lambda: nullcontext(source), choose)
    elif isinstance(source, TupliDataset):
        yield from _of_dataset(source if episode_filter is None else _narrowed(source, episode_filter))
    elif isinstance(source, TupliStorage):
        yield from _of_dataset(TupliDataset(source).with_episode_filter(episode_filter))
    elif isinstance(source, Iterable):
        for item in source:
            yield from subjects_of(item, episode_filter)
    else:
        raise RecordingError(f"expected a path, Recording, TupliDataset or storage, found {source!r:.80}")


def _of_path(path: str | os.PathLike[str], episode_filter: BaseFilter | None) -> Iterator[Subject]:
    name = os.fspath(path)
    if "://" in name:
        yield _of_file(name, episode_filter)
        return
    try:
        found = find_recordings(Path(path))
    except TupliError as err:
        yield Subject(name, _unopened, _all, err)
        return
    if not found:
        error = RecordingError(f"{name} holds no recording (.mcap)")
        yield Subject(name, _unopened, _all, error)
    for file in found:
        yield _of_file(str(file), episode_filter)


def _of_file(name: str, episode_filter: BaseFilter | None) -> Subject:
    def choose(recording: Recording) -> Array:
        if episode_filter is not None:
            headers = TupliDataset.from_files(name).with_episode_filter(episode_filter).preview()
            return _positions(recording, headers)
        path = recording.path
        deleted = set() if path is None else Notes.read(path).about(recording.metadata).deleted
        return np.flatnonzero(~np.isin(recording.index["episode"], list(deleted)))

    return Subject(name, lambda: Recording(name, cache_bytes=_CACHE_BYTES), choose)


def _of_dataset(dataset: TupliDataset) -> Iterator[Subject]:
    source = dataset._query.source
    for name, group in itertools.groupby(dataset.preview(), key=lambda header: header.recording):
        headers = list(group)
        yield Subject(
            name,
            lambda name=name: source.open(name),  # type: ignore[misc]
            lambda recording, headers=headers: _positions(recording, headers),  # type: ignore[misc]
        )


def _narrowed(dataset: TupliDataset, episode_filter: BaseFilter) -> TupliDataset:
    own = dataset._query.episode_filter
    return dataset.with_episode_filter(episode_filter if own is None else own & episode_filter)


def _positions(recording: Recording, headers: Iterable[EpisodeHeader]) -> Array:
    wanted = [header.episode for header in headers]
    return np.flatnonzero(np.isin(recording.index["episode"], wanted))


def _all(recording: Recording) -> Array:
    return np.arange(len(recording.index))


def _unopened() -> AbstractContextManager[Recording]:
    raise RecordingError("there is nothing to open")
