"""Message records of variable size in the journal: the events of all channels, and steps without a constant layout.

A log half is a u64 end offset and the records before it. The end is stored after the bytes, in one machine word: it
commits them. A log of events says, too, how long the file was when it took up what the log held before.
"""

from __future__ import annotations

import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from tupli_mcap.errors import FormatError, StepError
from tupli_mcap.messages.exact import exact_array, leaf_value, shorten, structure_check
from tupli_mcap.messages.layout import BODY, CDR_HEADER, RECORD_HEADER
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.container import Rows
from tupli_mcap.recording.durability import STATE, seal
from tupli_mcap.recording.journal import LogArea

__all__ = [
    "FRONT",
    "Encoder",
    "EvenRecords",
    "EventLog",
    "Sink",
    "StepLog",
    "group_records",
    "iter_records",
    "leaf_encoders",
]

Sink = Callable[[Rows], None]
Encoder = Callable[[Any, bytearray, int], None]
_HEADER = 64
_KEPT = 16  # times that a log has gone to the file
FRONT = struct.Struct("<BQHIQ")  # up to publish_time, where a journal keeps a checksum
_LOG_TIME = FRONT.size - 8
_DOUBLE = struct.Struct("<d")
_RUNNING = struct.Struct("<BQHIQQ4sII")  # a record up to its state
_SEQUENCE, _SEQUENCE_AT = struct.Struct("<I"), 11


def iter_records(data: memoryview, start: int = 0) -> Iterator[tuple[int, int, int, int, int]]:
    """(offset, end, channel, sequence, log_time) of the Message records in `data`.

    Raises:
        FormatError: bytes that are no whole Message record.
    """
    while start < len(data):
        if start + BODY > len(data):
            raise FormatError(f"expected a message record at byte {start}, found {len(data) - start} bytes")
        opcode, length, channel, sequence, log_time, _ = RECORD_HEADER.unpack_from(data, start)
        end = start + 9 + length
        if opcode != 5 or length < BODY - 9 or end > len(data):
            raise FormatError(
                f"expected a message record at byte {start}, found opcode {opcode} of {length} bytes"
            )
        yield start, end, channel, sequence, log_time
        start = end


def group_records(data: memoryview, *, sealed: bool = False) -> list[Rows]:
    """The records in `data` by channel, in their order; of a journal (`sealed`), with their `publish_time`."""
    whole = bytes(data)
    groups: dict[int, tuple[int, list[bytes]]] = {}
    for start, end, channel, sequence, _ in iter_records(data):
        groups.setdefault(channel, (sequence, []))[1].append(whole[start:end])
    return [_rows_of(channel, *group, sealed=sealed) for channel, group in groups.items()]


class EvenRecords(bytes):
    """Several records of one channel, each of `size` bytes."""

    size: int

    @classmethod
    def of(cls, table: np.ndarray[Any, Any]) -> EvenRecords:
        """The rows of a table."""
        records = cls(table.tobytes())
        records.size = table.dtype.itemsize
        return records


def _count(records: bytes) -> int:
    return len(records) // records.size if isinstance(records, EvenRecords) else 1


def _rows_of(channel: int, first: int, records: list[bytes], *, sealed: bool) -> Rows:
    """Whole records of one channel, of which the first has sequence `first`."""
    sizes = np.repeat(
        [one.size if isinstance(one, EvenRecords) else len(one) for one in records],
        [_count(one) for one in records],
    )
    return _as_rows(channel, first, bytearray().join(records), sizes, sealed=sealed)


def _as_rows(channel: int, first: int, joined: bytearray, sizes: Any, *, sealed: bool) -> Rows:
    offsets = np.zeros(len(sizes), dtype=np.uint64)
    np.cumsum(sizes[:-1], out=offsets[1:])
    log_times = offsets[:, None] + np.arange(_LOG_TIME, _LOG_TIME + 8, dtype=np.uint64)
    content = np.frombuffer(joined, np.uint8)
    times = content[log_times]
    if sealed:  # a journal keeps checksums there
        content[log_times + np.uint64(8)] = times
    return Rows(channel, first, joined, offsets, times.reshape(-1).view("<u8"))


