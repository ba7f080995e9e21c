"""Starts and ends of several episodes in one append to the journal, as a vector environment has them at one step."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from tupli_mcap.recording.events import encode_end, encode_start
from tupli_mcap.recording.writer import EPISODE_AND_ENV, RecordingWriter, ResetFacts, StartedEpisode

__all__ = ["EndedEpisode", "StartingEpisode", "end_episodes", "start_episodes"]

_BATCH = 64 * 1024  # bytes: more go to the journal, and at its end to a chunk, in several appends


class StartingEpisode(NamedTuple):
    """An episode about to start at row `first_row` of the steps of `env`."""

    env: int
    first_row: int
    reset: ResetFacts


class EndedEpisode(NamedTuple):
    """What there is to say of an episode when it ends.

    `final_state` follows `episode` and `env` in `/final_state`; None if it is there already, as row `final_row`, or not
    known (-1).
    """

    episode: StartedEpisode
    end: int
    length: int
    total: float
    final_state: bytes | None
    metadata: str
    final_row: int = -1


def start_episodes(writer: RecordingWriter, starting: Sequence[StartingEpisode]) -> list[StartedEpisode]:
    """`RecordingWriter.start_episode` of each; their streams must not be lost ones."""
    if writer.events is None:
        return [writer.start_episode(*start) for start in starting]
    events, channel = writer.events, writer.channels.start
    started: list[StartedEpisode] = []
    sizes = [len(reset.options) + len(reset.info) for _, _, reset in starting]
    for begin, end in _batches(sizes):
        messages, row = [], events.sequences[channel]
        now = max(events.latest_ns, *[start.reset.time_ns for start in starting[begin:end]])
        for env, first_row, reset in starting[begin:end]:
            seed = reset.seed if reset.seed is not None else reset.drawn_seed
            text = "" if seed is None else str(seed)
            number = writer.next_episode
            writer.next_episode = number + 1
            given = reset.seed is not None
            body = encode_start(
                number, env, first_row, given, reset.continued, text, reset.options, reset.info
            )
            messages.append((channel, body))
            started.append(StartedEpisode(number, env, first_row, now, seed, row))
            row += 1
        events.append(now, *messages)
    return started


def end_episodes(writer: RecordingWriter, ended: Sequence[EndedEpisode]) -> None:
    """`RecordingWriter.end_episode` of each."""
    if writer.events is None:
        return
    events, channels, index = writer.events, writer.channels, writer.index
    sizes = [len(text) + (0 if state is None else len(state)) for *_, state, text, _ in ended]
    for begin, stop in _batches(sizes):
        messages, facts = [], []
        final, end_row = events.sequences[channels.final_state], events.sequences[channels.end]
        now = max(time.time_ns(), events.latest_ns)
        for episode, end, length, total, state, text, final_row in ended[begin:stop]:
            number, env, first_row, began, seed, start_row = episode
            if state is not None:
                messages.append((channels.final_state, EPISODE_AND_ENV.pack(number, env) + state))
                final_row, final = final, final + 1
            body = encode_end(number, env, first_row, length, total, end, final_row >= 0, text)
            messages.append((channels.end, body))
            row = first_row, length, total, began, now, seed, start_row, end_row, final_row, number, env, end
            facts.append((row, text))
            end_row += 1
        events.append(now, *messages)
        for row, text in facts:
            index.add(row, text)
    writer.flush_if_due()


def _batches(sizes: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Ranges of consecutive items, each of about `_BATCH` bytes."""
    if sum(sizes) <= _BATCH:
        if sizes:
            yield 0, len(sizes)
        return
    begin = total = 0
    for i, size in enumerate(sizes):
        total += size
        if total > _BATCH:
            yield begin, i + 1
            begin, total = i + 1, 0
    if begin < len(sizes):
        yield begin, len(sizes)
