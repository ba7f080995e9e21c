"""Starts and ends of episodes while they are recorded: written ones, and ones that are still to be derived from rows.

The recorder derives most starts and ends only at a flush. Here they are made earlier:

1. A start is made once its reset has left a hole.
2. An end is made once there is a hole behind its last step; else at the second look, since at the first one the
   recorder may be about to write it.
3. An end made here has the time of the episode's last step, even where the recorder will give it the time of writing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence

import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.records import BODY, CDR_HEADER
from tupli_mcap.messages.episodes import TERMINAL, TIMEOUT, EpisodeEnd, EpisodeStart
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE
from tupli_mcap.recording.about.success import success_of
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.recover.evidence import Evidence
from tupli_mcap.recording.recover.step_runs import StepRun, runs_in
from tupli_mcap.viewer.live.new_rows import NewSteps, messages_of

_STARTS = np.dtype([("episode", "<u4"), ("env", "<u4"), ("first_row", "<u8")])
_ENDS = np.dtype([*_STARTS.descr, ("length", "<u8"), ("return", "<f8")])
_LOOKED_AT = 500  # ends whose metadata are read at a time
_NUMBER = len(CDR_HEADER)  # where messages have the number of their episode


class _Shown:
    """Numbers of the episodes whose start (or end) was written lately, or was shown `ahead` of being written."""

    def __init__(self) -> None:
        self.ahead: set[int] = set()
        self._before: set[int] = set()
        self._now: set[int] = set()

    def note(self, numbers: Array) -> set[int]:
        """Notes what was written since the last look; returns the numbers that have been shown already."""
        self._before, self._now = self._now, set(numbers.tolist())
        known = self.ahead & self._now
        self.ahead -= known
        return known

    def __contains__(self, number: int) -> bool:
        return number in self.ahead or number in self._now or number in self._before


class EpisodeNews:
    """The starts and ends of episodes since the last look. `new_rows` returns the rows of a channel that were not
    looked at; `seen` has how many of each were."""

    def __init__(
        self, topics: Mapping[str, int], new_rows: Callable[[int], range], seen: MutableMapping[int, int]
    ) -> None:
        self._start, self._end, self._final = topics[EPISODE_START], topics[EPISODE_END], topics[FINAL_STATE]
        self._new_rows, self._seen = new_rows, seen
        self._earlier = seen.get(self._end, 0)
        self._starts, self._ends = _Shown(), _Shown()
        self._last: dict[int, StepRun] = {}  # by sub-environment
        self._waiting: dict[int, StepRun] = {}  # by number, ended episodes that wait for the second look
        self.count = 0  # ended episodes
        self.successes: list[bool] = []  # of the ends written since the last look, if they have `success`

    def look(
        self,
        store: ChunkStore,
        evidence: Evidence,
        steps: Sequence[NewSteps],
        counts: Sequence[int],
        *,
        is_over: bool,
    ) -> Array:
        """The new ends: `episode`, `env`, `first_row`, `length`, `return`. `counts` are rows by sub-environment."""
        self._store = store
        self._rows = {channel: self._new_rows(channel) for channel in (self._final, self._end, self._start)}
        starts = self._fields(self._start, _STARTS)
        if len(starts) and not is_over and _is_empty(starts[-1], counts):  # the recorder may take it back
            starts, rows = starts[:-1], self._rows[self._start]
            self._rows[self._start], self._seen[self._start] = rows[:-1], rows.stop - 1
        ends = self._fields(self._end, _ENDS)
        self.successes = list(self._told())
        known = self._ends.note(ends["episode"])
        self._known = {
            self._start: self._starts.note(starts["episode"]),
            self._end: known,
            self._final: known,
        }
        self._made: list[tuple[int, int, bytes]] = []
        before, self._waiting = self._waiting, {}
        made = [self._make_end(evidence, run, counts) for run in before.values()]
        for new in steps:
            for run in self._whole_runs(new):
                if run.row >= new.first:
                    self._make_start(evidence, run)
                if run.terminal or run.timeout:
                    made.append(self._make_end(evidence, run, None))
        self.count = store.count(self._end) - self._earlier + len(self._ends.ahead)
        fresh = ends[~np.isin(ends["episode"], list(known))]
        return np.concatenate([fresh, np.array([end for end in made if end is not None], _ENDS)])

    def _told(self) -> Iterator[bool]:
        """Whether the newest episodes with a written end succeeded, by their metadata."""
        for _, message in messages_of(self._store, self._end, self._rows[self._end][-_LOOKED_AT:]):
            with contextlib.suppress(FormatError):  # a damaged one is not shown
                metadata = EpisodeEnd.decode(memoryview(message)[_NUMBER:]).metadata
                said = None if metadata == "{}" else success_of(jsonvalue.loads(metadata))
                if said is not None:
                    yield said

    def _fields(self, channel: int, dtype: np.dtype[np.void]) -> Array:
        """The first fields of the new messages of a channel."""
        parts: list[Array] = [np.empty(0, dtype)]
        rows = self._rows[channel]
        for span in self._store.spans(channel, rows.start, len(rows)):
            data, places = self._store.records(span.chunk)
            each: Array = np.ndarray(len(data) - BODY - dtype.itemsize + 1, dtype, data, BODY, (1,))
            parts.append(each[places[span.begin : span.end, 0]])
        return np.concatenate(parts)

    def _whole_runs(self, new: NewSteps) -> Iterator[StepRun]:
        """The rows so far of each episode whose rows were all looked at."""
        for run in runs_in(new.facts, new.env, new.first, self._last.get(new.env)):
            self._last[new.env] = run
            if run.step == 0:
                yield run

    def _make_start(self, evidence: Evidence, run: StepRun) -> None:
        hole = evidence.finals.get((run.env, run.row))
        if hole is not None and run.episode not in self._starts:
            start = EpisodeStart(run.episode, run.env, run.row, False, False, "", "", "{}")
            self._made.append((self._start, hole.time_ns, CDR_HEADER + start.encode()))
            self._starts.ahead.add(run.episode)

    def _make_end(
        self, evidence: Evidence, run: StepRun, counts: Sequence[int] | None
    ) -> tuple[int, int, int, int, float] | None:
        """Makes the end of an episode and its final state; None if it is written, or cannot be made yet.

        counts: rows by sub-environment, given at the second look only.
        """
        number, env = run.episode, run.env
        if number in self._ends:
            return None
        hole, state = evidence.finals.get((env, run.stop)), None
        if hole is not None:
            state = hole.state
        elif counts is None:
            self._waiting[number] = run
        elif counts[env] == run.stop:
            state = evidence.states.get(env)
        if state is None:
            return None
        facts = number, env, run.row, run.steps, run.total
        end = EpisodeEnd(*facts, TERMINAL if run.terminal else TIMEOUT, True, "{}")
        head = number.to_bytes(4, "little") + env.to_bytes(4, "little")
        self._made.append((self._final, run.last_time, CDR_HEADER + head + state))
        self._made.append((self._end, run.last_time, CDR_HEADER + end.encode()))
        self._ends.ahead.add(number)
        return facts

    def messages(self, most: int) -> list[tuple[int, int, bytes]]:
        """(channel, log_time, CDR message) of the newest new starts, final states and ends."""
        found = list(self._made)
        for channel, rows in self._rows.items():
            for time_ns, message in messages_of(self._store, channel, rows[-most:]):
                if int.from_bytes(message[_NUMBER : _NUMBER + 4], "little") not in self._known[channel]:
                    found.append((channel, time_ns, message))
        order = list(self._rows)
        return sorted(found, key=lambda message: (message[1], order.index(message[0])))[-most:]


def _is_empty(start: Array, counts: Sequence[int]) -> bool:
    """Whether the episode has no step yet."""
    env = int(start["env"])
    return env < len(counts) and int(start["first_row"]) >= counts[env]
