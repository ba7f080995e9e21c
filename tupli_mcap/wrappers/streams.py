"""Records the episodes of streams without an environment: each stream begins, takes steps and ends by itself."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array, arrays_at
from tupli_mcap.errors import StepError
from tupli_mcap.journal.derive import ENDS, STARTS, EpisodeBatch, StartedEpisode, sums
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.about.success import with_success
from tupli_mcap.recording.write.episodes import ResetFacts, plain_reset
from tupli_mcap.recording.write.recorders.infos import InfoRecorder
from tupli_mcap.recording.write.recorders.single import decide_layout
from tupli_mcap.recording.write.rows.contract import StepStore
from tupli_mcap.recording.write.rows.variable import final_encoder
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.exact import exact_array, leaf_value


class Streams:
    """Records the episodes of each stream into one file."""

    def __init__(self, writer: RecordingWriter, spaces: StepLayout, num_envs: int | None) -> None:
        self.writer, self.spaces, self._num_envs = writer, spaces, num_envs
        self.infos = InfoRecorder(True)
        self.streams = [Stream(self, i) for i in range(num_envs or 1)]

    @property
    def is_running(self) -> bool:
        """True if some stream is within an episode."""
        return any(stream.is_running for stream in self.streams)

    def begin(self, state: Any, action: Any, reward: Any) -> None:
        """Decides the layout by the values of the first step, unless it is decided."""
        writer = self.writer
        if not writer.streams:
            layout = decide_layout(self.spaces, [state], [action], [reward], writer.layout)
            schema, n = self.infos.codec.schema(), self._num_envs
            writer.begin(layout, n or 1, vector=n is not None, apart=True, info_schema=schema)

    def close(self) -> None:
        """Ends the running episodes as their flags say, or as interrupted, and finishes the file."""
        if self.writer.closed:
            return
        for stream in self.streams:
            stream.end()
        self.writer.close()


class Stream:
    """Records the episodes of one stream.

    Attributes:
        is_running: an episode has begun and not ended.
        over: how the last step ended the running episode; None while it runs.
    """

    def __init__(self, streams: Streams, env: int) -> None:
        self._streams, self._writer, self._env = streams, streams.writer, env
        self.is_running = False
        self.over: int | None = None
        self._facts = plain_reset(0)
        self._metadata: dict[str, Any] = {}
        self._episode: StartedEpisode | None = None
        self._store: StepStore | None = None
        self._last_info: tuple[int, Mapping[str, Any]] = (0, {})  # and the number of rows up to its step

    def begin(self, facts: ResetFacts, metadata: dict[str, Any]) -> None:
        """Begins an episode, which is written with its first step."""
        self._facts, self._metadata = facts, metadata
        self.is_running, self.over = True, None

    def put(self, state: Any, action: Any, reward: Any, terminal: Any, timeout: Any) -> None:
        """Records a step."""
        if self._episode is None:
            store = self._ready(state, action, reward)
            put = functools.partial(store.put_whole, state, action, reward, terminal, timeout)
            self._start(store, put)
        else:
            self._store.put_whole(state, action, reward, terminal, timeout)  # type: ignore[union-attr]
        if terminal or timeout:
            self.over = TERMINAL if terminal else TIMEOUT

    def _ready(self, state: Any, action: Any, reward: Any) -> StepStore:
        """Where the steps go, of which these are the values of the first one."""
        self._streams.begin(state, action, reward)
        self._store = self._writer.streams[self._env]
        return self._store

    def _start(self, store: StepStore, put: Callable[[], None]) -> None:
        """Starts the episode, whose first steps `put` records; it is taken back if they are refused."""
        writer = self._writer
        store.begin_episode(writer.next_episode)
        episode = writer.start_episode(self._env, store.count, self._facts)
        try:
            put()
        except StepError:
            writer.drop_start()
            raise
        self._episode = episode
        writer.take_place()

    def put_many(
        self,
        states: Any,
        actions: Any,
        rewards: Any,
        terminals: Array,
        timeouts: Array,
        infos: Sequence[Mapping[str, Any]],
    ) -> None:
        """Records several steps; StepError if a value cannot be stored exactly; nothing is recorded."""
        store = self._ready(*(arrays_at(column, 0) for column in (states, actions, rewards)))
        number = self._writer.next_episode if self._episode is None else self._episode.number
        put = functools.partial(store.put_many, states, actions, rewards, terminals, timeouts, number)
        if self._episode is None:
            self._start(store, put)
        else:
            put()
        self.over = TERMINAL if terminals[-1] else TIMEOUT if timeouts[-1] else None
        self.put_infos(infos)

    def put_episodes(
        self,
        states: Any,
        actions: Any,
        rewards: Any,
        terminals: Array,
        timeouts: Array,
        stops: Array,
        finals: Any,
    ) -> None:
        """Records whole episodes, which end before the steps `stops`: together if possible, else one by one."""
        columns = (states, actions, rewards, terminals, timeouts)
        facts = plain_reset(time.time_ns())
        begin = 0
        for i, stop in enumerate(stops.tolist()):
            store = self._store
            if store is not None and store.holds_episodes:
                rest = [arrays_at(column, slice(begin, None)) for column in columns]
                self._put_together(store, rest, stops[i:] - begin, arrays_at(finals, slice(i, None)))
                return
            part = [arrays_at(column, slice(begin, stop)) for column in columns]
            final = arrays_at(finals, i)
            self._ready(*(arrays_at(column, 0) for column in part[:3]))
            self._encoded(final)  # is refused before the steps of its episode are recorded
            self.begin(facts, {})
            try:
                self.put_many(part[0], part[1], part[2], part[3], part[4], ())
            except StepError:
                self.is_running = False
                raise
            self.end(final)
            begin = stop

    def _put_together(self, store: StepStore, columns: Sequence[Any], stops: Array, finals: Any) -> None:
        """Records whole episodes that need no records but rows and final states; StepError if a value cannot be stored
        exactly; nothing is recorded."""
        writer, count, lengths = self._writer, len(stops), np.diff(stops, prepend=0)
        numbers = np.arange(writer.next_episode, writer.next_episode + count)
        final_bytes = None if finals is None else _final_bytes(writer.fixed_layout(), finals, count)
        now, first_row = time.time_ns(), store.count
        states, actions, rewards, terminals, timeouts = columns
        store.put_many(states, actions, rewards, terminals, timeouts, np.repeat(numbers, lengths))
        starts, ends = np.zeros(count, STARTS), np.zeros(count, ENDS)
        for table, time_ns in ((starts, now), (ends, time.time_ns())):
            table["episode"], table["env"], table["time"] = numbers, self._env, time_ns
            table["first_row"] = first_row + stops - lengths
        ends["length"], ends["return"] = lengths, sums(np.asarray(rewards, np.float64), stops - lengths)
        ends["end"] = np.where(terminals[stops - 1], TERMINAL, TIMEOUT)
        writer.add_episodes(EpisodeBatch(starts, ends, final_bytes))
        writer.take_place()

    def put_infos(self, infos: Sequence[Mapping[str, Any]]) -> None:
        """Records the infos of the last steps."""
        if self._episode is not None and self._store is not None:
            first = self._store.count - self._episode.first_row - len(infos)
            for step, info in enumerate(infos, first):
                self._streams.infos.put(self._writer, self._episode.number, step, info)
            if infos:
                self._last_info = self._store.count, infos[-1]

    def end(self, final_state: Any = None, metadata: Mapping[str, Any] | None = None) -> None:
        """Ends the running episode, if there is one with a step."""
        writer, episode, store = self._writer, self._episode, self._store
        if episode is not None and store is not None:
            text = jsonvalue.dumps_plain({**self._metadata, **(metadata or {})})
            length = store.count - episode.first_row
            how = INTERRUPTED if self.over is None else self.over
            rows, info = self._last_info
            if how != INTERRUPTED and rows == store.count:
                text = with_success(text, info)
            writer.end_episode(episode, how, length, store.total, self._encoded(final_state), text)
        self._episode = None
        self.is_running, self.over = False, None

    def _encoded(self, final_state: Any) -> bytes | None:
        """A final state as it is stored; None if it is not known. StepError if it cannot be stored exactly."""
        return None if final_state is None else final_encoder(self._writer.fixed_layout())(final_state)

    def discard(self) -> int | None:
        """Ends the running episode and marks it as discarded; returns its number, None if it has no step."""
        number = None if self._episode is None else self._episode.number
        self.end(metadata={"discarded": True})
        return number


def _final_bytes(layout: StepLayout, finals: Any, count: int) -> Array:
    """Final states as bytes after `episode` and `env` in `/final_state`: uint8 (count, bytes)."""
    message = layout.final_message
    table = np.zeros(count, message.dtype)
    for leaf in layout.final_leaves:
        value = exact_array(
            leaf_value(finals, leaf), layout.dtypes[leaf.name], (count, *leaf.shape), leaf.path
        )
        if leaf.size:
            table[leaf.name] = value
    return table.view(np.uint8).reshape(count, -1)[:, BODY + NUMBERS.size :]
