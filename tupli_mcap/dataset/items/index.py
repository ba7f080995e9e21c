"""Finds the chunks with the steps of listed episodes, once, from the indexes of their recordings."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.segments import Segments, SegmentsBuilder
from tupli_mcap.errors import NotFoundError
from tupli_mcap.mcap.source import CHANGED, FileOfMany, OpenFiles
from tupli_mcap.messages.shared_dtypes import check_layouts
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.columns.chunk_store import ChunkCache, ChunkStore
from tupli_mcap.recording.columns.gather import Files, image_names
from tupli_mcap.recording.columns.read import StoredSteps
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.storage.base import uuid_of


class ListedEpisodes(NamedTuple):
    """Episodes of one recording: the name that opens it, their numbers and listed lengths (int64, both), and its UUID,
    which is empty where the recording is known to be the same."""

    recording: str
    numbers: Array
    lengths: Array
    uuid: str = ""

    @classmethod
    def of(cls, recording: str, headers: Iterable[EpisodeHeader]) -> ListedEpisodes:
        """The episodes of a recording as they are listed."""
        listed = list(headers)
        found = [(header.episode, header.n_tuples) for header in listed]
        numbers, lengths = np.array(found, np.int64).reshape(-1, 2).T
        return cls(recording, numbers, lengths, uuid_of(listed[0]) if listed else "")

    @classmethod
    def each(cls, headers: Iterable[EpisodeHeader]) -> Iterator[ListedEpisodes]:
        """The episodes of each recording; of one whose episodes do not follow each other, several times."""
        for name, same in itertools.groupby(headers, key=lambda header: header.recording):
            yield cls.of(name, same)


def positions_of(recording: Recording, listed: ListedEpisodes) -> Array:
    """The positions of the episodes in the recording's index.
    NotFoundError if it is another recording, or an episode is missing, or shorter than listed: the file was changed."""
    if listed.uuid not in ("", recording.uuid):
        raise NotFoundError(f"{recording.name}: another recording was listed: {CHANGED}")
    numbers = recording.index["episode"].astype(np.int64)
    order = np.argsort(numbers, kind="stable")
    places = np.searchsorted(numbers, listed.numbers, sorter=order)
    positions: Array = order[np.minimum(places, len(order) - 1)] if len(order) else places
    gone = numbers[positions] != listed.numbers if len(order) else np.ones(len(places), np.bool_)
    if not gone.any():
        gone = recording.index["length"][positions] < listed.lengths
    if gone.any():
        raise NotFoundError(
            f"{recording.name}: episode {listed.numbers[int(np.argmax(gone))]} was listed, but is missing or shorter: "
            f"{CHANGED}"
        )
    return positions


@dataclass
class StepIndex:
    """The places of the steps of listed episodes, as rows 0 to n - 1, episode after episode.

    `after` (int64) gives for each episode the state after its last listed step: `-1 - k` is row k of `finals`; a
    number from n on is the row of a step that was recorded after the listing; the number of the last step itself
    means that the state is not known (`unknown`). `finals` are the final states of the episodes `final_numbers`.
    """

    layouts: list[StepLayout]
    names: list[str]  # of the first recording with each layout
    layout_of: list[int]  # of each file
    stores: list[ChunkStore]
    steps: Segments
    images: dict[str, Segments]  # by name of the leaf in the first layout
    finals: Segments
    final_numbers: Array
    lengths: Array
    after: Array
    unknown: Array
    digest: str

    @classmethod
    def of(
        cls,
        listed: Iterable[ListedEpisodes],
        open_recording: Callable[[str], AbstractContextManager[Recording]],
        cache: ChunkCache,
    ) -> StepIndex:
        """Opens one recording after the other.

        Raises:
            NotFoundError: an episode is missing in its recording: the file was changed.
        """
        builder = _Builder(cache)
        for part in listed:
            with open_recording(part.recording) as recording:
                builder.add(recording, part)
        return builder.finish()

    @property
    def files(self) -> Files:
        return Files(self.layouts, self.layout_of, self.stores)

    def check(self, fields: Sequence[str], parts: Sequence[str]) -> None:
        """Raises SpaceError unless one array can hold each of these fields of all recordings, or of their parts."""
        first, *others = (layout.only(parts) for layout in self.layouts)
        for layout, name in zip(others, self.names[1:], strict=True):
            check_layouts(first, self.names[0], layout, name, fields)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "layouts": [layout.to_metadata() for layout in self.layouts]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.layouts = [StepLayout.from_metadata(metadata) for metadata in state["layouts"]]


class _FileEpisodes(NamedTuple):
    """The episodes of one file: rows of its index, and how many steps of each are meant."""

    stored: StoredSteps
    rows: Array
    lengths: Array

    @property
    def known(self) -> Array:
        """Mask of the episodes that ended when they were listed, and whose final state is known."""
        found: Array = (self.rows["final_row"] >= 0) & (self.rows["length"] == self.lengths)
        return found if self.stored.final_channel is not None else np.zeros_like(found)

    @property
    def went_on(self) -> Array:
        """Mask of the episodes that have more steps than were listed."""
        found: Array = self.rows["length"] > self.lengths
        return found


class _Builder:
    """Collects the episodes of one recording after the other."""

    def __init__(self, cache: ChunkCache) -> None:
        self._files, self._cache = OpenFiles(), cache
        self._layouts: list[StepLayout] = []
        self._names: list[str] = []
        self._known: dict[tuple[str, ...], int] = {}
        self._layout_of: list[int] = []
        self._parts: list[_FileEpisodes] = []
        self._digest = hashlib.sha256()

    def add(self, recording: Recording, listed: ListedEpisodes) -> None:
        stored = recording.stored
        source = stored.source
        if stored.where is not None and source.path is not None:
            source = FileOfMany(self._files, stored.where, source.path, source)
        stored = stored._replace(store=stored.store.elsewhere(source, self._cache), source=source)
        rows = recording.index[positions_of(recording, listed)]
        self._layout_of.append(self._layout(recording.name, stored.layout))
        self._parts.append(_FileEpisodes(stored, rows, listed.lengths))
        self._digest.update(f"{recording.uuid} {len(rows)} ".encode())
        self._digest.update(rows["episode"].tobytes() + listed.lengths.tobytes())

    def _layout(self, name: str, layout: StepLayout) -> int:
        key = tuple(layout.to_metadata().values())
        if key not in self._known:
            self._known[key] = len(self._layouts)
            self._layouts.append(layout)
            self._names.append(name)
        return self._known[key]

    def finish(self) -> StepIndex:
        parts = self._parts
        lengths = _joined([part.lengths for part in parts], np.int64)
        known = _joined([part.known for part in parts], np.bool_)
        numbers = _joined([part.rows["episode"][part.known] for part in parts], np.uint32)
        went_on = _joined([part.went_on for part in parts], np.bool_)
        after = np.cumsum(lengths) - 1
        after[known] = -1 - np.arange(len(numbers))
        after[went_on] = lengths.sum() + np.arange(np.count_nonzero(went_on))
        return StepIndex(
            self._layouts,
            self._names,
            self._layout_of,
            [part.stored.store for part in parts],
            self._steps(None),
            {name: self._steps(path) for name, path in image_names(self._layouts).items()},
            self._finals(),
            numbers,
            lengths,
            after,
            ~(known | went_on),
            self._digest.hexdigest(),
        )

    def _steps(self, path: str | None) -> Segments:
        """The places of the steps, or of images of a leaf; then that of the next one of each episode that went on."""
        builder = SegmentsBuilder()
        places = [(*self._places(part, path), part) for part in self._parts]
        for file, (channels, first, part) in enumerate(places):
            builder.add(file, *part.stored.store.locate(channels, first, part.lengths))
        for file, (channels, first, part) in enumerate(places):
            on = part.went_on
            next_rows = first[on] + part.lengths[on]
            builder.add(file, *part.stored.store.locate(channels[on], next_rows, np.ones_like(next_rows)))
        return builder.build()

    def _places(self, part: _FileEpisodes, path: str | None) -> tuple[Array, Array]:
        """The channel of the steps (or images) of each episode, and its first row there."""
        stored = part.stored
        image = next((leaf.name for leaf in stored.layout.images if leaf.path == path), None)
        channels = stored.channels_of(part.rows["env"].astype(np.int64), image)
        return channels, part.rows["first_row"].astype(np.int64)

    def _finals(self) -> Segments:
        builder = SegmentsBuilder()
        for file, part in enumerate(self._parts):
            rows = part.rows["final_row"][part.known].astype(np.int64)
            channels = np.full(len(rows), part.stored.final_channel or 0)
            builder.add(file, *part.stored.store.locate(channels, rows, np.ones_like(rows)))
        return builder.build()


def _joined(parts: list[Array], dtype: Any) -> Array:
    return np.concatenate([np.empty(0, dtype), *parts]).astype(dtype)
