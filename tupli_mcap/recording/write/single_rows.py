"""Rows of constant size in the journal, and their way into chunks.

`SingleRows` holds the steps of one environment, `ImageRows` the images of one leaf.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.journal.derive import EpisodeRows, StartedEpisode
from tupli_mcap.journal.file import RowArea
from tupli_mcap.journal.rows import RowDeriver, even_rows
from tupli_mcap.journal.seals import STATE, seal
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, CDR_HEADER, RECORD_HEADER
from tupli_mcap.messages.encode_rows import (
    EPISODE_AND_STEP,
    HOLE,
    SEQUENCE_OFFSET,
    ImageSink,
    make_row_encoder,
)
from tupli_mcap.messages.episodes import EpisodeEnd
from tupli_mcap.messages.layout import ImageLayout
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.episodes import EpisodeLog, Foretold
from tupli_mcap.spaces.exact import exact_array
from tupli_mcap.spaces.leaves import Leaf

__all__ = [
    "CHUNKS_PER_HALF",
    "HOLE",
    "ImageRows",
    "SingleRows",
]

# sequence, log_time, publish_time, the CDR header, and the stamp of an image: they follow each other, and one call
# takes a fraction of the time that fields of a structured row do
_IMAGE_HEAD = struct.Struct(f"<IQQ{len(CDR_HEADER)}siI")
# of a single environment: what is done once a half finds cold caches, and takes as long for few rows as for many
CHUNKS_PER_HALF = 2
Sink = Callable[[Rows], None]
StartChunks = Callable[[Sequence[Rows]], Callable[[], None]]  # begins to make chunks; the result writes them


class SingleRows:
    """The step rows of one environment.

    `put` and `put_state` are the generated encoders; `channel` is the MCAP channel, `sink` takes full chunks.
    """

    def __init__(
        self,
        layout: StepLayout,
        area: RowArea,
        buffer: memoryview,
        channel: int,
        sink: Sink,
        images: list[ImageSink],
        first: int = 0,
        deriver: RowDeriver | None = None,
        *,
        sealed: bool = False,
    ) -> None:
        self._sealed = sealed
        self._layout = layout
        self._dtype = layout.step_message.dtype
        self._area = area
        self._buffer = buffer
        self._sequence: Array = np.frombuffer(buffer, self._dtype)["#sequence"].reshape(2, area.rows + 1)
        self._channel = channel
        self._sink = sink
        self._half = 0
        self._chunk = -(-area.rows // CHUNKS_PER_HALF)  # rows
        self._flushed = 0  # rows of the running half that are in the file
        self._deriver = deriver or RowDeriver()
        self._header = layout.step_message.header(channel)
        encoder = self._encoder = make_row_encoder(
            layout, buffer, channel, first, images, self._switch, self._seal if sealed else None
        )
        self.put = encoder.put
        self.put_plain = encoder.put_plain  # while rows tell
        self.put_state = encoder.put_state
        self.put_next = encoder.put_next
        self._offset = encoder.offset
        # what rows tell of their episodes goes there; None while they tell nothing
        self._events: EpisodeLog | None = None
        self._told = 0  # rows of the running half that have told it
        self.asked = False  # for what is told at the next reset
        self._changes = 0  # of what was told; odd while it changes
        self._episodes = EpisodeRows(1, encoder.state_end)
        self._state_end = encoder.state_end
        self._go_to(0)
        self.begin_episode(0)

    @property
    def count(self) -> int:
        """Rows of the channel so far, those of earlier sessions included."""
        return self._encoder.count()

    @property
    def total(self) -> Any:
        """The running episode's return so far; 0 while rows tell of it."""
        return self._encoder.total()

    def begin_episode(self, episode: int) -> None:
        """The rows that follow belong to `episode`."""
        start, prefix = self._offset(), self._prefix(episode)
        self._encoder.begin(prefix, 0.0)
        self._buffer[start : start + len(prefix)] = prefix

    def _prefix(self, episode: int) -> bytes:
        return self._header + EPISODE_AND_STEP.pack(episode, 0)

    # ---- episodes told by rows

    @property
    def can_tell(self) -> bool:
        """True if rows hold all that an episode is."""
        layout = self._layout
        return not self._sealed and layout.reward_space is None and self._state_end > STATE

    @property
    def tells(self) -> bool:
        """True while rows tell of their episodes."""
        return self._events is not None

    def tell_now(self) -> None:
        """What has been asked for: `put_next` has just begun an episode."""
        self.asked = False
        start = self._half * self._area.half
        self._changes += 1
        self._tell(start, (self._offset() - start) // self._area.row_size)
        self._changes += 1

    def ask(self) -> None:
        """Rows tell what they have to tell at the next reset, and not only when they go to the file. For any thread."""
        self.asked = True

    def tell(self, events: EpisodeLog, ended: EpisodeEnd, started: StartedEpisode) -> None:
        """The rows from here on will tell `events` of their episodes, and of the final state of the one that has
        ended just now."""
        self._changes += 1
        self._events = events
        self._told = (self._offset() - self._half * self._area.half) // self._area.row_size
        self._episodes.begin([None])
        self._episodes.wait_for(ended, time.time_ns())
        events.leave_to_rows(started)
        self._changes += 1

    def foretell(self) -> Foretold | None:
        """What rows would tell now; None if that is nothing, or just changes. For any thread."""
        changes, events = self._changes, self._events
        if changes % 2 or events is None:
            return None
        half, row, table = self.committed()
        copy = self._episodes.copy(table[None, half, self._told : row + 1])
        if self._changes != changes:
            return None
        told = events.foretell(copy())
        return told if self._changes == changes else None

    def settle(self, *, over: bool) -> StartedEpisode | None:
        """Rows tell what they have to tell, and from here on nothing; returns the running episode, if it has a row.

        `over`: the last row has ended its episode, and the running one has its final state.
        """
        events = self._events
        if events is None:
            return None
        half = self._half * self._area.half
        row = (self._offset() - half) // self._area.row_size
        self._changes += 1
        self._tell(half, row, {0: self.pending_state()} if over else None)
        self._events = None
        self._changes += 1
        number = int(self._episodes.running[0])
        if number < 0:
            return None
        self._encoder.begin(self._prefix(number), self._episodes.totals.item(0))  # `put_plain` did not count
        return events.take_back(number)

    def _tell(self, half: int, end: int, pending: Mapping[int, bytes] | None = None) -> None:
        """What the rows of a half before `end` tell, and have not told yet."""
        if self._events is None:
            return
        size, told = self._area.row_size, self._told
        self._told = end
        rows = np.frombuffer(self._buffer[half + told * size : half + end * size], self._dtype)
        self._events.extend(self._episodes.take(rows[None], pending))

    def committed(self) -> tuple[int, int, Array]:
        """The running half, its committed rows, and the rows of both halves; for another thread to copy from."""
        half, offset = divmod(self._offset(), self._area.half)
        table: Array = np.frombuffer(self._buffer, self._dtype).reshape(2, self._area.rows + 1)
        return half, offset // self._area.row_size, table

    def pending_state(self) -> bytes:
        """The CDR bytes of the running row's state, as they follow `episode` and `env` in `/final_state`."""
        start = self._offset()
        return bytes(self._buffer[start + BODY + 8 : start + self._state_end])

    def _seal(self, offset: int) -> None:
        end = offset + self._area.row_size
        seal(self._buffer, offset, end, self._buffer[end + STATE : end + self._state_end])

    def _switch(self) -> None:
        """The half is full: go on in the other one, then write this one as a chunk."""
        area, half = self._area, self._half
        self._changes += 1
        # before the other half's last row goes, whose hole may be here
        self._tell(half * area.half, area.rows)
        spare = half * area.half + area.rows * area.row_size
        self._half = 1 - half
        # a power loss may leave a part of what is written over these rows, and not the chunk they are in
        self._sequence[self._half] = HOLE
        start = self._half * area.half
        self._buffer[start : start + self._state_end] = self._buffer[spare : spare + self._state_end]
        flushed, self._flushed = self._flushed, 0
        self._go_to(self._half)
        self._told = 0
        self._changes += 1
        self._emit(half * area.half, flushed, area.rows)

    def _go_to(self, half: int) -> None:
        """The next row is the first one of a half, behind the last one of the other."""
        area = self._area
        start, spare = half * area.half, area.rows * area.row_size
        self._encoder.move(start, area.half - start + spare - area.row_size, start + spare)

    def flush(self) -> None:
        """Writes the rows of the running half that are not in the file yet."""
        start = self._half * self._area.half
        rows = (self._offset() - start) // self._area.row_size
        flushed, self._flushed = self._flushed, rows
        self._changes += 1
        self._tell(start, rows)
        self._changes += 1
        self._emit(start, flushed, rows)

    def _emit(self, start: int, begin: int, end: int) -> None:
        """Writes rows of a half, without holes."""
        size = self._area.row_size
        data: Any = self._buffer[start + begin * size : start + end * size]
        kept = np.frombuffer(data, self._dtype)["#sequence"] != HOLE
        if not kept.all():
            data = memoryview(np.frombuffer(data, f"V{size}")[kept].view(np.uint8))  # padding stays zero
        elif self._sealed:
            data = bytearray(data)  # until the chunk is on the disk, the rows in the journal stay as sealed
        rows = np.frombuffer(data, self._dtype)
        self._deriver.fill(rows)
        for first in range(0, len(rows), self._chunk):
            chunk = rows[first : first + self._chunk]
            part = data[first * size : first * size + chunk.nbytes]
            self._sink(even_rows(self._channel, int(chunk["#sequence"][0]), part, chunk))


class ImageRows:
    """The images of one leaf: row j is the state of step j, so the running row is always one ahead of the steps."""

    def __init__(
        self,
        leaf: Leaf,
        layout: ImageLayout,
        area: RowArea,
        buffer: memoryview,
        channel: int,
        sink: Sink,
        first: int = 0,
        time_ns: int = 0,
        start_chunks: StartChunks | None = None,
        *,
        sealed: bool = False,
    ) -> None:
        self._start_chunks = start_chunks
        self._sealed = sealed
        self._jobs: dict[
            int, Callable[[], None]
        ] = {}  # write a chunk that is being made, by the half it is in
        self._due: tuple[int, int, int, int] | None = None  # a full half: what `_emit` will be given
        self._leaf = leaf
        self._layout = layout
        self._channel = channel
        self._sink = sink
        self._sequence = first
        self._time = time_ns
        self._half = self._row = 0
        self._uint8 = np.dtype(np.uint8)
        self.move(area, buffer)

    def move(self, area: RowArea, buffer: memoryview) -> None:
        """Goes on in another journal, with the rows before the running one in the file: only that one moves."""
        running = self._rows[self._half, self._row].copy() if hasattr(self, "_rows") else None
        self._area = area
        self._full, self._row_size = area.rows, area.row_size
        self._buffer = buffer
        self._row = self._half = self._flushed = self._start = 0
        layout, channel, dtype = self._layout, self._channel, self._layout.dtype
        self._rows: Array = np.frombuffer(buffer, dtype).reshape(2, area.rows + 1)
        self._rows["fixed"] = np.frombuffer(layout.body[8:], np.uint8)
        record = RECORD_HEADER.pack(5, dtype.itemsize - 9, channel, 0, 0, 0) + CDR_HEADER
        template = np.frombuffer(record + bytes(dtype.itemsize - len(record)), dtype)[0]
        for name in ("#opcode", "#length", "#channel", "#cdr"):
            self._rows[name] = template[name]
        self._rows["#sequence"] = HOLE  # zeros would look like the first row as soon as a time is written
        self._data: Array = self._leaf.as_values(self._rows["data"])
        self._times: Array = self._rows["#log_time"]
        self._offsets = np.arange(area.rows, dtype=np.uint64) * np.uint64(area.row_size)
        if running is not None:
            self._rows[0, 0] = running

    def check(self, value: Any) -> Array:
        """`value` as an image of the leaf's shape; StepError if it is none."""
        if type(value) is np.ndarray and value.dtype is self._uint8 and value.shape == self._leaf.shape:
            return value
        return exact_array(value, self._uint8, self._leaf.shape, self._leaf.path)

    def put(self, image: Array) -> None:
        """Writes the image of the state that follows the running row's; every step before must be committed."""
        if self._due is not None:
            self._write_due(self._start_chunks)
        self._row += 1
        self._sequence += 1
        self._start += self._row_size
        if self._row == self._full:
            self._switch()
        self.put_first(image)

    def put_first(self, image: Array) -> None:
        """Overwrites the running row: the image of a reset."""
        self._data[self._half, self._row] = image
        now = time.time_ns()
        if now < self._time:
            now = self._time
        self._time = now
        start, seconds = self._start, now // 10**9
        _IMAGE_HEAD.pack_into(
            self._buffer, start + SEQUENCE_OFFSET,
            self._sequence, now, now, CDR_HEADER, seconds, now - seconds * 10**9,
        )  # fmt: skip
        if self._sealed:
            seal(self._buffer, start, start + self._row_size, b"")

    def rows(self) -> Array:
        """The rows of both halves, for another thread to copy from; their `#sequence` says which they are."""
        return self._rows

    def pending(self) -> bytes:
        """The running row's image."""
        data: bytes = self._data[self._half, self._row].tobytes()
        return data

    def _switch(self) -> None:
        """The half is full: goes on in the other one, whose chunk must be in the file."""
        half, rows, flushed = self._half, self._full, self._flushed
        self._wait(1 - half)
        self._half, self._row, self._flushed = 1 - half, 0, 0
        self._start = self._half * self._area.half
        # not now: the step of its last image is not committed yet, and the file must not have more images than steps
        self._due = (half, flushed, rows, self._sequence - rows + flushed)

    def _write_due(self, start: StartChunks | None) -> None:
        due, self._due = self._due, None
        if due is not None:
            self._emit(*due, start)

    def flush(self) -> None:
        """Writes the rows before the running one; every step before must be committed."""
        self._write_due(None)
        self._wait(1 - self._half)
        flushed, self._flushed = self._flushed, self._row
        self._emit(self._half, flushed, self._row, self._sequence - self._row + flushed, None)

    def _wait(self, half: int) -> None:
        """Until the chunk of a half is in the file; raises what its writing raised."""
        write = self._jobs.pop(half, None)
        if write is not None:
            write()

    def _emit(self, half: int, begin: int, end: int, first: int, start_chunks: StartChunks | None) -> None:
        if begin == end:
            return
        size = self._row_size
        start = half * self._area.half
        data: Any = self._buffer[start + begin * size : start + end * size]
        times = self._times[half, begin:end].copy()
        if self._sealed:
            data = bytearray(data)
            table: Array = np.frombuffer(data, self._rows.dtype)
            table["#publish_time"] = times
        rows = Rows(self._channel, first, data, self._offsets[: end - begin], times)
        if start_chunks is None:
            self._sink(rows)
        else:
            self._jobs[half] = start_chunks([rows])
