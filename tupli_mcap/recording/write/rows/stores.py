"""What the rows of a recording go into on their way to chunks: a store for each channel, in one journal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tupli_mcap.journal.file import FRAMES_AREA, Journal
from tupli_mcap.journal.logs import EventLog
from tupli_mcap.journal.rows import RowDeriver
from tupli_mcap.mcap.container import Container, Rows
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.channels import Channels
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.write.episodes import EpisodeLog
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.recording.write.rows.single import SingleRows
from tupli_mcap.recording.write.rows.variable import StepLog
from tupli_mcap.recording.write.rows.vector import VectorRows

__all__ = ["Stores"]

_LARGE_ROW = 16 * 1024  # bytes from which a thread compresses the chunks


class Stores:
    """The stores of one recording.

    Args:
        layout, channels: what the stores hold.
        container: counts the messages that are in the file already.
        journal: has the areas of `plan_areas`.
        index: is told of every episode that ends.
        add_chunk: writes a chunk, durably where that is asked for.
        start_chunks: begins to compress several chunks; what it returns writes them, durably where that is asked for.
        vector: steps of sub-environments.
        durable: chunks are on the disk before their rows are used again.
        sealed: rows in the journal carry checksums.
        grow: called with the size of a step that is larger than the journal.

    Attributes:
        rows: of a single environment.
        vector: of sub-environments; a list where messages vary in size.
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
        add_chunk: Callable[[Rows], None],
        start_chunks: Callable[[Sequence[Rows]], Callable[[], None]],
        *,
        vector: bool,
        sealed: bool,
        durable: bool,
        grow: Callable[[int], None],
    ) -> None:
        counts, before_ns = container.counts, container.end_time

        def file_size() -> int:
            return container.position

        rows_area, log_area, buffer = journal.row_area, journal.log_area, journal.buffer
        self.rows: SingleRows | StepLog | None = None
        self.vector: VectorRows | list[StepLog] | None = None
        self._image_rows: dict[str, ImageRows] = {}  # by the name of their area
        self._step_logs: dict[str, StepLog] = {}
        self.images: list[list[ImageRows]] = []
        for leaf, ids in zip(layout.images, channels.images, strict=True):
            names = [f"{leaf.name}/{i}" for i in range(len(ids))]
            sinks = [
                ImageRows(
                    leaf, layout.image_messages[leaf.name], rows_area(name), buffer(name), channel, add_chunk,
                    counts[channel], before_ns, start_chunks if leaf.size >= _LARGE_ROW else None, sealed=sealed,
                )
                for name, channel in zip(names, ids, strict=True)
            ]  # fmt: skip
            self._image_rows.update(zip(names, sinks, strict=True))
            self.images.append(sinks)
        if not layout.constant:
            for i, channel in enumerate(channels.steps):
                name = f"steps/{i}"
                images = [sinks[i] for sinks in self.images]
                log = StepLog(
                    layout,
                    log_area(name),
                    buffer(name),
                    channel,
                    add_chunk,
                    images,
                    counts[channel],
                    before_ns,
                )
                log.grow = grow
                self._step_logs[name] = log
            logs = list(self._step_logs.values())
            if vector:
                self.vector = logs
            else:
                self.rows = logs[0]
        elif vector:
            before = np.array([counts[c] for c in channels.steps], dtype=np.uint32)
            self.vector = VectorRows(
                layout, rows_area("steps"), buffer("steps"), channels.steps, start_chunks, before, before_ns,
                durable=durable, sealed=sealed,
            )  # fmt: skip
        else:
            (channel,) = channels.steps
            self.rows = SingleRows(
                layout, rows_area("steps"), buffer("steps"), channel, add_chunk,
                [sinks[0] for sinks in self.images], counts[channel], RowDeriver(time_ns=before_ns), sealed=sealed,
            )  # fmt: skip
        self.events = EpisodeLog(
            log_area("events"), buffer("events"), add_chunk, channels, counts, index, before_ns, file_size
        )
        self.infos: EventLog | None = None
        if channels.info is not None:
            info = {channels.info: counts[channels.info]}
            self.infos = EventLog(log_area("info"), buffer("info"), add_chunk, info, before_ns, file_size)
        self.frames: list[EventLog] = []
        for i, pair in enumerate(channels.cameras):
            name = f"{FRAMES_AREA}{i}"
            known = {c: counts[c] for c in pair}
            self.frames.append(EventLog(log_area(name), buffer(name), add_chunk, known, before_ns, file_size))

    def flush(self, *, keep_last: bool) -> None:
        """Writes everything that is committed; with `keep_last` not the last event."""
        if isinstance(self.rows, SingleRows):
            self.rows.flush()
        elif isinstance(self.vector, VectorRows):
            self.vector.flush()
        for store in (*self._step_logs.values(), *self._image_rows.values(), self.infos, *self.frames):
            if store is not None:
                store.flush()
        self.events.flush(keep_last=keep_last)

    def let_go(self) -> None:
        """Drops every view of the journal; no store can be used afterwards."""
        vector = self.vector if isinstance(self.vector, VectorRows) else None
        single = self.rows if isinstance(self.rows, SingleRows) else None
        others = (*self._step_logs.values(), *self._image_rows.values(), self.infos, *self.frames)
        for store in (single, vector, *others, self.events):
            if store is not None:
                vars(store).clear()  # views are held by encoders, too, and these by the stores

    def move(self, journal: Journal) -> None:
        """Goes on in another journal: only running records move, for everything must have been flushed."""
        for name, steps in self._step_logs.items():
            steps.move(journal.log_area(name), journal.buffer(name))
        for name, images in self._image_rows.items():
            images.move(journal.row_area(name), journal.buffer(name))
        frames = [(f"{FRAMES_AREA}{i}", log) for i, log in enumerate(self.frames)]
        for name, log in (("events", self.events), ("info", self.infos), *frames):
            if log is not None:
                log.move(journal.log_area(name), journal.buffer(name))
