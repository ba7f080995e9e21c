"""The stores that hold rows until they are in chunks: one for each channel, in an area of one journal."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from tupli_mcap.journal.file import FRAMES_AREA, Area, Journal, LogArea, RowArea
from tupli_mcap.journal.logs import EventLog, ToFile
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.channels import Channels
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.write.episodes import EpisodeLog
from tupli_mcap.recording.write.rows.contract import MovingStore, RowStore
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.recording.write.rows.single import CHUNKS_PER_HALF, SingleRows
from tupli_mcap.recording.write.rows.variable import StepLog, StepLogs
from tupli_mcap.recording.write.rows.vector import VectorRows

_HALF = 8 << 20  # bytes of images in half a journal


def plan_areas(
    layout: StepLayout, n: int, size: int, step_capacity: int, *, vector: bool, infos: bool, frames: bool
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
        journal: has the areas of `plan_areas`.
        index: gets the row of every episode that ends.
        file: where rows go.
        vector: whether the recording is of a vector environment.
        apart: whether its sub-environments step one by one.

    Attributes:
        rows: of a single environment.
        vector: of sub-environments that step together.
        streams: of a single environment, or of sub-environments that step apart, each its own.
        events: starts, ends and final states.
        infos: None where none are recorded.
        frames: pictures and what they show, by sub-environment; empty where none are recorded.
    """

    def __init__(
        self,
        layout: StepLayout,
        channels: Channels,
        journal: Journal,
        index: IndexBuilder,
        file: ToFile,
        *,
        vector: bool,
        apart: bool,
    ) -> None:
        images = [  # by leaf, then by sub-environment
            [
                ImageRows(leaf, layout.image_messages[leaf.name], journal, f"{leaf.name}/{i}", channel, file)
                for i, channel in enumerate(of_leaf)
            ]
            for leaf, of_leaf in zip(layout.images, channels.images, strict=True)
        ]
        of_each = [(channel, [stores[i] for stores in images]) for i, channel in enumerate(channels.steps)]
        self.vector: VectorRows | StepLogs | None = None
        self.streams: Sequence[SingleRows | StepLog] = []
        steps: Sequence[RowStore]
        logs: list[StepLog] = []
        if not layout.constant:
            logs = [StepLog(layout, journal, f"steps/{i}", *each, file) for i, each in enumerate(of_each)]
            self.streams = steps = logs
            self.vector = StepLogs(layout, logs) if vector and not apart else None
        elif vector and not apart:
            self.vector = together = VectorRows(layout, journal, channels.steps, images, file)
            steps = [together]
        else:
            rows = [SingleRows(layout, journal, *each, file, i) for i, each in enumerate(of_each)]
            self.streams = steps = rows
        self.rows = None if vector else self.streams[0]
        self.infos = None if channels.info is None else EventLog(journal, "info", [channels.info], file)
        self.frames = [
            EventLog(journal, f"{FRAMES_AREA}{i}", pair, file) for i, pair in enumerate(channels.cameras)
        ]
        self.events = EpisodeLog(journal, channels, index, file)
        infos = [] if self.infos is None else [self.infos]
        self._moving: list[MovingStore] = [*itertools.chain(*images), *logs, *infos, *self.frames]
        # steps first: the file never has more images than steps
        self._stores: list[RowStore] = list(dict.fromkeys((*steps, *self._moving)))

    def flush(self, *, keep_last: bool) -> None:
        """Writes everything that is committed; with `keep_last` not the last event."""
        for store in self._stores:
            store.flush()
        self.events.flush(keep_last=keep_last)

    def move(self, journal: Journal) -> None:
        """Goes on in another journal: only running records move, for everything must have been flushed."""
        for store in (*self._moving, self.events):
            store.move(journal)

    def let_go(self) -> None:
        """Drops every view of the journal; no store can be used afterwards."""
        for store in (*self._stores, self.events):
            vars(store).clear()  # views are held by encoders, too, and these by the stores