class EventLog:
    """Records of several channels in one half; when it is full they go to the file, a chunk a channel.

    `sequences` counts the messages of each channel, those of earlier sessions included; `latest_ns` is the log_time of
    the last message, and that of the next one is not less.
    """

    def __init__(
        self,
        area: LogArea,
        buffer: memoryview,
        sink: Sink,
        sequences: dict[int, int],
        time_ns: int,
        file_size: Callable[[], int],
    ) -> None:
        self.sequences = sequences
        self._sink = sink
        self._file_size = file_size
        self.latest_ns = time_ns
        # what the journal holds by channel, so that a flush need not take it apart
        self._whole: defaultdict[int, list[bytes]] = defaultdict(list)
        # what it held before that, newest last; None while nobody wants it
        self._written: tuple[Mapping[int, list[bytes]], ...] | None = None
        self._last = 0  # where the last message began
        self._last_channel = 0
        self._can_drop = False
        self.move(area, buffer)

    def move(self, area: LogArea, buffer: memoryview) -> None:
        """Goes on in another journal; everything must have been flushed."""
        self._records = buffer[_HEADER : _HEADER + area.capacity]
        self._commit, self._behind = buffer[:8].cast("Q"), buffer[8:16].cast("Q")
        self._capacity = area.capacity
        self._position = 0
        self._behind[0] = self._file_size()
        self._commit[0] = 0

    def append(self, time_ns: int, *messages: tuple[int, bytes]) -> int:
        """Adds messages (channel, CDR body), all or none of them after a crash; returns their log_time."""
        if time_ns > self.latest_ns:
            self.latest_ns = time_ns
        else:
            time_ns = self.latest_ns
        size = 0
        for _, body in messages:
            size += BODY + len(body)
        if self._position + size > self._capacity:
            self.flush()
        fits = size <= self._capacity
        sequences, position, channel = self.sequences, self._position, 0
        self._last = position
        for channel, body in messages:
            sequences[channel] = 1 + (sequence := sequences[channel])
            front = FRONT.pack(5, BODY - 9 + len(body), channel, sequence, time_ns)
            tail = CDR_HEADER + body
            record = front + crc32(tail, crc32(front)).to_bytes(8, "little") + tail
            self._whole[channel].append(record)
            if fits:
                begin, position = position, position + len(record)
                self._records[begin:position] = record
        if not fits:
            self._write()
            self._can_drop = False
            return time_ns
        self._last_channel, self._can_drop = channel, True
        self._position = self._commit[0] = position
        return time_ns

    def committed(self) -> memoryview:
        """The records in the journal, for another thread to copy from."""
        return self._records[: self._commit[0]]

    def keep_written(self) -> None:
        """From now on, what goes to the file is kept for a while, for those who watch."""
        self._written = self._written or ()

    def newest(self, firsts: Mapping[int, int]) -> list[tuple[int, int, int, bytes]]:
        """(channel, sequence, log_time, CDR message) of the records of channels from a sequence on; for another thread.

        Those that have gone to the file are there since `keep_written`, for a while.
        """
        whole = (
            self._whole
        )  # before `_written`: what goes to the file meanwhile is found twice, and not missed
        halves = [*(self._written or ()), whole]
        found: dict[tuple[int, int], tuple[int, bytes]] = {}
        for channel, first in firsts.items():
            for half in halves:
                for group in reversed(list(half.get(channel, ()))):
                    for start, end, _, sequence, time_ns in iter_records(memoryview(group)):
                        if sequence >= first:
                            message = group[start + RECORD_HEADER.size : end]
                            found[channel, sequence] = time_ns, message
                    if sequence < first:
                        break
        return [(*key, *found[key]) for key in sorted(found)]

    def drop_last(self, channel: int) -> None:
        """Takes back the message of the last `append`, which was one of `channel`, unless it is in the file already."""
        if not self._can_drop:
            return
        self._whole[channel].pop()
        self._position = self._last
        self._commit[0] = self._last
        self.sequences[channel] -= 1

    def flush(self, *, keep_last: bool = False) -> None:
        """Writes the records to the file; with `keep_last` the last one stays, so that it can still be dropped."""
        keep_last = keep_last and self._can_drop
        kept = self._whole[self._last_channel].pop() if keep_last else b""
        self._write(1 if keep_last else 0)
        if keep_last:
            self._whole[self._last_channel].append(kept)
        self._commit[0] = 0
        self._records[: len(kept)] = kept
        self._last, self._position, self._can_drop = 0, len(kept), keep_last
        self._commit[0] = len(kept)

    def _write(self, kept: int = 0) -> None:
        """Writes the records to the file, but the last `kept` of the last channel, which are taken out."""
        whole = self._whole
        if self._written is not None:
            self._written = (*self._written, whole)[-_KEPT:]
        self._whole = defaultdict(list)
        for channel, records in whole.items():
            if records:
                before = sum(map(_count, records)) + (kept if channel == self._last_channel else 0)
                self._sink(_rows_of(channel, self.sequences[channel] - before, records, sealed=True))
        self._behind[0] = self._file_size()


