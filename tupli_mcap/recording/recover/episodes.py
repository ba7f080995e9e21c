"""What the writer of an unfinished recording could not do: the missing starts and ends of episodes, and the index."""

from __future__ import annotations

import bisect
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.records import Channel

from tupli_mcap.journal.committed import FinalHole
from tupli_mcap.journal.logs import group_records
from tupli_mcap.mcap.container import CHUNK_ROWS, Rows
from tupli_mcap.mcap.records import BODY
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT, EpisodeEnd, EpisodeStart, record
from tupli_mcap.messages.frames import FRAME_LAYOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, Topics, parse
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore
from tupli_mcap.recording.contents import Contents
from tupli_mcap.recording.index import EpisodeIndex, EpisodeRow, IndexBuilder
from tupli_mcap.recording.recover.prefix import Scan
from tupli_mcap.recording.recover.step_runs import Run, runs

__all__ = ["Unwritten", "chunk_table", "complete"]


@dataclass
class Unwritten:
    """What the journal adds to the file, as rows that are not in it; `pending` are states by sub-environment.

    `finals`: what follows the last steps of episodes, by sub-environment and the row after.
    """

    rows: list[Rows] = field(default_factory=list)
    pending: dict[int, bytes] = field(default_factory=dict)
    finals: dict[tuple[int, int], FinalHole] = field(default_factory=dict)
    left_out: int = 0  # steps in the journal that a power loss may have torn
    final_lost: bool = (
        False  # a final state that is not there may have been: `pending` may be of the next episode
    )


def chunk_table(found: Scan, memory: list[Rows]) -> np.ndarray[Any, Any]:
    """The chunks of the file, and rows in memory, as CHUNK_ROWS."""
    extra = [
        (IN_MEMORY + i, 0, len(rows.data), rows.first, len(rows.offsets), 0, 0, rows.channel, 0, 0)
        for i, rows in enumerate(memory)
    ]
    return np.array([*found.chunks, *extra], CHUNK_ROWS)


_START, _END, _FINAL = EPISODE_START, EPISODE_END, FINAL_STATE


class _Episodes:
    """Starts and ends found so far, and those that are made: `made` has (channel, row, record)."""

    def __init__(self, store: ChunkStore, topics: dict[str, int]) -> None:
        self.starts: dict[int, tuple[int, int, EpisodeStart]] = {}
        self.ends: dict[int, tuple[int, int, EpisodeEnd]] = {}
        self.finals: dict[int, int] = {}
        self.made: list[tuple[int, int, bytes]] = []
        self._channels = {topic: topics[topic] for topic in (_START, _END, _FINAL)}
        self._counts = {topic: store.count(channel) for topic, channel in self._channels.items()}
        self._times = dict.fromkeys(self._channels, 0)
        for row, (time, body) in enumerate(_messages(store, topics[_START])):
            start = EpisodeStart.decode(body)
            self.starts[start.episode] = (row, time, start)
            self._times[_START] = time
        for row, (time, body) in enumerate(_messages(store, topics[_END])):
            end = EpisodeEnd.decode(body)
            self.ends[end.episode] = (row, time, end)
            self._times[_END] = time
        for row, (time, body) in enumerate(_messages(store, topics[_FINAL])):
            self.finals[int.from_bytes(body[:4], "little")] = row
            self._times[_FINAL] = time

    def drop_ends(self, available: list[int]) -> int:
        """Forgets ends whose steps were lost with the end of the file; returns a number beyond those of all of them."""
        beyond = 0
        for number, (_, _, end) in list(self.ends.items()):
            _, _, start = self.starts.get(number, (0, 0, end))
            here = end.env < len(available) and end.first_row + end.length <= available[end.env]
            if not here or (start.env, start.first_row) != (end.env, end.first_row):
                del self.ends[number]
                beyond = max(beyond, number + 1)
        return beyond

    def make_start(self, start: EpisodeStart, time: int) -> None:
        row, time = self._make(time, _START, start.encode())
        self.starts[start.episode] = (row, time, start)

    def make_end(self, end: EpisodeEnd, time: int, final_state: bytes | None) -> None:
        """`final_state`: the body of the message, if there is none yet."""
        if final_state is not None:
            self.finals[end.episode], _ = self._make(time, _FINAL, final_state)
        row, time = self._make(time, _END, end.encode())
        self.ends[end.episode] = (row, time, end)

    def _make(self, time: int, topic: str, body: bytes) -> tuple[int, int]:
        """The row of a message, and its time: that asked for, or the latest of its channel.

        Each channel by itself: how far an earlier recovery came with the others must change nothing.
        """
        channel, row = self._channels[topic], self._counts[topic]
        time = max(time, self._times[topic])
        self.made.append((channel, row, record(channel, row, time, body)))
        self._counts[topic], self._times[topic] = row + 1, time
        return row, time


