"""What the writer of an unfinished recording could not do: the missing starts and ends of episodes, and the index."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.records import Channel

from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.cameras import FRAME_LAYOUT
from tupli_mcap.recording.chunks import IN_MEMORY, ChunkStore
from tupli_mcap.recording.container import CHUNK_ROWS, Rows
from tupli_mcap.recording.contents import Contents
from tupli_mcap.recording.events import INTERRUPTED, EpisodeEnd, EpisodeStart, record
from tupli_mcap.recording.index import EpisodeIndex, EpisodeRow, IndexBuilder
from tupli_mcap.recording.salvage import to_rows
from tupli_mcap.recording.scan import Scan
from tupli_mcap.recording.source import Source

__all__ = ["Unwritten", "chunk_table", "complete"]


@dataclass
class Unwritten:
    """What the journal adds to the file, as rows that are not in it; `pending` are states by sub-environment."""

    rows: list[Rows] = field(default_factory=list)
    pending: dict[int, bytes] = field(default_factory=dict)
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


_START, _END, _FINAL = "/episode_start", "/episode_end", "/final_state"


class _Episodes:
    """Starts and ends found so far, and those that are made, in `made` as `log_records` gives them."""

    def __init__(self, store: ChunkStore, topics: dict[str, int]) -> None:
        self.starts: dict[int, tuple[int, int, EpisodeStart]] = {}
        self.ends: dict[int, tuple[int, int, EpisodeEnd]] = {}
        self.finals: dict[int, int] = {}
        self.made: list[tuple[int, int, int, bytes]] = []
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
        self.made.append((channel, row, time, record(channel, row, time, body)))
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
    for start, time in _unstarted(store, layout, steps, available, set(episodes.starts)):
        episodes.make_start(start, time)
    for number in sorted(set(episodes.starts) - set(episodes.ends)):
        _, _, start = episodes.starts[number]
        facts = _rows_of(store, layout, steps, available, start, number)
        if facts is None:
            continue  # a reset without a step is no episode
        length, total, how, time = facts
        if how == INTERRUPTED:  # what is there is that of a later step, which was lost
            episodes.finals.pop(number, None)
        final = None
        at_end = start.first_row + length == available[start.env] == store.count(steps[start.env])
        if number not in episodes.finals and at_end and (how == INTERRUPTED or not tail.final_lost):
            final = tail.pending.get(start.env)
        if final is not None:
            final = number.to_bytes(4, "little") + start.env.to_bytes(4, "little") + final
        has_final = final is not None or number in episodes.finals
        end = EpisodeEnd(number, start.env, start.first_row, length, total, how, has_final, "{}")
        episodes.make_end(end, time, final)
    tail.rows += to_rows(episodes.made)
    contents.memory = [bytes(rows.data) for rows in tail.rows]
    contents.table = chunk_table(found, tail.rows)
    contents.tail = tail.rows
    contents.index = _index(episodes, contents.table)


def _beyond_frames(store: ChunkStore, topics: dict[str, int]) -> int:
    """A number beyond those of the episodes that frames show: the steps of some may be lost."""
    beyond = 0
    for topic, channel in topics.items():
        if "/frame/" in topic:
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


def _unstarted(
    store: ChunkStore, layout: StepLayout, steps: list[int], available: list[int], known: set[int]
) -> Iterator[tuple[EpisodeStart, int]]:
    """Starts made for episodes that have steps but lost their `/episode_start` (with the journal), and their times."""
    for env, channel in enumerate(steps):
        row, last = 0, -1
        for episode, _, _, time in _step_facts(store, layout, channel, 0, available[env]):
            if episode != last and episode not in known:
                yield EpisodeStart(episode, env, row, False, False, "", "", "{}"), time
            row, last = row + 1, episode


def _available(store: ChunkStore, topics: dict[str, int], layout: StepLayout, channel: Channel) -> int:
    """Steps of a sub-environment that are whole: of which all images are there."""
    top = channel.topic.removesuffix("/step")
    images = [topics.get(f"{top}/image/{leaf.name}", 0) for leaf in layout.images]
    return min(store.count(one) for one in (channel.id, *images))


def _rows_of(
    store: ChunkStore,
    layout: StepLayout,
    steps: list[int],
    available: list[int],
    start: EpisodeStart,
    number: int,
) -> tuple[int, float, int, int] | None:
    """(length, return, end, time of the last step) of an episode without an end; None if it has no step."""
    if start.env >= len(steps):
        return None
    channel = steps[start.env]
    count = available[start.env] - start.first_row
    if count <= 0:
        return None
    total, length, last, time = 0.0, 0, (False, False), 0
    for episode, reward, flags, at in _step_facts(store, layout, channel, start.first_row, count):
        if episode != number:
            break
        total, length, last, time = total + reward, length + 1, flags, at
        if any(flags):
            break
    if not length:
        return None
    return length, total, 0 if last[0] else 1 if last[1] else 2, time


def _step_facts(
    store: ChunkStore, layout: StepLayout, channel: int, first: int, count: int
) -> Iterator[tuple[int, float, tuple[bool, bool], int]]:
    names = [leaf.name for leaf in layout.reward]
    if layout.constant:
        for span in store.spans(channel, first, count):
            rows = store.rows(span.chunk, layout.step_message.dtype)[span.begin : span.end]
            rewards = sum(rows[name].reshape(len(rows), -1).sum(axis=1, dtype=np.float64) for name in names)
            yield from zip(
                rows["episode"].tolist(),
                np.asarray(rewards).tolist(),
                zip(rows["terminal"].tolist(), rows["timeout"].tolist(), strict=True),
                rows["#log_time"].tolist(),
                strict=True,
            )
        return
    decoder = MessageDecoder(layout)
    for span in store.spans(channel, first, count):
        data = memoryview(store.load(span.chunk))
        for start, end in store.messages(span.chunk)[span.begin : span.end]:
            values = decoder.step(data[start + BODY : end])
            reward = float(sum(np.sum(values[name]) for name in names))
            time = int.from_bytes(data[start + 15 : start + 23], "little")
            yield values["episode"], reward, (values["terminal"], values["timeout"]), time
