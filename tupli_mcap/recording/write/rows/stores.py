"""The stores that hold rows until they are in chunks: one for each channel, in an area of one journal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from tupli_mcap.journal.committed import RowDeriver
from tupli_mcap.journal.file import FRAMES_AREA, Area, Journal, LogArea, RowArea
from tupli_mcap.journal.logs import EventLog
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.channels import Channels
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.write.episodes import EpisodeLog
from tupli_mcap.recording.write.rows.contract import MovingStore, RowStore, ToFile
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.recording.write.rows.single import CHUNKS_PER_HALF, SingleRows
from tupli_mcap.recording.write.rows.variable import StepLog, StepLogs
from tupli_mcap.recording.write.rows.vector import VectorRows
from tupli_mcap.spaces.leaves import Leaf

_HALF = 8 << 20  # bytes of images in half a journal
_LARGE_ROW = 16 * 1024  # bytes from which a thread compresses the chunks


def plan_areas(
    layout: StepLayout,
    n: int,
    size: int,
    step_capacity: int,
    *,
    vector: bool,
    infos: bool,
    frames: bool = False,
) -> list[Area]:
    """The areas of a journal for `n` sub-environments (of a `vector` environment) and chunks of `size` bytes.

    `step_capacity` is the least room (bytes) for steps of variable size.
    """
    if n > 1:  # one chunk a sub-environment: smaller ones, but never below 64 KiB
        size = max(64 * 1024, size // n)
    areas: list[Area] = []
    if not layout.constant:
        areas += [LogArea(f"steps/{i}", max(size, step_capacity), 2) for i in range(n)]
    else:
        row = layout.step_message.record_size
        chunks = 1 if vector else CHUNKS_PER_HALF
        areas.append(RowArea("steps", row, chunks * max(1, size // row), n))
    for leaf in layout.images:
        row = layout.image_messages[leaf.name].dtype.itemsize
        # of a stack, most rows store one frame
        stored = row // leaf.stored_shape[0] if leaf.kind == "stack" else row
        # images in a chunk, and their bytes, at most; fewer for many sub-environments, whose journals would be large
        most, most_bytes = (32, 3 << 20) if n == 1 else (16, 2 << 20)
        rows = max(1, min(max(size, min(most * stored, most_bytes)) // stored, _HALF // row))
        areas += [RowArea(f"{leaf.name}/{i}", row, rows) for i in range(n)]
    areas.append(LogArea("events", 512 * 1024))
    if infos:
        areas.append(LogArea("info", size))
    if frames:  # pictures are large: a few a chunk
        areas += [LogArea(f"{FRAMES_AREA}{i}", 4 * size) for i in range(n)]
    return areas


class Stores:
    """The stores of one recording.

    Args:
        layout, channels: what the stores hold.
        container: counts the messages that are in the file already.
        journal: has the areas of `plan_areas`.
        index: gets the row of every episode that ends.
        file: where rows go.
        vector: whether the recording is of a vector environment.
        apart: whether its sub-environments step one by one.

    Attributes:
        rows: of a single environment.
        vector: of sub-environments that step together.
        streams: of a single environment, or of sub-environments that step apart, each its own.
        images: by image leaf, then by sub-environment.
        events: starts, ends and final states.
        infos: None where none are recorded.
        frames: pictures and what they show, by sub-environment; empty where none are recorded.
    """

    def __init__(
        self,
        layout: StepLayout,
        channels: Channels,
        container: Container,
        journal: Journal,
        index: IndexBuilder,
        file: ToFile,
        *,
        vector: bool,
        apart: bool = False,
    ) -> None:
        self._layout, self._journal, self._container, self._file = layout, journal, container, file
        self._steps: list[RowStore] = []
        self._moving: dict[str, MovingStore] = {}  # by their area
        self.images = [self._images(*of) for of in zip(layout.images, channels.images, strict=True)]
        self.rows: SingleRows | StepLog | None = None
        self.vector: VectorRows | StepLogs | None = None
        self.streams: Sequence[SingleRows | StepLog] = ()
        if layout.constant and vector and not apart:
            self.vector = self._vector_rows(channels.steps)
        else:
            make = self._single_rows if layout.constant else self._step_log
            self.streams = [make(i, channel) for i, channel in enumerate(channels.steps)]
            if not vector:
                (self.rows,) = self.streams
            elif not apart:
                self.vector = StepLogs(layout, self.streams)  # type: ignore[arg-type]
        self.infos = None if channels.info is None else self._log("info", [channels.info])
        self.frames = [self._log(f"{FRAMES_AREA}{i}", pair) for i, pair in enumerate(channels.cameras)]
        self.events = EpisodeLog(
            journal, "events", file.add_chunk, channels, container.counts, index, container.end_time,
            self._file_size,
        )  # fmt: skip
        # steps first: the file never has more images than steps
        self._stores = list(dict.fromkeys((*self._steps, *self._moving.values())))

    def _images(self, leaf: Leaf, channels: list[int]) -> list[ImageRows]:
        """The stores of an image leaf, by sub-environment."""
        file, found = self._file, []
        start_chunks = file.start_chunks if leaf.size >= _LARGE_ROW else None
        for i, channel in enumerate(channels):
            name = f"{leaf.name}/{i}"
            store = ImageRows(
                leaf, self._layout.image_messages[leaf.name], self._journal, name, channel, file.add_chunk,
                self._container.counts[channel], self._container.end_time, start_chunks, sealed=file.sealed,
            )  # fmt: skip
            self._moving[name] = store
            found.append(store)
        return found

    def _step_log(self, i: int, channel: int) -> StepLog:
        """One sub-environment's steps of variable size."""
        name, images = f"steps/{i}", [stores[i] for stores in self.images]
        store = StepLog(
            self._layout, self._journal, name, channel, self._file.add_chunk, images,
            self._container.counts[channel], self._container.end_time,
        )  # fmt: skip
        store.grow = self._file.grow
        self._steps.append(store)
        self._moving[name] = store
        return store

    def _vector_rows(self, channels: list[int]) -> VectorRows:
        counts = np.array([self._container.counts[channel] for channel in channels], dtype=np.uint32)
        store = VectorRows(
            self._layout, self._journal, "steps", channels, self._file.start_chunks, self.images, counts,
            self._container.end_time, durable=self._file.durable, sealed=self._file.sealed,
        )  # fmt: skip
        self._steps.append(store)
        return store

    def _single_rows(self, i: int, channel: int) -> SingleRows:
        """The steps of one environment, or of one sub-environment that steps apart from the others."""
        images, deriver = [stores[i] for stores in self.images], RowDeriver(time_ns=self._container.end_time)
        store = SingleRows(
            self._layout, self._journal, "steps", channel, self._file.add_chunk, images,
            self._container.counts[channel], deriver, sealed=self._file.sealed, block=i,
        )  # fmt: skip
        self._steps.append(store)
        return store

    def _log(self, name: str, channels: Iterable[int]) -> EventLog:
        counts = {channel: self._container.counts[channel] for channel in channels}
        log = EventLog(
            self._journal, name, self._file.add_chunk, counts, self._container.end_time, self._file_size
        )
        self._moving[name] = log
        return log

    def _file_size(self) -> int:
        return self._container.position

    def flush(self, *, keep_last: bool) -> None:
        """Writes everything that is committed; with `keep_last` not the last event."""
        for store in self._stores:
            store.flush()
        self.events.flush(keep_last=keep_last)

    def move(self, journal: Journal) -> None:
        """Goes on in another journal: only running records move, for everything must have been flushed."""
        self._journal = journal
        for name, store in self._moving.items():
            store.move(journal, name)
        self.events.move(journal, "events")

    def let_go(self) -> None:
        """Drops every view of the journal; no store can be used afterwards."""
        for store in (*self._stores, self.events):
            vars(store).clear()  # views are held by encoders, too, and these by the stores
