"""Derives episodes from what is left of them: runs of steps, starts, ends, final states, the index.

If all steps of an episode were found, it stays one episode. If rows are missing in between, each run of consecutive
steps becomes an episode: the first run keeps the number, and only the run with the old last step keeps the end.
"""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT, EpisodeEnd, EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.index import HAS_SEED, EpisodeIndex
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore, RecordedChannels, decoded
from tupli_mcap.recording.recover.step_runs import Ranges, StepRun, step_runs

_END = 1 << 64  # above any row number
RUNNING, IN_A_HOLE = -1, -2  # in place of the row of a final state: it is in the journal


class Start(NamedTuple):
    """The start of an episode and its time (ns); `row` is its row in `/episode_start`, None if it has to be made."""

    time: int
    start: EpisodeStart
    row: int | None = None


class End(NamedTuple):
    """The end of an episode and its time (ns); `row` as in `Start`."""

    time: int
    end: EpisodeEnd
    row: int | None = None


@dataclass
class EpisodeRecords:
    """The messages of the episode channels and the entries of the index, by episode.

    `resets` are resets before an episode that no step followed. `ignored` are ends whose steps are not all left.
    """

    starts: dict[int, Start] = field(default_factory=dict)
    resets: dict[int, list[Start]] = field(default_factory=dict)
    ends: dict[int, End] = field(default_factory=dict)
    finals: dict[int, int] = field(default_factory=dict)  # rows of `/final_state`
    index: dict[int, int] = field(default_factory=dict)  # positions in the index
    ignored: list[int] = field(default_factory=list)


class PlannedEpisode(NamedTuple):
    """An episode of the recovered recording, made of a run of an old episode's steps.

    Attributes:
        number: of the new episode.
        run: its steps.
        whole: it has all steps of the old one.
        head, tail: it has the old one's first, last step.
        length: of the old episode; None if not known.
        start, end: of the new episode.
        final: row of its final state in `/final_state` (as packed), RUNNING, IN_A_HOLE, or None if there is none.
        orphan: metadata of the old episode, if the run lacks its last step.
        resets: resets without a step before it.
    """

    number: int
    run: StepRun
    whole: bool
    head: bool
    tail: bool
    length: int | None
    start: Start
    end: End
    final: int | None
    orphan: str = ""
    resets: tuple[Start, ...] = ()


@dataclass
class Plan:
    """The episodes in the order of their rows, and the numbers of episodes whose starts, ends, final states are lost.

    `kept` are the rows that are kept, `totals` the numbers of rows that there were, by sub-environment.
    """

    records: EpisodeRecords
    kept: dict[int, Ranges]
    totals: list[int]
    episodes: list[PlannedEpisode] = field(default_factory=list)
    lost_starts: list[int] = field(default_factory=list)
    lost_ends: list[int] = field(default_factory=list)
    lost_finals: list[int] = field(default_factory=list)
    next_episode: int = 0


class NewPlaces:
    """Finds steps of old episodes in the episodes that were made of them."""

    def __init__(self, episodes: Iterable[PlannedEpisode]) -> None:
        self._of: dict[int, list[PlannedEpisode]] = {}
        for episode in sorted(episodes, key=lambda episode: episode.run.step):
            self._of.setdefault(episode.run.episode, []).append(episode)

    def find(self, number: int, step: int, *, state: bool = False) -> tuple[int, int] | None:
        """The new episode and step of an old episode's step; None if it is in none.

        With `state`, `step` is the number of a state: the one after an episode's last step belongs to the episode.
        """
        parts = self._of.get(number, [])
        at = bisect.bisect_right(parts, step, key=lambda part: part.run.step) - 1
        if at < 0 or step - parts[at].run.step >= parts[at].run.steps + state:
            return None
        return parts[at].number, step - parts[at].run.step


def final_state(evidence: Evidence, episode: PlannedEpisode) -> bytes:
    """The CDR body of a final state that is RUNNING or IN_A_HOLE, with the episode's number."""
    run = episode.run
    is_hole = episode.final == IN_A_HOLE
    state = evidence.finals[run.env, run.stop].state if is_hole else evidence.states[run.env]
    return episode.number.to_bytes(4, "little") + run.env.to_bytes(4, "little") + state


def make_plan(evidence: Evidence, store: PackedStore, layout: StepLayout, channels: RecordedChannels) -> Plan:
    """Decides which episode each row that is left belongs to; with `evidence.strict`, FormatError if a step, a start or
    an end cannot be decoded."""
    runs = list(step_runs(evidence, store, layout, channels))
    kept: dict[int, Ranges] = {env: [] for env in range(len(channels.steps))}
    for run in runs:
        kept[run.env].append((run.row, run.stop))
    records = _read_records(evidence, store, channels)
    if evidence.strict:
        _ignore_ends(records, kept)
    _add_index(records, evidence.file_end.index)
    plan = Plan(records, kept, _totals(evidence, channels, records))
    return _Planner(evidence, plan, runs, channels, images=bool(layout.images)).run()


