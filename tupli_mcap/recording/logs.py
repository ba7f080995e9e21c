"""Message records of variable size in the journal: the events of all channels, and steps without a constant layout.

A log half is a u64 end offset and the records before it. The end is stored after the bytes, in one machine word: it
commits them.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from tupli_mcap.errors import FormatError, StepError
from tupli_mcap.messages.exact import check_structure, exact_array, leaf_value, shorten
from tupli_mcap.messages.layout import BODY, CDR_HEADER, RECORD_HEADER
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.container import Rows
from tupli_mcap.recording.durability import STATE, seal
from tupli_mcap.recording.journal import LogArea

__all__ = ["Encoder", "EventLog", "StepLog", "group_records", "iter_records", "leaf_encoders"]

Sink = Callable[[Rows], None]
Encoder = Callable[[Any, bytearray, int], None]
_Groups = dict[
    int, tuple[int, list[bytes], list[int]]
]  # by channel: the first sequence, whole records, log_times
_HEADER = 64
_FRONT = struct.Struct("<BQHIQ")  # up to publish_time, where a journal keeps a checksum


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
    groups: _Groups = {}
    for start, end, channel, sequence, time_ns in iter_records(data):
        _, records, times = groups.setdefault(channel, (sequence, [], []))
        records.append(whole[start:end])
        times.append(time_ns)
    return _rows_of(groups, sealed=sealed)


def _rows_of(groups: _Groups, *, sealed: bool) -> list[Rows]:
    rows = []
    for channel, (first, records, times) in groups.items():
        if not records:
            continue
        sizes = [len(record) for record in records]
        offsets = np.zeros(len(sizes), dtype=np.uint64)
        np.cumsum(sizes[:-1], out=offsets[1:])
        joined = bytearray().join(records)
        at = np.array(times, dtype="<u8")
        if sealed:
            _publish(joined, offsets, at)
        rows.append(Rows(channel, first, joined, offsets, at))
    return rows


def _publish(records: bytearray, offsets: Any, times: Any) -> None:
    """Sets `publish_time`, where a journal keeps checksums, to `log_time`."""
    places = offsets[:, None] + np.arange(23, 31, dtype=np.uint64)
    np.frombuffer(records, np.uint8)[places] = times.view(np.uint8).reshape(-1, 8)


class EventLog:
    """Records of several channels in one half; when it is full they go to the file, a chunk a channel.

    `sequences` counts the messages of each channel, those of earlier sessions included.
    """

    def __init__(
        self, area: LogArea, buffer: memoryview, sink: Sink, sequences: dict[int, int], time_ns: int
    ) -> None:
        self.sequences = sequences
        self._sink = sink
        self._time = time_ns
        self._groups: _Groups = {}  # what the journal holds, so that a flush need not take it apart
        self._last = 0  # where the last message began
        self._last_channel = 0
        self._can_drop = False
        self.move(area, buffer)

    def move(self, area: LogArea, buffer: memoryview) -> None:
        """Goes on in another journal; everything must have been flushed."""
        self._records = buffer[_HEADER : _HEADER + area.capacity]
        self._commit = buffer[:8].cast("Q")
        self._capacity = area.capacity
        self._position = 0
        self._commit[0] = 0

    @property
    def latest_ns(self) -> int:
        """The log_time of the last message; that of the next one is not less."""
        return self._time

    def append(self, time_ns: int, *messages: tuple[int, bytes]) -> int:
        """Adds messages (channel, CDR body), all or none of them after a crash; returns their log_time."""
        if time_ns > self._time:
            self._time = time_ns
        else:
            time_ns = self._time
        end = self._position + BODY * len(messages)
        for _, body in messages:
            end += len(body)
        if end > self._capacity:
            end -= self._position
            self.flush()
        data, sequences, groups, channel = [], self.sequences, self._groups, 0
        for channel, body in messages:
            sequence = sequences[channel]
            sequences[channel] = sequence + 1
            front = _FRONT.pack(5, BODY - 9 + len(body), channel, sequence, time_ns)
            tail = CDR_HEADER + body
            record = front + crc32(tail, crc32(front)).to_bytes(8, "little") + tail
            data.append(record)
            group = groups.get(channel)
            if group is None:
                groups[channel] = (sequence, [record], [time_ns])
            else:
                group[1].append(record)
                group[2].append(time_ns)
        if end > self._capacity:  # more than the journal holds
            self._write_groups()
            self._can_drop = False
            return time_ns
        self._last, self._last_channel, self._can_drop = self._position, channel, True
        self._records[self._last : end] = b"".join(data)
        self._position = end
        self._commit[0] = end
        return time_ns

    def committed(self) -> memoryview:
        """The records in the journal, for another thread to copy from."""
        return self._records[: self._commit[0]]

    def drop_last(self, channel: int) -> None:
        """Takes back the message of the last `append`, which was one of `channel`, unless it is in the file already."""
        if not self._can_drop:
            return
        self._pop(channel)
        self._position = self._last
        self._commit[0] = self._last
        self.sequences[channel] -= 1

    def _pop(self, channel: int) -> tuple[bytes, int]:
        _, records, times = self._groups[channel]
        return records.pop(), times.pop()

    def flush(self, *, keep_last: bool = False) -> None:
        """Writes the records to the file; with `keep_last` the last one stays, so that it can still be dropped."""
        keep_last = keep_last and self._can_drop
        last, kept = b"", {}
        if keep_last:
            channel = self._last_channel
            last, time_ns = self._pop(channel)
            kept[channel] = (self.sequences[channel] - 1, [last], [time_ns])
        self._write_groups()
        self._groups = kept
        self._commit[0] = 0
        self._records[: len(last)] = last
        self._last, self._position, self._can_drop = 0, len(last), keep_last
        self._commit[0] = len(last)

    def _write_groups(self) -> None:
        for rows in _rows_of(self._groups, sealed=True):
            self._sink(rows)
        self._groups = {}


def leaf_encoders(layout: StepLayout, leaves: Sequence[Leaf]) -> list[tuple[Leaf, Encoder]]:
    """Appending CDR encoders of the given leaves."""
    return [(leaf, _encoder(layout, leaf)) for leaf in leaves]


def _encoder(layout: StepLayout, leaf: Leaf) -> Encoder:
    if leaf.kind == "variable":
        return layout.variable[leaf.name].encode
    dtype = layout.dtypes[leaf.name]

    def encode(value: Any, out: bytearray, origin: int) -> None:
        data = exact_array(value, dtype, leaf.shape, leaf.path).tobytes()
        if data:
            out += bytes(-(len(out) - origin) % dtype.itemsize)
            out += data

    return encode


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
        self._write_pending(0)

    def begin_episode(self, episode: int) -> None:
        """The records from the running one on belong to `episode`."""
        self._episode, self._step, self.total = episode, 0, 0.0
        if self._pending:
            self._number(self._pending)
            self._write_pending(self._position)

    def prepare_state(self, state: Any) -> PreparedState:
        """A state as `commit_state` takes it; StepError if it cannot be stored exactly."""
        check_structure(self._layout.observation_space, state, "state")
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
        check_structure(self._layout.action_space, action, "action")
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
        _FRONT.pack_into(out, 0, 5, len(out) - 9, self._channel, self.count, self._time)
        seal(out, 0, len(out), memoryview(pending)[STATE:])
        records, start = self._records[self._half], self._position
        end = start + len(out)
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
        self.total += prepared.reward

    def put_state(self, state: Any) -> None:
        """`commit_state` of `prepare_state`."""
        self.commit_state(self.prepare_state(state))

    def put(self, action: Any, state: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """`commit` of `prepare`."""
        self.commit(self.prepare(action, state, reward, terminal, timeout))

    def _number(self, pending: bytearray) -> None:
        """Says in a record that is not complete which one it will be; a length of 0 marks it as such."""
        RECORD_HEADER.pack_into(pending, 0, 5, 0, self._channel, self.count, 0, 0)
        pending[RECORD_HEADER.size : BODY] = CDR_HEADER
        pending[BODY : BODY + 8] = self._episode.to_bytes(4, "little") + self._step.to_bytes(4, "little")

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
        for rows in group_records(self._records[full][begin:end], sealed=True):
            self._sink(rows)

    def flush(self) -> None:
        """Writes the committed records that are not in the file yet."""
        begin, self._emitted = self._emitted, self._position
        for rows in group_records(self._records[self._half][begin : self._position], sealed=True):
            self._sink(rows)
