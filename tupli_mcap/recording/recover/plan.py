"""Which episodes a repaired recording has: what is left of each, in pieces where rows are missing."""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT, EpisodeEnd, EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.index import EpisodeIndex
from tupli_mcap.recording.recover.evidence import Gathered, PackedStore
from tupli_mcap.recording.recover.segments import Channels, Ranges, Segment, messages, segments

__all__ = ["IN_A_HOLE", "RUNNING", "NewPlaces", "Plan", "PlannedEpisode", "Told", "make_plan"]

RUNNING, IN_A_HOLE = -1, -2  # instead of the row of a final state: where in the journal it is
_END = 1 << 64  # beyond any row number


@dataclass
class Told:
    """What the messages of the episode channels say (time, message), and what the index says, by episode."""

    starts: dict[int, tuple[int, EpisodeStart]] = field(default_factory=dict)
    resets: dict[int, list[tuple[int, EpisodeStart]]] = field(
        default_factory=dict
    )  # those before it, without a step
    ends: dict[int, tuple[int, EpisodeEnd]] = field(default_factory=dict)
    finals: dict[int, int] = field(default_factory=dict)
    index: dict[int, int] = field(default_factory=dict)
    bad: int = 0


class PlannedEpisode(NamedTuple):
    """An episode of the new recording. `whole`: it is one of the old, all of it.

    `head`, `tail`: its first step was the old one's first, its last one the old one's last. `length`: of the old
    episode, None if not known. `final`: its row in the old `/final_state` (as packed), RUNNING, IN_A_HOLE, or None
    if there is none. `orphan`: metadata of the old episode, whose end is not here. `resets`: without a step, before it.
    """

    number: int
    segment: Segment
    whole: bool
    head: bool
    tail: bool
    length: int | None
    start: tuple[int, EpisodeStart]
    end: tuple[int, EpisodeEnd]
    final: int | None
    orphan: str = ""
    resets: tuple[tuple[int, EpisodeStart], ...] = ()


@dataclass
class Plan:
    """The episodes in the order of their rows; `lost` maps episodes to ranges of steps (None: to an unknown end)."""

    episodes: list[PlannedEpisode] = field(default_factory=list)
    lost: dict[int, list[tuple[int, int | None]]] = field(default_factory=dict)
    lost_starts: list[int] = field(default_factory=list)
    lost_ends: list[int] = field(default_factory=list)
    lost_finals: list[int] = field(default_factory=list)
    lost_rows: int = 0
    next_episode: int = 0


class NewPlaces:
    """The episodes that are made of each old one, by the steps that they have of it."""

    def __init__(self, episodes: Iterable[PlannedEpisode]) -> None:
        self._of: dict[int, list[PlannedEpisode]] = {}
        for episode in sorted(episodes, key=lambda episode: episode.segment.step):
            self._of.setdefault(episode.segment.episode, []).append(episode)

    def find(self, number: int, step: int, *, state: bool = False) -> tuple[int, int] | None:
        """Which step of which new episode a step of an old one is now; None if it is in none.

        With `state` it is the number of a state: that after a piece's last step belongs to it.
        """
        pieces = self._of.get(number, [])
        at = bisect.bisect_right(pieces, step, key=lambda piece: piece.segment.step) - 1
        if at < 0 or step - pieces[at].segment.step >= pieces[at].segment.steps + state:
            return None
        return pieces[at].number, step - pieces[at].segment.step


# ---- what is told of it


def read_told(gathered: Gathered, store: PackedStore, channels: Channels) -> Told:
    """Starts, ends and final states that are here; messages that cannot be decoded are counted and passed over."""
    told = Told()
    for _, time, body in messages(store, channels.start):
        try:
            start = EpisodeStart.decode(body)
        except FormatError:
            told.bad += 1
            continue
        if start.episode in told.starts:
            told.resets.setdefault(start.episode, []).append(told.starts[start.episode])
        told.starts[start.episode] = (time, start)
    for _, time, body in messages(store, channels.end):
        try:
            end = EpisodeEnd.decode(body)
        except FormatError:
            told.bad += 1
            continue
        told.ends[end.episode] = (time, end)
    for row, _, body in messages(store, channels.final):
        told.finals[int.from_bytes(body[:4], "little")] = row
    if gathered.tail.index is not None:
        told.index = {int(n): i for i, n in enumerate(gathered.tail.index.episodes["episode"])}
    return told