# ---- records


def _read_records(evidence: Evidence, store: PackedStore, channels: RecordedChannels) -> EpisodeRecords:
    """Reads starts, ends and final states; in repair, it skips messages that cannot be decoded."""
    records = EpisodeRecords()
    for row, time, start in decoded(store, channels.start, EpisodeStart.decode, strict=evidence.strict):
        if start.episode in records.starts:
            records.resets.setdefault(start.episode, []).append(records.starts[start.episode])
        records.starts[start.episode] = Start(time, start, row)
    for row, time, end in decoded(store, channels.end, EpisodeEnd.decode, strict=evidence.strict):
        records.ends[end.episode] = End(time, end, row)
    for row, _, body in store.all_messages(channels.final):
        records.finals[int.from_bytes(body[:4], "little")] = row
    return records


def _ignore_ends(records: EpisodeRecords, kept: dict[int, Ranges]) -> None:
    """Removes ends whose steps were not all found, or whose first row is not their start's."""
    for number, (_, end, _) in list(records.ends.items()):
        rows = kept.get(end.env, [])
        start = records.starts[number].start if number in records.starts else end
        begins = (start.env, start.first_row) == (end.env, end.first_row)
        if not begins or end.first_row + end.length > (rows[-1][1] if rows else 0):
            del records.ends[number]
            records.ignored.append(number)


def _add_index(records: EpisodeRecords, index: EpisodeIndex | None) -> None:
    """Adds the ends that only the index has."""
    if index is None:
        return
    for i, row in enumerate(index.episodes):
        records.index[int(row["episode"])] = i
        if int(row["episode"]) in records.ends:
            continue
        try:
            metadata = index.metadata_text(i)
        except FormatError:
            continue
        end = EpisodeEnd(
            int(row["episode"]), int(row["env"]), int(row["first_row"]), int(row["length"]), float(row["return"]),
            int(row["end"]), int(row["final_row"]) >= 0, metadata,
        )  # fmt: skip
        records.ends[end.episode] = End(int(row["end_time"]), end)


def _totals(evidence: Evidence, channels: RecordedChannels, records: EpisodeRecords) -> list[int]:
    """The number of rows that each sub-environment had, as far as the file shows."""
    totals = [evidence.stop(channel) for channel in channels.steps]
    statistics = evidence.file_end.statistics
    for env, channel in enumerate(channels.steps):
        ids = [channel, *(images[env] for images in channels.images.values())]
        if statistics is not None:
            counts = (statistics.channel_message_counts.get(i, 0) for i in ids if i is not None)
            totals[env] = max(totals[env], *counts)
    for _, end, _ in records.ends.values():
        if end.env < len(totals):
            totals[end.env] = max(totals[end.env], end.first_row + end.length)
    return totals


# ---- the plan