def _messages(store: ChunkStore, channel: int) -> Iterator[tuple[int, memoryview]]:
    for chunk in store.chunks(channel):
        data = memoryview(store.load(chunk))
        for start, end in store.messages(chunk):
            yield int.from_bytes(data[start + 15 : start + 23], "little"), data[start + BODY : end]


def complete(
    source: Source, found: Scan, layout: StepLayout, steps: list[int], tail: Unwritten, contents: Contents
) -> None:
    """Makes the missing starts and ends of episodes, and the index."""
    topics = {c.topic: c.id for c in found.channels.values()}
    if not topics.keys() >= {_START, _END, _FINAL}:
        return
    store = ChunkStore(source, chunk_table(found, tail.rows), [bytes(r.data) for r in tail.rows], 1 << 26)
    episodes = _Episodes(store, topics)
    available = [_available(store, topics, layout, found.channels[channel]) for channel in steps]
    tail.left_out += sum(map(store.count, steps)) - sum(available)
    contents.used_episodes = max(episodes.drop_ends(available), _beyond_frames(store, topics))
    found_runs = _Runs(store, layout, steps, available, episodes)
    _make_starts(episodes, found_runs, tail)
    _make_ends(episodes, found_runs, store, tail)
    tail.rows += group_records(memoryview(b"".join(made for *_, made in sorted(episodes.made))))
    contents.memory = [bytes(rows.data) for rows in tail.rows]
    contents.table = chunk_table(found, tail.rows)
    contents.tail = tail.rows
    contents.index = _index(episodes, contents.table)


class _Runs:
    """The rows of episodes that have no start or no end."""

    def __init__(
        self,
        store: ChunkStore,
        layout: StepLayout,
        steps: list[int],
        available: list[int],
        episodes: _Episodes,
    ) -> None:
        self._store, self.layout = store, layout
        self.steps, self.available = steps, available
        # starts made for episodes that have steps and none, and the times of their first steps
        self.unstarted: list[tuple[EpisodeStart, int]] = []
        self._begun: dict[int, list[Run]] = {}  # of episodes without an end, by sub-environment, in order
        for env, channel in enumerate(steps):
            last = -1
            for run in runs(store, layout, channel, 0, available[env]):
                if run.episode != last and run.episode not in episodes.starts:
                    start = EpisodeStart(run.episode, env, run.row, False, False, "", "", "{}")
                    self.unstarted.append((start, run.first_time))
                if run.episode not in episodes.ends:
                    self._begun.setdefault(env, []).append(run)
                last = run.episode

    def of(self, start: EpisodeStart) -> Run | None:
        """The rows of an episode without an end, from where it starts; None if it has no step."""
        mine = self._begun.get(start.env, [])
        at = bisect.bisect_right(mine, start.first_row, key=lambda run: run.row) - 1
        if at < 0 or mine[at].episode != start.episode:
            return None
        run, before = mine[at], start.first_row - mine[at].row
        if before == 0 or before >= run.steps:
            return run if before == 0 else None
        channel = self.steps[start.env]  # its start is wrong: some of its steps come before it
        rest = runs(self._store, self.layout, channel, start.first_row, run.steps - before, keep=True)
        return next(rest)


