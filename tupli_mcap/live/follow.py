"""Looking at a recording while it is written: the newest rows, copied out of its journal by another thread.

Recording does nothing for it and waits for nobody. Rows may be written over while they are copied, so every copy is
checked by its sequence numbers afterwards, and what was torn or overtaken is left out.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.logs import EventLog
from tupli_mcap.mcap.records import BODY, RECORD_HEADER, iter_records
from tupli_mcap.messages.encode_rows import HOLE
from tupli_mcap.messages.frames import EncodedFrame, decode_frame
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.index import EPISODE_ROWS
from tupli_mcap.recording.write.episodes import Foretold
from tupli_mcap.recording.write.rows.single import SingleRows
from tupli_mcap.recording.write.rows.variable import StepLog
from tupli_mcap.recording.write.rows.vector import VectorRows
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.labels import LABELS_NAME, Labels

__all__ = ["NewInfo", "NewSteps", "Watcher"]

_EPISODES = 4096  # ended episodes looked at in one go
_HEADER = RECORD_HEADER.size
_START = struct.Struct("<IIQ")  # episode, sub-environment and first row, with which starts begin
_PAIR = struct.Struct("<II")  # episode and step, with which the messages of infos begin


class NewSteps(NamedTuple):
    """Consecutive steps of a sub-environment: rows `first`, `first + 1`, … of its channel.

    `rows` are whole records of a constant layout (with `step` filled in), `messages` the CDR messages of another one.
    `episodes`, `steps` and `times` (ns) have a number a step.
    """

    env: int
    first: int
    rows: Array | None
    messages: list[tuple[int, bytes]]
    episodes: Array
    steps: Array
    times: Array

    def __len__(self) -> int:
        return len(self.episodes)

    def newest(self, count: int) -> NewSteps:
        """The last `count` of them."""
        skip = max(0, len(self) - count)
        rows = None if self.rows is None else self.rows[skip:]
        env, first, _, messages, *columns = self
        return NewSteps(env, first + skip, rows, messages[skip:], *(column[skip:] for column in columns))

    def moved(self, rows: int) -> NewSteps:
        """The same, so many rows later."""
        env, first, table, messages, *columns = self
        return NewSteps(env, first + rows, table, messages, *columns)

    def cdr(self) -> Iterator[tuple[int, bytes]]:
        """(log_time, CDR message with its header) of each step."""
        if self.rows is None:
            yield from self.messages
            return
        data, size = self.rows.tobytes(), self.rows.dtype.itemsize
        for i, time_ns in enumerate(self.times.tolist()):
            yield time_ns, data[i * size + _HEADER : (i + 1) * size]


class NewInfo(NamedTuple):
    """The recorded infos of the step in row `row` of a sub-environment's channel; `time_ns` is wall clock."""

    row: int
    time_ns: int
    values: Mapping[str, Any]