class _Planner:
    def __init__(
        self, evidence: Evidence, plan: Plan, runs: list[StepRun], channels: RecordedChannels, *, images: bool
    ) -> None:
        self._evidence, self._plan, self._records = evidence, plan, plan.records
        self._runs, self._images = runs, images
        records = self._records
        numbers = (
            [run.episode for run in runs] + list(records.starts) + list(records.ends) + list(records.index)
        )
        left_out = (evidence.metadata or {}).get("next_episode", "")
        self._next = max([*numbers, int(left_out) - 1 if left_out.isdecimal() else -1]) + 1
        starts = [] if channels.start is None else evidence.ranges(channels.start)
        self._starts_whole = all(first == 0 for first, _ in starts)  # none is missing before or between them
        self._taken: set[int] = set()
        # whether no rows can be missing after the last known one
        self._knows_totals = not evidence.file_end.finished or evidence.file_end.statistics is not None

    def run(self) -> Plan:
        for run in self._runs:
            self._plan.episodes.append(self._episode(run))
        self._plan.next_episode = self._next
        return self._plan

    def _length(self, run: StepRun) -> int | None:
        """The number of steps of the old episode; None if it is not known."""
        old = self._records.ends.get(run.episode)
        if old is None or old.end.env != run.env:
            return None
        return old.end.length if old.end.first_row == run.row - run.step else None

    def _episode(self, run: StepRun) -> PlannedEpisode:
        length = self._length(run)
        last = self._knows_totals and run.stop == self._plan.totals[run.env]
        ended = run.terminal or run.timeout
        tail = run.step + run.steps == length if length is not None else ended or run.closed or last
        head = run.step == 0
        number = run.episode
        if number in self._taken:
            number, self._next = self._next, self._next + 1
        self._taken.add(number)
        final = self._final(run, last=last) if tail else None
        start = self._start(run, number, head=head)
        end = self._end(run, number, length, final is not None, head=head, tail=tail)
        old_end = self._records.ends.get(run.episode)
        resets = self._records.resets.get(number, []) if head else []
        return PlannedEpisode(
            number, run, head and tail and number == run.episode, head, tail, length, start, end, final,
            orphan="" if old_end is None or tail else old_end.end.metadata,
            resets=tuple(reset for reset in resets if reset.start.env == run.env),
        )  # fmt: skip

    def _final(self, run: StepRun, *, last: bool) -> int | None:
        """The final state of an episode whose last step was found; a lost one is noted."""
        old_end = self._records.ends.get(run.episode)
        if old_end is not None and not old_end.end.has_final_state:
            return None
        ended = run.terminal or run.timeout
        # without an end, the final state belongs to a step that was not finished
        unfinished = old_end is None and not ended and not self._evidence.file_end.finished
        if run.episode in self._records.finals and not unfinished:
            return self._records.finals[run.episode]
        if ended and not self._images and (run.env, run.stop) in self._evidence.finals:
            return IN_A_HOLE  # not with images: the next episode's were written over them
        is_running = last and old_end is None and run.env in self._evidence.states
        if is_running and not (ended and self._evidence.final_lost):
            return RUNNING
        self._plan.lost_finals.append(run.episode)
        return None

    def _start(self, run: StepRun, number: int, *, head: bool) -> Start:
        if not head:
            return Start(run.first_time, EpisodeStart(number, run.env, 0, False, True, "", "", "{}"))
        if run.episode in self._records.starts and number == run.episode:
            old = self._records.starts[run.episode]
            if old.start.env == run.env:
                return old
        hole = self._evidence.finals.get((run.env, run.row))
        if hole is None or not self._starts_whole:
            self._plan.lost_starts.append(run.episode)
        seed, time = "", run.first_time if hole is None else hole.time_ns
        index = self._evidence.file_end.index
        if index is not None and number in self._records.index:
            row = index.episodes[self._records.index[number]]
            seed, time = str(int(row["seed"])) if row["has_seed"] == HAS_SEED else "", int(row["start_time"])
        return Start(time, EpisodeStart(number, run.env, 0, False, False, seed, "", "{}"))

    def _end(
        self, run: StepRun, number: int, length: int | None, has_final: bool, *, head: bool, tail: bool
    ) -> End:
        old = self._records.ends.get(run.episode) if tail and length is not None else None
        how = TERMINAL if run.terminal else TIMEOUT if run.timeout else INTERRUPTED
        metadata, time, total, row = "{}", run.last_time, run.total, None
        if old is not None:
            time, metadata, how, row = old.time, old.end.metadata, old.end.end, old.row
            if head:
                total = old.end.episode_return
        elif tail and self._evidence.file_end.finished:
            self._plan.lost_ends.append(run.episode)
        return End(time, EpisodeEnd(number, run.env, 0, run.steps, total, how, has_final, metadata), row)


# ---- what is lost


def losses(plan: Plan) -> tuple[dict[int, list[tuple[int, int | None]]], int]:
    """The steps that are lost, by old episode: ranges (None: the end is not known); and their known number."""
    runs: dict[int, list[StepRun]] = {}
    for episode in plan.episodes:
        runs.setdefault(episode.run.episode, []).append(episode.run)
    ended = {episode.run.episode for episode in plan.episodes if episode.tail}
    steps = {}
    for number in sorted(set(runs) | set(plan.records.ends) | set(plan.records.starts)):
        lost = _of_episode(plan, number, runs.get(number, []), ended=number in ended)
        if lost:
            steps[number] = lost
    kept = sum(stop - first for ranges in plan.kept.values() for first, stop in ranges)
    return steps, sum(plan.totals) - kept


def _of_episode(plan: Plan, number: int, runs: list[StepRun], *, ended: bool) -> list[tuple[int, int | None]]:
    end = plan.records.ends.get(number)
    at = 0
    lost: list[tuple[int, int | None]] = []
    for run in sorted(runs, key=lambda run: run.step):
        if run.step > at:
            lost.append((at, run.step))
        at = max(at, run.step + run.steps)
    if end is not None and end.end.length > at:
        lost.append((at, end.end.length))
    if end is None and not ended and (runs or _is_in_a_hole(plan, number)):
        lost.append((at, None))
    return lost


def _is_in_a_hole(plan: Plan, number: int) -> bool:
    """Whether an episode of which only the start is left had steps."""
    start = plan.records.starts[number].start
    kept = plan.kept.get(start.env, [])
    after = bisect.bisect_right(kept, (start.first_row, _END))
    total = plan.totals[start.env] if start.env < len(plan.totals) else 0
    behind = after == len(kept) and start.first_row >= total
    return not behind and not (after and start.first_row < kept[after - 1][1])