def _make_starts(episodes: _Episodes, found: _Runs, tail: Unwritten) -> None:
    """Makes the missing starts, in the order of time."""
    missing = []
    for start, time in found.unstarted:
        hole = tail.finals.get((start.env, start.first_row))
        missing.append((time if hole is None else hole.time_ns, start.episode, start))
    for time, _, start in sorted(missing):
        episodes.make_start(start, time)


def _make_ends(episodes: _Episodes, found: _Runs, store: ChunkStore, tail: Unwritten) -> None:
    """Makes the missing ends, in the order of time."""
    missing = []
    running = [episodes.starts[number][2] for number in set(episodes.starts) - set(episodes.ends)]
    for start in sorted(running, key=lambda start: (start.env, start.first_row)):  # each chunk once
        number = start.episode
        run = found.of(start)
        if run is not None:  # a reset without a step is no episode
            missing.append((run.last_time, number, start, run))
    for time, number, start, run in sorted(missing, key=lambda made: made[:2]):
        how = TERMINAL if run.terminal else TIMEOUT if run.timeout else INTERRUPTED
        if how == INTERRUPTED:  # what is there is that of a later step, which was lost
            episodes.finals.pop(number, None)
        final = None
        if number not in episodes.finals:
            final = _final_state(found, store, tail, start.env, run)
        if final is not None:
            final = number.to_bytes(4, "little") + start.env.to_bytes(4, "little") + final
        has_final = final is not None or number in episodes.finals
        end = EpisodeEnd(number, start.env, run.row, run.steps, run.total, how, has_final, "{}")
        episodes.make_end(end, time, final)


def _final_state(found: _Runs, store: ChunkStore, tail: Unwritten, env: int, run: Run) -> bytes | None:
    """The state after a run, from the journal; None if it is not there."""
    stop, ended = run.row + run.steps, run.terminal or run.timeout
    hole = tail.finals.get((env, stop))
    if ended and hole is not None and not found.layout.images:  # images are where the next ones are by now
        return hole.state
    at_end = stop == found.available[env] == store.count(found.steps[env])
    return tail.pending.get(env) if at_end and not (ended and tail.final_lost) else None


def _beyond_frames(store: ChunkStore, topics: dict[str, int]) -> int:
    """A number beyond those of the episodes that frames show: the steps of some may be lost."""
    beyond = 0
    for topic, channel in topics.items():
        if (place := parse(topic)) is not None and place.kind == "frame":
            for chunk in store.chunks(channel):
                beyond = max(beyond, int(store.rows(chunk, FRAME_LAYOUT.dtype)["episode"].max()) + 1)
    return beyond


def _index(episodes: _Episodes, table: np.ndarray[Any, Any]) -> EpisodeIndex:
    builder = IndexBuilder()
    for number in sorted(episodes.ends):
        if number not in episodes.starts:
            continue
        start_row, start_time, start = episodes.starts[number]
        end_row, end_time, end = episodes.ends[number]
        seed = start.seed_number
        final = episodes.finals.get(number, -1) if end.has_final_state else -1
        row = EpisodeRow(
            end.first_row, end.length, end.episode_return, start_time, end_time, seed, start_row, end_row, final,
            number, end.env, end.end,
        )  # fmt: skip
        builder.add(*row, end.metadata)
    return EpisodeIndex.decode(builder.encode(table.tobytes()), "recovered index")


def _available(store: ChunkStore, topics: dict[str, int], layout: StepLayout, channel: Channel) -> int:
    """Steps of a sub-environment that are whole: of which all images are there."""
    mine = Topics.of_step(channel.topic)
    images = [topics.get(mine.image(leaf.name), 0) for leaf in layout.images]
    return min(store.count(one) for one in (channel.id, *images))
