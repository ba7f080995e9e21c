"""Steps without a constant layout in the journal: how values become records, in a log of two halves (`logs`)."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from gymnasium.vector.utils import batch_space, iterate

from tupli_mcap.arrays import Array, arrays_at
from tupli_mcap.errors import StepError
from tupli_mcap.journal.file import LOG_HEADER, Journal, LogArea
from tupli_mcap.journal.logs import FRONT, STATE, ToFile, as_rows, seal
from tupli_mcap.mcap.chunks import message_places
from tupli_mcap.mcap.records import BODY, CDR_HEADER
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.variable.leaf_codecs import Encode
from tupli_mcap.recording.write.rows.contract import StepStore
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.spaces.exact import check_structure, exact_flag, leaf_value, shorten
from tupli_mcap.spaces.leaves import Leaf

_RUNNING = struct.Struct("<BQHIQQ4sII")  # a record up to its state
_SEQUENCE, _SEQUENCE_AT = struct.Struct("<I"), 11


def leaves_encoder(layout: StepLayout, leaves: Sequence[Leaf]) -> Encode:
    """Appends the CDR bytes of these leaves of a value; StepError if one cannot be stored exactly."""
    encoders = [(leaf, layout.codec(leaf).encode) for leaf in leaves]

    def encode(value: Any, out: bytearray, origin: int) -> None:
        for leaf, encode_leaf in encoders:
            encode_leaf(leaf_value(value, leaf), out, origin)

    return encode


class PreparedState(NamedTuple):
    """A state encoded: its record as far as it goes, and its images."""

    record: bytearray
    images: list[Any]


class PreparedStep(NamedTuple):
    """An encoded step: its record without the header, its reward as a number, and the state after it."""

    record: bytearray
    reward: float
    after: PreparedState


class StepLog:
    """The steps of one environment whose messages vary in size.

    A record starts with its state, so the running record's state is in the journal before its action is known.
    """

    holds_episodes = False

    def __init__(
        self,
        layout: StepLayout,
        journal: Journal,
        name: str,
        channel: int,
        images: Sequence[ImageRows],
        file: ToFile,
    ) -> None:
        self._layout = layout
        self._name, self._channel, self._file = name, channel, file
        self._images = images
        self._episode = 0
        self._step = 0
        self._time = file.end_time
        self._pending = bytearray()
        self._encode_state = leaves_encoder(layout, [leaf for leaf in layout.state if not leaf.apart])
        self._encode_action = leaves_encoder(layout, layout.action)
        self._encode_reward = leaves_encoder(layout, layout.reward)
        self.count = file.counts[channel]
        self.total: Any = 0.0
        self.move(journal)

    def move(self, journal: Journal) -> None:
        """Goes on in another journal, with everything committed in the file."""
        self._area = area = journal.area(self._name, LogArea)
        buffer = journal.buffer(self._name)
        self._records = [buffer[h * area.half + LOG_HEADER : (h + 1) * area.half] for h in range(2)]
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
        self._encode_state(state, out, BODY)
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
        out = bytearray(self._pending)
        self._complete(out, action, reward, terminal, timeout)
        return PreparedStep(out, self._layout.reward_total(reward), self.prepare_state(state))

    def _complete(self, out: bytearray, action: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """Appends to a record what follows its state."""
        check_structure(self._layout.action_space, action, "action")
        self._encode_action(action, out, BODY)
        self._encode_reward(reward, out, BODY)
        out += bytes((exact_flag(terminal, "terminal"), exact_flag(timeout, "timeout")))

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
        self.total += prepared.reward

    def put_whole(self, state: Any, action: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """A step with its state; the state after it is not known. StepError as `prepare`."""
        out, images = self.prepare_state(state)
        self._complete(out, action, reward, terminal, timeout)
        total, size = self._layout.reward_total(reward), len(out)
        self._pending.clear()
        self._reserve(size + 1)
        self._time = max(time.time_ns(), self._time)
        self._number(out)
        FRONT.pack_into(out, 0, 5, size - 9, self._channel, self.count, self._time)
        seal(out, 0, size, b"")
        records, start = self._records[self._half], self._position
        end = start + size
        # its front last, for a record with a front is a running one, whose state is taken
        records[start + BODY : end + 1] = out[BODY:] + b"\0"
        for sink, image in zip(self._images, images, strict=True):
            sink.put_first(image)
        records[start : start + BODY] = out[:BODY]
        self._ends[self._half][0] = end
        self._position = end
        self.count += 1
        self._step += 1
        self.total += total
        for sink in self._images:
            sink.advance()

    def put_many(
        self, states: Any, actions: Any, rewards: Any, terminals: Array, timeouts: Array, episodes: Any
    ) -> None:
        """As `StepStore.put_many`."""
        put_each(self, self._layout, (states, actions, rewards), terminals, timeouts)

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

    def pending_state(self) -> bytes:
        """As `StepStore.pending_state`."""
        return bytes(self._pending[BODY + 8 :]) + b"".join(images.pending() for images in self._images)

    def _write_pending(self, position: int) -> None:
        self._records[self._half][position : position + len(self._pending)] = self._pending

    def _reserve(self, size: int) -> None:
        if self._position + size <= self._area.capacity:
            return
        if self._position:
            self._switch()
        if size > self._area.capacity:
            self._file.grow(size)

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
        places = message_places(records)
        if len(places):
            (first,) = _SEQUENCE.unpack_from(records, _SEQUENCE_AT)
            sizes = places[:, 1] - places[:, 0]
            self._file.add_chunk(as_rows(self._channel, first, bytearray(records), sizes, sealed=True))


class PreparedBatch(NamedTuple):
    """The part of a batch for each sub-environment: a step, or the state of a reset."""

    steps: dict[int, PreparedStep]
    resets: dict[int, PreparedState]


class StepLogs:
    """The steps of sub-environments whose messages vary in size, in a log for each of them."""

    def __init__(self, layout: StepLayout, logs: Sequence[StepLog]) -> None:
        self.logs = logs
        self._observations = batch_space(layout.observation_space, len(logs))
        self._actions = batch_space(layout.action_space, len(logs))

    def row_counts(self) -> list[int]:
        """As `BatchStore.row_counts`."""
        return [log.count for log in self.logs]

    def put_state(self, states: Any, mask: Array | None = None) -> None:
        """As `BatchStore.put_state`."""
        for i, state in enumerate(each_of(self._observations, states, len(self.logs))):
            if mask is None or mask[i]:
                self.logs[i].begin_episode(0)
                self.logs[i].put_state(state)

    def check(
        self,
        actions: Any,
        states: Any,
        rewards: Array,
        terminals: Array,
        timeouts: Array,
        active: Array | None,
    ) -> PreparedBatch:
        """As `BatchStore.check`."""
        n, batch = len(self.logs), PreparedBatch({}, {})
        if rewards.shape[:1] != (n,):
            raise StepError(
                f"reward: expected a reward of each of {n} sub-environments, found {shorten(rewards)}"
            )
        each = zip(each_of(self._actions, actions, n), each_of(self._observations, states, n), strict=True)
        for i, (action, state) in enumerate(each):
            if active is None or active[i]:
                batch.steps[i] = self.logs[i].prepare(action, state, rewards[i], terminals[i], timeouts[i])
            else:
                batch.resets[i] = self.logs[i].prepare_state(state)
        return batch

    def put(self, batch: PreparedBatch, numbers: Array, *, ends: bool) -> None:
        """As `BatchStore.put`."""
        for i, reset in batch.resets.items():
            self.logs[i].commit_state(reset)
        episodes_and_steps = numbers.tolist()
        for i, step in batch.steps.items():
            if episodes_and_steps[i] < 1 << 32:  # its first step
                self.logs[i].begin_episode(episodes_and_steps[i])
            self.logs[i].commit(step)

    def pending_state(self, i: int) -> bytes:
        """As `BatchStore.pending_state`."""
        return self.logs[i].pending_state()


def final_encoder(layout: StepLayout) -> Callable[[Any], bytes]:
    """Encodes a final state that is in no row, as it follows `episode` and `env` in `/final_state`; StepError if it
    cannot be stored exactly."""
    encode_leaves = leaves_encoder(layout, layout.final_leaves)

    def encode(state: Any) -> bytes:
        check_structure(layout.observation_space, state, "state")
        out = bytearray(8)
        encode_leaves(state, out, 0)
        return bytes(out[8:])

    return encode


def put_each(
    store: StepStore, layout: StepLayout, columns: Sequence[Any], terminals: Array, timeouts: Array
) -> None:
    """Puts steps one after another; the states, actions and rewards in `columns` lie along the first axis of all
    arrays. StepError if one of them cannot be stored exactly; then none is put."""
    encoders = [leaves_encoder(layout, leaves) for leaves in (layout.state, layout.action, layout.reward)]
    steps = [tuple(arrays_at(column, i) for column in columns) for i in range(len(terminals))]
    for step in steps:
        check_structure(layout.observation_space, step[0], "state")
        check_structure(layout.action_space, step[1], "action")
        for value, encode in zip(step, encoders, strict=True):
            encode(value, bytearray(), 0)
    for (state, action, reward), terminal, timeout in zip(
        steps, terminals.tolist(), timeouts.tolist(), strict=True
    ):
        store.put_whole(state, action, reward, terminal, timeout)


def each_of(space: Any, batch: Any, n: int) -> list[Any]:
    """A batch's values by sub-environment; StepError if they are not as many, or the batch is no such thing."""
    try:
        values = list(iterate(space, batch))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as err:
        raise StepError(f"expected a batch of {space}, found {shorten(batch)}") from err
    if len(values) != n:
        raise StepError(f"expected {n} values in a batch of {space}, found {len(values)}")
    return values
