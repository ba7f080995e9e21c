"""The rows of the images of one leaf, in the journal and on their way into chunks."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.journal.file import Journal, RowArea
from tupli_mcap.journal.logs import ToFile, seal
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import CDR_HEADER, HOLE, RECORD_HEADER
from tupli_mcap.messages.layout import SEQUENCE_OFFSET, ImageLayout
from tupli_mcap.spaces.exact import exact_array
from tupli_mcap.spaces.leaves import Leaf

# sequence, log_time, publish_time, the CDR header, and the stamp of an image, which follow each other
_IMAGE_HEAD = struct.Struct(f"<IQQ{len(CDR_HEADER)}siI")


class ImageRows:
    """The images of one leaf: row j is the state of step j, so the running row is always one ahead of the steps."""

    def __init__(
        self, leaf: Leaf, layout: ImageLayout, journal: Journal, name: str, channel: int, file: ToFile
    ) -> None:
        self._name, self._file, self._sealed = name, file, file.sealed
        # write a chunk that is being made, by the half it is in
        self._jobs: dict[int, Callable[[], None]] = {}
        self._due: tuple[int, int, int, int] | None = None  # a full half: what `_emit` will be given
        self._leaf = leaf
        self._layout = layout
        self._channel = channel
        self._sequence = file.counts[channel]
        self._time = file.end_time
        self._half = self._row = 0
        self._uint8 = np.dtype(np.uint8)
        self.move(journal)

    def move(self, journal: Journal) -> None:
        """Goes on in another journal, with the rows before the running one in the file."""
        running = self._rows[self._half, self._row].copy() if hasattr(self, "_rows") else None
        self._area = area = journal.area(self._name, RowArea)
        buffer = journal.buffer(self._name)
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
        self.advance()
        self.put_first(image)

    def advance(self) -> None:
        """Goes on to the next row, which has no image yet; every step before must be committed."""
        self._write_due()
        self._row += 1
        self._sequence += 1
        self._start += self._row_size
        if self._row == self._full:
            self._switch()

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

    def pending(self) -> bytes:
        """The running row's image."""
        data: bytes = self._data[self._half, self._row].tobytes()
        return data

    def _switch(self) -> None:
        """Continues in the other half when one is full; the chunk of the other must be in the file."""
        half, rows, flushed = self._half, self._full, self._flushed
        self._wait(1 - half)
        self._half, self._row, self._flushed = 1 - half, 0, 0
        self._start = self._half * self._area.half
        # not now: the step of its last image is not committed yet, and the file must not have more images than steps
        self._due = (half, flushed, rows, self._sequence - rows + flushed)

    def _write_due(self) -> None:
        if self._due is not None:
            due, self._due = self._due, None
            self._emit(*due)

    def flush(self) -> None:
        """Writes the rows before the running one; every step before must be committed."""
        self._write_due()
        self._wait(1 - self._half)
        flushed, self._flushed = self._flushed, self._row
        self._emit(self._half, flushed, self._row, self._sequence - self._row + flushed)
        self._wait(self._half)

    def _wait(self, half: int) -> None:
        """Waits until the chunk of a half is in the file; raises the error of its writing."""
        write = self._jobs.pop(half, None)
        if write is not None:
            write()

    def _emit(self, half: int, begin: int, end: int, first: int) -> None:
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
        self._jobs[half] = self._file.start_chunks([rows])