def leaf_encoders(layout: StepLayout, leaves: Sequence[Leaf]) -> list[tuple[Leaf, Encoder]]:
    """Appending CDR encoders of the given leaves."""
    return [(leaf, _encoder(layout, leaf)) for leaf in leaves]


def _encoder(layout: StepLayout, leaf: Leaf) -> Encoder:
    if leaf.kind == "variable":
        return layout.variable[leaf.name].encode
    to_bytes, itemsize = _to_bytes(leaf, layout.dtypes[leaf.name]), layout.dtypes[leaf.name].itemsize

    def encode(value: Any, out: bytearray, origin: int) -> None:
        data = to_bytes(value)
        if data:
            if padding := -(len(out) - origin) % itemsize:
                out += bytes(padding)
            out += data

    return encode


def _to_bytes(leaf: Leaf, dtype: np.dtype[Any]) -> Callable[[Any], bytes]:
    """The bytes of a leaf's values; StepError if one is not stored exactly."""
    shape, itemsize, signed = leaf.shape, dtype.itemsize, dtype.kind == "i"
    array, scalar = np.ndarray, dtype.type if shape == () else np.ndarray
    integer = int if shape == () and dtype.kind in "iu" else None
    double = float if shape == () and dtype == np.float64 else None

    def convert(value: Any) -> bytes:
        kind = value.__class__
        if (kind is array or kind is scalar) and value.dtype == dtype and value.shape == shape:
            return value.tobytes()  # type: ignore[no-any-return]
        if kind is double:
            return _DOUBLE.pack(value)
        if kind is integer:
            try:
                return value.to_bytes(itemsize, "little", signed=signed)  # type: ignore[no-any-return]
            except OverflowError:
                pass  # said below
        return exact_array(value, dtype, shape, leaf.path).tobytes()

    return convert


class PreparedState(NamedTuple):
    """A state encoded: its record as far as it goes, and its images."""

    record: bytearray
    images: list[Any]


class PreparedStep(NamedTuple):
    """A step encoded: its whole record but the header, what it adds to the return, and the state after it."""

    record: bytearray
    reward: float
    after: PreparedState