def _index_end(index: EpisodeIndex, i: int) -> tuple[int, EpisodeEnd] | None:
    """The end of an episode as the index has it: all of it is there."""
    row = index.episodes[i]
    try:
        metadata = index.metadata_text(i)
    except FormatError:
        return None
    end = EpisodeEnd(
        int(row["episode"]), int(row["env"]), int(row["first_row"]), int(row["length"]), float(row["return"]),
        int(row["end"]), int(row["final_row"]) >= 0, metadata,
    )  # fmt: skip
    return int(row["end_time"]), end


# ---- the plan


def make_plan(gathered: Gathered, store: PackedStore, layout: StepLayout, channels: Channels) -> Plan:
    """Decides what becomes of every row that is here."""
    told = read_told(gathered, store, channels)
    if gathered.tail.index is not None:
        for number, i in told.index.items():
            made = None if number in told.ends else _index_end(gathered.tail.index, i)
            if made is not None:
                told.ends[number] = made
    found = list(segments(gathered, store, layout, channels))
    return _Planner(gathered, told, found, images=bool(layout.images)).run(channels)


class _Planner:
    def __init__(self, gathered: Gathered, told: Told, found: list[Segment], *, images: bool) -> None:
        self._gathered = gathered
        self._images = images
        self._told = told
        self._found = found
        self._plan = Plan()
        known = [s.episode for s in found] + list(told.starts) + list(told.ends) + list(told.index)
        told_next = (gathered.metadata or {}).get("next_episode", "")
        self._next = max([*known, int(told_next) - 1 if told_next.isdecimal() else -1]) + 1
        self._starts_whole = True  # no start is missing between those that are here
        self._totals: dict[int, int] = {}
        self._taken: set[int] = set()
        self._ended: set[int] = set()  # old episodes whose last step is here
        self._here: dict[int, Ranges] = {}  # rows that are kept, by sub-environment
        for segment in found:
            self._here.setdefault(segment.env, []).append((segment.row, segment.row + segment.steps))

    def run(self, channels: Channels) -> Plan:
        of: dict[int, list[Segment]] = {}
        for segment in self._found:
            of.setdefault(segment.episode, []).append(segment)
        stops: dict[int, int] = {}  # where the ends say that the rows of a sub-environment end
        for _, end in self._told.ends.values():
            stops[end.env] = max(stops.get(end.env, 0), end.first_row + end.length)
        starts = [] if channels.start is None else self._gathered.ranges(channels.start)
        self._starts_whole = all(first == 0 for first, _ in starts)
        totals = [self._total(env, channels, stops.get(env, 0)) for env in range(len(channels.steps))]
        self._totals = dict(enumerate(totals))
        for segment in self._found:
            last = self._here[segment.env][-1][1] == totals[segment.env]
            self._plan.episodes.append(self._episode(segment, last=last and self._knows_total))
        self._ended = {e.segment.episode for e in self._plan.episodes if e.tail}
        for number in sorted(set(of) | set(self._told.ends) | set(self._told.starts)):
            self._note_loss(number, of.get(number, []))
        for env, total in enumerate(totals):
            self._plan.lost_rows += total - sum(b - a for a, b in self._here.get(env, []))
        self._plan.next_episode = self._next
        return self._plan

    def _total(self, env: int, channels: Channels, told: int) -> int:
        """Rows that a sub-environment had, as far as anything tells."""
        ids = [channels.steps[env], *(images[env] for images in channels.images.values())]
        stops = [p.stop for i in ids[:1] if i is not None for p in self._gathered.pieces.get(i, [])[-1:]]
        statistics = self._gathered.tail.statistics
        if statistics is not None:
            stops += [statistics.channel_message_counts.get(i, 0) for i in ids if i is not None]
        return max(told, *stops, 0)

    def _length(self, segment: Segment) -> int | None:
        """The steps of the old episode, if that is known."""
        told = self._told.ends.get(segment.episode)
        if told is None or told[1].env != segment.env:
            return None
        return told[1].length if told[1].first_row == segment.row - segment.step else None

    @property
    def _knows_total(self) -> bool:
        """Whether there can be no row after the last one that is known."""
        return not self._gathered.tail.finished or self._gathered.tail.statistics is not None

    def _episode(self, segment: Segment, *, last: bool) -> PlannedEpisode:
        length = self._length(segment)
        stop = segment.step + segment.steps
        ended = segment.terminal or segment.timeout
        closing = last and segment.row + segment.steps == self._here[segment.env][-1][1]
        tail = stop == length if length is not None else ended or segment.closed or closing
        head = segment.step == 0
        number = segment.episode
        if number in self._taken:
            number, self._next = self._next, self._next + 1
        self._taken.add(number)
        whole = head and tail and number == segment.episode
        final = self._final(segment, closing) if tail else None
        start = self._start(segment, number, head=head)
        end = self._end(segment, number, length, final is not None, head=head, tail=tail)
        told = self._told.ends.get(segment.episode)
        orphan = "" if told is None or tail else told[1].metadata
        resets = tuple(
            reset for reset in self._told.resets.get(number, ()) if head and reset[1].env == segment.env
        )
        return PlannedEpisode(number, segment, whole, head, tail, length, start, end, final, orphan, resets)

    def _final(self, segment: Segment, closing: bool) -> int | None:
        told = self._told.ends.get(segment.episode)
        if told is not None and not told[1].has_final_state:
            return None
        ended = segment.terminal or segment.timeout
        running = closing and told is None
        # as in recovery: one that is here may be of a step that was not finished, the state of the next episode
        unfinished = told is None and not ended and not self._gathered.tail.finished
        if segment.episode in self._told.finals and not unfinished:
            return self._told.finals[segment.episode]
        if ended and not self._images and (segment.env, segment.row + segment.steps) in self._gathered.finals:
            return IN_A_HOLE
        if running and segment.env in self._gathered.states and not (ended and self._gathered.final_lost):
            return RUNNING
        self._plan.lost_finals.append(segment.episode)
        return None

    def _start(self, segment: Segment, number: int, *, head: bool) -> tuple[int, EpisodeStart]:
        if not head:
            return segment.first_time, EpisodeStart(number, segment.env, 0, False, True, "", "", "{}")
        if segment.episode in self._told.starts and number == segment.episode:
            time, start = self._told.starts[segment.episode]
            if start.env == segment.env:
                return time, start
        hole = self._gathered.finals.get((segment.env, segment.row))
        if hole is None or not self._starts_whole:
            self._plan.lost_starts.append(segment.episode)
        seed, time = "", segment.first_time if hole is None else hole.time_ns
        index = self._gathered.tail.index
        if index is not None and number in self._told.index:
            row = index.episodes[self._told.index[number]]
            seed, time = str(int(row["seed"])) if row["has_seed"] else "", int(row["start_time"])
        return time, EpisodeStart(number, segment.env, 0, False, False, seed, "", "{}")

    def _end(
        self, segment: Segment, number: int, length: int | None, has_final: bool, *, head: bool, tail: bool
    ) -> tuple[int, EpisodeEnd]:
        told = self._told.ends.get(segment.episode) if tail and length is not None else None
        how = TERMINAL if segment.terminal else TIMEOUT if segment.timeout else INTERRUPTED
        metadata, time, total = "{}", segment.last_time, segment.total
        if told is not None:
            time, metadata, how = told[0], told[1].metadata, told[1].end
            if head:
                total = told[1].episode_return
        elif tail and self._gathered.tail.finished:
            self._plan.lost_ends.append(segment.episode)
        return time, EpisodeEnd(number, segment.env, 0, segment.steps, total, how, has_final, metadata)

    def _note_loss(self, number: int, found: list[Segment]) -> None:
        """The steps of an episode that are not here."""
        told = self._told.ends.get(number)
        at = 0
        lost: list[tuple[int, int | None]] = []
        for segment in sorted(found, key=lambda s: s.step):
            if segment.step > at:
                lost.append((at, segment.step))
            at = max(at, segment.step + segment.steps)
        if told is not None and told[1].length > at:
            lost.append((at, told[1].length))
        if told is None and number not in self._ended and (found or self._in_a_hole(number)):
            lost.append((at, None))
        if lost:
            self._plan.lost[number] = lost

    def _in_a_hole(self, number: int) -> bool:
        """Whether an episode of which only the start is here had steps that are not."""
        _, start = self._told.starts[number]
        here = self._here.get(start.env, [])
        after = bisect.bisect_right(here, (start.first_row, _END))
        behind = after == len(here) and start.first_row >= self._totals.get(start.env, 0)
        return not behind and not (after and start.first_row < here[after - 1][1])
