"""What is here of a damaged recording: its channels, and its steps as segments of consecutive ones."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from tupli_mcap.mcap.chunk_records import message_headers
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.contents import step_channels
from tupli_mcap.recording.recover.evidence import Gathered, PackedStore
from tupli_mcap.recording.recover.step_runs import StepFacts, step_facts, sum_up

__all__ = ["Channels", "Ranges", "Segment", "intersection", "message_at", "messages", "segments"]

Ranges = list[tuple[int, int]]


class Channels(NamedTuple):
    """Ids in the damaged file: by sub-environment, and by image leaf then sub-environment; None: not known."""

    steps: list[int]
    images: dict[str, list[int | None]]
    start: int | None
    end: int | None
    final: int | None
    info: int | None

    @classmethod
    def of(cls, gathered: Gathered, layout: StepLayout) -> Channels:
        """The channels of a recording, by their topics."""
        found = step_channels(gathered.channels, gathered.source.name)
        topics = {channel.topic: channel.id for channel in gathered.channels.values()}
        images = {
            leaf.name: [topics.get(Topics.of_step(channel.topic).image(leaf.name)) for channel in found]
            for leaf in layout.images
        }
        names = (EPISODE_START, EPISODE_END, FINAL_STATE, INFO)
        return cls([channel.id for channel in found], images, *(topics.get(name) for name in names))


class Segment(NamedTuple):
    """Consecutive rows that are here, of consecutive steps of one episode; times in ns.

    `closed`: the row after it is here and another episode's, or there can be none.
    """

    env: int
    row: int
    steps: int
    episode: int
    step: int
    total: float
    terminal: bool
    timeout: bool
    first_time: int
    last_time: int
    closed: bool


def intersection(a: Ranges, b: Ranges) -> Ranges:
    """What two lists of ranges have in common."""
    found: Ranges = []
    i = j = 0
    while i < len(a) and j < len(b):
        low, high = max(a[i][0], b[j][0]), min(a[i][1], b[j][1])
        if low < high:
            found.append((low, high))
        if a[i][1] < b[j][1]:
            i += 1
        else:
            j += 1
    return found


def segments(
    gathered: Gathered, store: PackedStore, layout: StepLayout, channels: Channels
) -> Iterator[Segment]:
    """The segments of all sub-environments, in the order of their rows."""
    for env, channel in enumerate(channels.steps):
        here = gathered.ranges(channel)
        for ids in channels.images.values():
            image = ids[env]
            here = intersection(here, [] if image is None else gathered.ranges(image))
        for first, stop in here:
            open_: Segment | None = None
            row = first
            at = store.packed(channel, first)
            # a chunk may hold many of the ranges
            for facts in step_facts(store, layout, channel, at, stop - first, keep=True):
                for found in _cut(facts, env, row, open_):
                    if open_ is not None and _continues(open_, found):
                        open_ = _joined(open_, found)
                        continue
                    if open_ is not None:
                        yield open_._replace(closed=open_.row + open_.steps == found.row)
                    open_ = found
                row += len(facts.episode)
            if open_ is not None:
                yield open_


def _cut(facts: StepFacts, env: int, row: int, before: Segment | None) -> Iterator[Segment]:
    """The segments of one batch of rows, which starts at `row`; the return of one that goes on is that of both."""
    episode, step = facts.episode.astype(np.int64), facts.step.astype(np.int64)
    flagged = (facts.terminal != 0) | (facts.timeout != 0)
    breaks = (episode[1:] != episode[:-1]) | (step[1:] != step[:-1] + 1) | flagged[:-1]
    edges = {0, len(episode), *(np.flatnonzero(breaks) + 1).tolist()}
    edges |= set(facts.bad) | {i + 1 for i in facts.bad}
    order = sorted(edges)
    for begin, end in itertools.pairwise(order):
        if begin in facts.bad:
            continue
        found = Segment(
            env, row + begin, end - begin, int(episode[begin]), int(step[begin]), 0.0,
            bool(facts.terminal[end - 1]), bool(facts.timeout[end - 1]),
            int(facts.time[begin]), int(facts.time[end - 1]), False,
        )  # fmt: skip
        earlier = before.total if before is not None and _continues(before, found) else 0.0
        yield found._replace(total=sum_up(facts.reward[begin:end], earlier))


def _continues(a: Segment, b: Segment) -> bool:
    together = a.row + a.steps == b.row and a.episode == b.episode and a.step + a.steps == b.step
    return together and not (a.terminal or a.timeout)


def _joined(a: Segment, b: Segment) -> Segment:
    return a._replace(
        steps=a.steps + b.steps, total=b.total,
        terminal=b.terminal, timeout=b.timeout, last_time=b.last_time,
    )  # fmt: skip


def messages(store: PackedStore, channel: int | None) -> Iterator[tuple[int, int, memoryview]]:
    """(row, log_time, body) of the messages of a channel that are here."""
    row = 0
    for chunk in [] if channel is None else store.chunks(channel):
        data = memoryview(store.load(chunk, keep=False))
        for header in message_headers(data):
            start = int(header["#offset"])
            yield row, int(header["#log_time"]), data[start + BODY : start + 9 + int(header["#length"])]
            row += 1


def message_at(store: PackedStore, channel: int, row: int) -> bytes:
    """The body of one message."""
    (span,) = store.spans(channel, row, 1)
    ((_, body),) = store.messages_of(span)
    return bytes(body)