class StepLog:
    """The steps of one environment whose messages vary in size.

    A record starts with its state, so the running record's state is in the journal before its action is known.
    """

    def __init__(
        self,
        layout: StepLayout,
        area: LogArea,
        buffer: memoryview,
        channel: int,
        sink: Sink,
        images: Sequence[Any],
        first: int = 0,
        time_ns: int = 0,
    ) -> None:
        self._layout = layout
        self._channel = channel
        self._sink = sink
        self._images = images
        self._episode = 0
        self._step = 0
        self._time = time_ns
        self._pending = bytearray()
        self._check_state = structure_check(layout.observation_space, "state")
        self._check_action = structure_check(layout.action_space, "action")
        self._state = leaf_encoders(layout, [leaf for leaf in layout.state if not leaf.apart])
        self._action = leaf_encoders(layout, layout.action)
        self._reward = leaf_encoders(layout, layout.reward)
        self.count = first
        self.total: Any = 0.0
        self.grow: Callable[[int], None] | None = None
        self.move(area, buffer)

    def move(self, area: LogArea, buffer: memoryview) -> None:
        """Goes on in another journal, with everything committed in the file: only the running record moves."""
        self._area = area
        self._records = [buffer[h * area.half + _HEADER : (h + 1) * area.half] for h in range(2)]
        self._ends = [buffer[h * area.half : h * area.half + 8].cast("Q") for h in range(2)]
        self._half = self._position = self._emitted = 0
        self._sizes: list[int] = []  # of the records that are not in the file yet
        self._write_pending(0)

    def begin_episode(self, episode: int) -> None:
        """The records from the running one on belong to `episode`."""
        self._episode, self._step, self.total = episode, 0, 0.0
        if self._pending:
            self._number(self._pending)
            self._write_pending(self._position)

    def prepare_state(self, state: Any) -> PreparedState:
        """A state as `commit_state` takes it; StepError if it cannot be stored exactly."""
        self._check_state(state)
        out = bytearray(BODY + 8)
        self._encode(out, self._state, state)
        images = [
            sink.check(leaf_value(state, leaf))
            for sink, leaf in zip(self._images, self._layout.images, strict=True)
        ]
        return PreparedState(out, images)

    def commit_state(self, prepared: PreparedState) -> None:
        """Starts the running record over: the state of a reset."""
        self._reserve(len(prepared.record))
        self._pending = prepared.record
        self._number(self._pending)
        self._write_pending(self._position)
        for sink, image in zip(self._images, prepared.images, strict=True):
            sink.put_first(image)

    def prepare(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> PreparedStep:
        """A step as `commit` takes it; StepError if it cannot be stored exactly."""
        self._check_action(action)
        out = bytearray(self._pending)
        self._encode(out, self._action, action)
        self._encode(out, self._reward, reward)
        try:
            out += bytes((bool(terminal), bool(timeout)))
        except ValueError as err:
            raise StepError(
                f"expected terminal and timeout to be true or false, found {shorten((terminal, timeout))}"
            ) from err
        return PreparedStep(out, self._layout.reward_total(reward), self.prepare_state(state))

    def commit(self, prepared: PreparedStep) -> None:
        """Completes and commits the running record; the prepared state starts the next one."""
        out, pending = prepared.record, prepared.after.record
        self._reserve(len(out) + len(pending))
        self._time = max(time.time_ns(), self._time)
        out[BODY : BODY + 8] = self._pending[BODY : BODY + 8]  # a new episode may have begun in between
        size = len(out)
        FRONT.pack_into(out, 0, 5, size - 9, self._channel, self.count, self._time)
        seal(out, 0, size, pending[STATE:])
        records, start = self._records[self._half], self._position
        end = start + size
        records[start:end] = out
        self.count += 1
        self._step += 1
        self._pending = pending
        self._number(pending)
        self._write_pending(end)
        for sink, image in zip(self._images, prepared.after.images, strict=True):
            sink.put(image)
        self._ends[self._half][0] = end
        self._position = end
        self._sizes.append(size)
        self.total += prepared.reward

    def put_state(self, state: Any) -> None:
        """`commit_state` of `prepare_state`."""
        self.commit_state(self.prepare_state(state))

    def put(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """`commit` of `prepare`."""
        self.commit(self.prepare(action, state, reward, terminal, timeout))

    def _number(self, pending: bytearray) -> None:
        """Says in a record that is not complete which one it will be; a length of 0 marks it as such."""
        _RUNNING.pack_into(
            pending, 0, 5, 0, self._channel, self.count, 0, 0, CDR_HEADER, self._episode, self._step
        )

    def committed(self) -> tuple[int, memoryview]:
        """The running half and its committed records, for another thread to copy from."""
        half = self._half
        return half, self._records[half][: self._ends[half][0]]

    def pending_state(self) -> bytes:
        """The CDR bytes of the running record's state, as they follow `episode` and `env` in `/final_state`."""
        return bytes(self._pending[BODY + 8 :])

    @staticmethod
    def _encode(out: bytearray, encoders: Sequence[tuple[Leaf, Encoder]], root: Any) -> None:
        for leaf, encode in encoders:
            encode(leaf_value(root, leaf), out, BODY)

    def _write_pending(self, position: int) -> None:
        self._records[self._half][position : position + len(self._pending)] = self._pending

    def _reserve(self, size: int) -> None:
        if self._position + size <= self._area.capacity:
            return
        if self._position:
            self._switch()
        if size > self._area.capacity:
            if self.grow is None:
                raise StepError(
                    f"a step of {size} bytes does not fit into {self._area.capacity} bytes of journal"
                )
            self.grow(size)

    def _switch(self) -> None:
        full, end, begin = self._half, self._position, self._emitted
        other = 1 - full
        self._ends[other][0] = 0
        self._records[other][: len(self._pending)] = self._pending
        self._half, self._position, self._emitted = other, 0, 0
        self._emit(self._records[full][begin:end])

    def flush(self) -> None:
        """Writes the committed records that are not in the file yet."""
        begin, self._emitted = self._emitted, self._position
        self._emit(self._records[self._half][begin : self._position])

    def _emit(self, records: memoryview) -> None:
        sizes, self._sizes = self._sizes, []
        if sum(sizes) != len(records):  # a step was interrupted: what the journal says counts
            for rows in group_records(records, sealed=True):
                self._sink(rows)
        elif sizes:
            (first,) = _SEQUENCE.unpack_from(records, _SEQUENCE_AT)
            self._sink(_as_rows(self._channel, first, bytearray(records), sizes, sealed=True))