class Watcher:
    """Reads what `writer` has committed since the last look. For one thread, any but the writer's.

    Where starts and ends of episodes are left to rows, they are made of copies of these rows; each look asks the
    recorder to write them soon, so that these are few.
    """

    def __init__(self, writer: RecordingWriter) -> None:
        self._writer = writer
        self._seen: dict[int, int] = {}  # rows of each sub-environment
        # its last row's episode, where that began, and the row after the last one
        self._starts: dict[int, tuple[int, int, int]] = {}
        self._ends: dict[int, int] = {}  # where its last ended episode ended
        self._note_ends(np.frombuffer(bytes(writer.index.rows), EPISODE_ROWS))
        self._recent: Array = np.zeros(0, EPISODE_ROWS)
        self._episodes = self._earlier = writer.index.count  # of earlier sessions: not shown
        writer.is_watched = True
        # frames of steps that have not been looked at: episode, step, message
        self._pictures: dict[int, list[tuple[int, int, bytes]]] = {}
        self._infos: list[tuple[int, bytes]] = []  # of such steps: log_time, message
        self._places: dict[str, tuple[int, int]] = {}  # log -> half and position
        self._told: dict[int, int] = {}  # starts, ends and final states, by channel

    @property
    def writer(self) -> RecordingWriter:
        """What is looked at."""
        return self._writer

    @property
    def layout(self) -> StepLayout | None:
        """None until the first step."""
        return None if self._store is None else self._writer.layout

    @property
    def num_envs(self) -> int:
        """Sub-environments; 1 for a single environment."""
        return self._writer.num_envs

    @property
    def is_vector(self) -> bool:
        return self._writer.is_vector

    @property
    def is_over(self) -> bool:
        """True once the recording is closed: what is there now is the rest."""
        return self._writer.closed

    @property
    def episodes(self) -> int:
        """Episodes that have ended up to the last look."""
        return self._episodes - self._earlier

    @property
    def labels(self) -> Labels:
        """What dimensions and values are called."""
        layout, attachments = self.layout, self._writer.options.attachments or {}
        if layout is None or LABELS_NAME not in attachments:
            return Labels.none()
        return Labels.from_json(attachments[LABELS_NAME][1], layout.leaves, str(self._writer.path))

    def look(self, envs: int) -> tuple[list[NewSteps], Array]:
        """The new steps of the first `envs` sub-environments, and the episodes that have ended (EPISODE_ROWS)."""
        found = [self._new_records(env) for env in range(min(envs, self.num_envs))]
        # after the rows: unless they tell of their episodes, one that is not there by now has begun where the last one
        # ended
        store = self._rows
        tells = store is not None and store.tells
        ended = self._ended(self._foretell())
        if store is not None and tells:
            store.ask()
        placed = [self._placed(*new, tells=tells) for new in found if new is not None]
        return [new for new in placed if len(new)], ended

    def images(self, leaf: int, env: int, rows: range) -> dict[int, Array]:
        """Whole records of those of the image rows that are in the journal still."""
        table = self._writer.images[leaf][env].rows()
        found, sequences = {}, table["#sequence"]
        for half, row in np.argwhere((sequences >= rows.start) & (sequences < rows.stop)).tolist():
            copy = table[half, row].copy()
            if table[half, row]["#sequence"] == copy["#sequence"]:
                found[int(copy["#sequence"])] = copy
        return found

    def events(self) -> list[tuple[int, int, bytes]]:
        """(channel, log_time, CDR message) of new infos and frames, then of new starts, ends and final states."""
        frames = [(f"frames/{env}", log) for env, log in enumerate(self._writer.frames)]
        found = []
        for name, log in (("infos", self._writer.infos), *frames):
            if log is not None:
                found += self._new_events(name, log)
        return found + self._episode_events()

    def camera(self, env: int) -> str | None:
        """The camera whose frames are recorded, if any."""
        cameras = self._writer.channels.cameras
        return self._writer.container.channels[cameras[env][0]].topic.rpartition("/")[2] if cameras else None

    def frames(self, env: int, most: int) -> list[tuple[int, EncodedFrame]]:
        """The newest of the new frames, each with the row of the step whose state it shows."""
        if not self._writer.frames:
            return []
        events = self._new_events(f"frames/{env}", self._writer.frames[env])
        camera, told = self._writer.channels.cameras[env]
        found = self._pictures.get(env, [])
        for (one, _, pair), (other, _, picture) in itertools.pairwise(events):
            if (one, other) == (told, camera):
                episode, step = np.frombuffer(pair, "<u4", 2, BODY - _HEADER).tolist()
                found.append((episode, step, picture))
        rows = [self._begin_of(env, episode, -1) for episode, _, _ in found]
        # the steps of others have not been looked at yet
        self._pictures[env] = [new for new, row in zip(found, rows, strict=True) if row < 0][-most:]
        return [
            (row + step, decode_frame(memoryview(picture)[BODY - _HEADER :])[0])
            for (_, step, picture), row in zip(found, rows, strict=True)
            if row >= 0
        ][-most:]

    def infos(self, env: int, most: int) -> list[NewInfo]:
        """The newest of the new infos of a sub-environment: always of the same one."""
        log, channel = self._writer.infos, self._writer.channels.info
        if log is None or channel is None:
            return []
        new = [(time_ns, message) for _, time_ns, message in self._new_events("infos", log)]
        found: list[tuple[int, int, bytes]] = []
        waiting = []
        begins: dict[int, int] = {}
        for time_ns, message in [*self._infos, *new][-most * self.num_envs :]:
            episode, step = _PAIR.unpack_from(message, BODY - _HEADER)
            begin = begins.get(episode)
            if begin is None:
                begin = begins[episode] = self._begin_of(env, episode, -1)
            if begin >= 0:
                found.append((begin + step, time_ns, message))
            else:  # of another sub-environment, or of steps that have not been looked at yet
                waiting.append((time_ns, message))
        self._infos = waiting[-most:]
        decoder = InfoCodec.from_metadata(self._writer.container.channels[channel].metadata)
        return [
            NewInfo(row, time_ns, decoder.decode(memoryview(message)[BODY - _HEADER :])[2])
            for row, time_ns, message in found[-most:]
        ]

    @property
    def _store(self) -> Any:
        """What takes the steps: rows, or a log of each sub-environment; None before the first step."""
        return self._writer.rows if self._writer.rows is not None else self._writer.vector

    @property
    def _rows(self) -> SingleRows | VectorRows | None:
        """The same, if these are rows of constant size."""
        store = self._store
        return store if isinstance(store, SingleRows | VectorRows) else None

    def _new_records(self, env: int) -> tuple[int, int, Array | None, list[tuple[int, bytes]]] | None:
        store, seen = self._store, self._seen.get(env, -1)
        if isinstance(store, StepLog | list):
            log = store if isinstance(store, StepLog) else store[env]
            return self._new_messages(env, log, seen)
        half, row, table = store.committed() if isinstance(store, SingleRows) else store.committed(env)
        rows = _intact(table, half, row, seen)
        if not len(rows):
            return None
        self._seen[env] = int(rows["#sequence"][-1])
        return env, int(rows["#sequence"][0]), rows, []

    def _new_messages(
        self, env: int, log: StepLog, seen: int
    ) -> tuple[int, int, Array | None, list[tuple[int, bytes]]] | None:
        found: list[tuple[int, int, bytes]] = []
        for _, sequence, time_ns, message in self._committed(f"steps/{env}", *log.committed()):
            if sequence > seen:
                found = found if not found or found[-1][0] == sequence - 1 else []
                found.append((sequence, time_ns, message))
        if not found:
            return None
        self._seen[env] = found[-1][0]
        return env, found[0][0], None, [(time_ns, message) for _, time_ns, message in found]

    def _episode_events(self) -> list[tuple[int, int, bytes]]:
        """New starts, ends and final states: those that have been told, and those that will be."""
        log, channels = self._writer.events, self._writer.channels
        if log is None:
            return []
        foretold = self._foretell()  # before the log: what is told meanwhile is found there, too
        order = [channels.final_state, channels.end, channels.start]
        found = log.newest({channel: self._told.get(channel, 0) for channel in order})
        for channel, table in {} if foretold is None else foretold.tables.items():
            heads = zip(table["#sequence"].tolist(), table["#log_time"].tolist(), table, strict=True)
            found += [(channel, row, time_ns, one.tobytes()[_HEADER:]) for row, time_ns, one in heads]
        new = []
        for channel, row, time_ns, message in found:
            if row < self._told.get(channel, 0) or (channel == channels.start and self._is_empty(message)):
                continue
            self._told[channel] = row + 1
            new.append((channel, time_ns, message))
        return sorted(new, key=lambda one: (one[1], order.index(one[0])))

    def _is_empty(self, start: bytes) -> bool:
        """True for the start of an episode without a step, which may be taken back."""
        _, env, first_row = _START.unpack_from(start, BODY - _HEADER)
        store: Any = self._store
        if isinstance(store, VectorRows):
            count = int(store.counts[env])
        else:
            count = store[env].count if isinstance(store, list) else store.count
        return bool(first_row >= count) and not self.is_over

    def _foretell(self) -> Foretold | None:
        store = self._rows
        return None if store is None else store.foretell()

    def _new_events(self, name: str, log: EventLog) -> list[tuple[int, int, bytes]]:
        return [(c, time_ns, message) for c, _, time_ns, message in self._committed(name, 0, log.committed())]

    def _committed(self, name: str, half: int, log: memoryview) -> Iterator[tuple[int, int, int, bytes]]:
        """(channel, sequence, log_time, CDR message) of the records after those of the last look."""
        known, position = self._places.get(name, (half, 0))
        if known != half or position > len(log):  # what was in between is not shown
            position = 0
        self._places[name] = half, len(log)
        data = bytes(log[position:])
        try:
            for start, end, channel, sequence, time_ns in iter_records(memoryview(data)):
                yield channel, sequence, time_ns, data[start + _HEADER : end]
        except FormatError:  # written over while it was copied
            return

    def _ended(self, foretold: Foretold | None) -> Array:
        """New ends: those that have been told, then those that will be."""
        index, size = self._writer.index, EPISODE_ROWS.itemsize
        count = index.count  # read once: it may grow meanwhile
        first = max(self._episodes, count - _EPISODES)
        # a copy: a view would keep the recorder from adding to it
        found = np.frombuffer(bytes(index.rows[first * size : count * size]), EPISODE_ROWS)
        if foretold is not None:
            skip = max(self._episodes, count) - foretold.first
            found = np.concatenate([found, foretold.ended[skip:]])
            count = max(count, foretold.first + len(foretold.ended))
        self._episodes = max(self._episodes, count)
        self._note_ends(found)
        self._recent = np.concatenate([self._recent[-_EPISODES:], found])
        return found

    def _note_ends(self, episodes: Array) -> None:
        for env in np.unique(episodes["env"]).tolist():
            last = episodes[np.flatnonzero(episodes["env"] == env)[-1]]
            self._ends[env] = int(last["first_row"] + last["length"])

    def _placed(
        self, env: int, first: int, rows: Array | None, messages: list[tuple[int, bytes]], *, tells: bool
    ) -> NewSteps:
        """Numbers the steps in their episodes; `step` in the journal is filled in at a flush only.

        Steps of an episode whose beginning is not known are left out.
        """
        if rows is None:
            pairs = np.array([np.frombuffer(m, "<u4", 2, BODY - _HEADER) for _, m in messages], np.int64)
            times = np.array([time_ns for time_ns, _ in messages], np.int64)
            end = first + len(messages)
            self._starts[env] = int(pairs[-1, 0]), end - 1 - int(pairs[-1, 1]), end
            return NewSteps(env, first, None, messages, pairs[:, 0], pairs[:, 1], times)
        episodes = rows["episode"].astype(np.int64)
        index = np.arange(first, first + len(rows))
        begins = np.full(len(rows), -1, np.int64)
        begins[1:] = np.where(episodes[1:] != episodes[:-1], index[1:], -1)
        begins[0] = self._first_row(env, first, int(episodes[0]), tells=tells)
        np.maximum.accumulate(begins, out=begins)
        if begins[-1] >= 0:
            self._starts[env] = int(episodes[-1]), int(begins[-1]), first + len(rows)
        unknown = int(np.count_nonzero(begins < 0))
        first, rows, episodes = first + unknown, rows[unknown:], episodes[unknown:]
        steps = (index - begins)[unknown:]
        rows["step"] = steps
        times = np.maximum.accumulate(rows["#log_time"].astype(np.int64))
        return NewSteps(env, first, rows, [], episodes, steps, times)

    def _first_row(self, env: int, first: int, episode: int, *, tells: bool) -> int:
        """Where the episode of row `first` has begun; -1 if that is not known."""
        begin = self._begin_of(env, episode, -1)
        if begin >= 0:
            return begin
        if not tells:
            return min(self._ends.get(env, 0), first)
        running = self._writer.events.running(episode) if self._writer.events is not None else None
        if running is not None:
            return running.first_row
        return first if self._starts.get(env, (0, 0, -1))[2] == first else -1

    def _begin_of(self, env: int, episode: int, unknown: int) -> int:
        """The first row of an episode; `unknown` if it is neither the last one looked at nor one that has ended."""
        known, begin, _ = self._starts.get(env, (-1, 0, 0))
        if known == episode:
            return begin
        ended = self._recent[(self._recent["episode"] == episode) & (self._recent["env"] == env)]
        return int(ended["first_row"][-1]) if len(ended) else unknown


def _intact(table: Array, half: int, row: int, seen: int) -> Array:
    """Copies of the newest consecutive rows after `seen`: those before `row` of a half, and of the other half before.

    Args:
        table: the rows of both halves in the journal, each half with its spare row.
    """
    whole = np.dtype(f"V{table.dtype.itemsize}")  # copied as bytes: padding stays where it is
    copies = []
    for view in (table[1 - half, : table.shape[1] - 1], table[half, :row]):
        sequences = view["#sequence"]
        wanted = np.flatnonzero((sequences > seen) & (sequences != HOLE))
        copied = view.view(whole)[wanted]
        rows = copied.view(table.dtype)
        copies.append(copied[(sequences[wanted] == rows["#sequence"]) & (rows["#opcode"] == 5)])
    found = np.concatenate(copies).view(table.dtype)
    gaps = np.flatnonzero(np.diff(found["#sequence"].astype(np.int64)) != 1)
    return found[gaps[-1] + 1 :] if len(gaps) else found
