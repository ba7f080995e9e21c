"""Derives episode records from committed rows when they go to the file, many at a time.

A plain episode (reset without seed, options and info; ended by a flag) writes only rows while it is recorded: they hold
its number and flags, and the hole after its last row holds the final state and the time of the next reset. Its records
in `/episode_start`, `/episode_end` and `/final_state` are derived from these.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.journal.logs import STATE
from tupli_mcap.mcap.records import HOLE
from tupli_mcap.messages.episodes import TERMINAL, TIMEOUT

LAST_ROW = HOLE - 1  # of a channel: `sequence` has 32 bits

STARTS = np.dtype([("episode", "<u4"), ("env", "<u4"), ("first_row", "<u8"), ("time", "<u8")])
ENDS = np.dtype(
    [
        ("episode", "<u4"), ("env", "<u4"), ("first_row", "<u8"), ("length", "<u8"), ("return", "<f8"),
        ("end", "u1"), ("time", "<u8"),
    ]
)  # fmt: skip


class StartedEpisode(NamedTuple):
    """An episode whose start is written; or derived later, if `start_row` is -1."""

    number: int
    env: int
    first_row: int
    start_time: int
    seed: int | None
    start_row: int


class EpisodeBatch(NamedTuple):
    """Derived records in the order of time: `starts` (STARTS), `ends` (ENDS), and the final state of each end.

    `states` is uint8 (ends, bytes): what follows `episode` and `env` in `/final_state`. None: no final state is known.
    """

    starts: Array
    ends: Array
    states: Array | None


class EpisodeDeriver:
    """Derives the episodes of `num_envs` sub-environments from their rows, batch after batch.

    Attributes:
        running: numbers of the running episodes, -1 if there is none: int64 (num_envs,).
        totals: their returns so far: float64 (num_envs,).
    """

    def __init__(self, num_envs: int, state_end: int) -> None:
        self._n = num_envs
        self._state = slice(STATE, state_end)
        self._began = np.zeros(num_envs, np.uint64)  # time of the last reset
        self._begun: dict[int, tuple[int, int]] = {}  # what `begin` said since the last batch
        self.running = np.full(num_envs, -1)
        self._first_rows, self._lengths = np.zeros((2, num_envs), np.int64)
        self.totals = np.zeros(num_envs)
        # ends whose final state comes with the next batch, by sub-environment
        self._waiting: Array = np.zeros(num_envs, ENDS)
        self._waits = np.zeros(num_envs, np.bool_)

    def begin(self, env: int, number: int, first_row: int) -> None:
        """Says that the next row is the first one of an episode whose start is written; of none, if `number` is -1."""
        self._begun[env] = number, first_row

    def derive(self, rows: Array, pending: Mapping[int, bytes] | None) -> EpisodeBatch:
        """Derives the starts, ends and final states of new rows.

        Args:
            rows: (num_envs, rows), in their order, with holes.
            pending: by sub-environment, the final state of an episode that the last one of `rows` ended.
        """
        for env, (number, first_row) in self._begun.items():
            self.running[env], self._first_rows[env] = number, first_row
            self._lengths[env], self.totals[env], self._waits[env] = 0, 0.0, False
        self._begun.clear()
        found = _Segments(rows["#sequence"], rows["terminal"] | rows["timeout"])
        going_on = found.is_first & (self.running[found.env] >= 0)
        rewards = np.where(found.hole, 0.0, rows["reward"]).reshape(-1)
        lengths, first_rows = found.lengths, rows["#sequence"][found.env, found.begin].astype(np.int64)
        env = found.env[going_on]
        with np.errstate(over="ignore", invalid="ignore"):  # of infinite rewards
            rewards[found.first[going_on]] += self.totals[env]
        totals = sums(rewards, found.first)
        lengths[going_on] += self._lengths[env]
        first_rows[going_on] = self._first_rows[env]
        starts = np.zeros(len(found.env), STARTS)
        starts["episode"] = numbers = rows["episode"][found.env, found.begin]
        starts["env"], starts["first_row"] = found.env, first_rows
        starts["time"] = self._reset_times(rows, found)
        ends = np.zeros(len(found.env), ENDS)
        for name in ("episode", "env", "first_row"):
            ends[name] = starts[name]
        ends["length"], ends["return"] = lengths, totals
        ends["end"] = np.where(rows["terminal"][found.env, found.last], TERMINAL, TIMEOUT)
        ends["time"] = rows["#log_time"][found.env, found.last]
        final = found.is_final
        self.running[found.env[final]] = np.where(found.ended, -1, numbers.astype(np.int64))[final]
        self._first_rows[found.env[final]] = first_rows[final]
        self._lengths[found.env[final]] = lengths[final]
        self.totals[found.env[final]] = totals[final]
        return self._batch(rows, starts[~going_on], ends[found.ended], found.last[found.ended], pending or {})

    def _reset_times(self, rows: Array, found: _Segments) -> Array:
        """The time of the hole before each segment."""
        times, at_once = rows["#log_time"], found.begin == 0
        before: Array = times[found.env, found.begin - 1]
        before[at_once] = self._began[found.env[at_once]]
        if found.hole.size:
            is_hole = found.hole[:, -1]
            self._began[is_hole] = times[is_hole, -1]
        return before

    def _batch(
        self, rows: Array, starts: Array, ends: Array, last: Array, pending: Mapping[int, bytes]
    ) -> EpisodeBatch:
        width, size = rows.shape[1], self._state.stop - self._state.start
        data = rows[..., None].view(np.uint8)[..., self._state]
        before = np.flatnonzero(self._waits)
        if not width:
            before = before[[env in pending for env in before.tolist()]]
        column = last + 1
        if len(before):
            ends = np.concatenate([self._waiting[before], ends])
            column = np.concatenate([np.zeros(len(before), np.int64), column])
            self._waits[before] = False
        inside = column < width
        if inside.all():
            states = data[ends["env"], column]
        else:
            states = np.zeros((len(ends), size), np.uint8)
            states[inside] = data[ends["env"][inside], column[inside]]
            for i in np.flatnonzero(~inside).tolist():
                env = int(ends["env"][i])
                if env in pending:
                    states[i] = np.frombuffer(pending[env], np.uint8)
                    inside[i] = True
                else:
                    self._waiting[env], self._waits[env] = ends[i], True
            ends, states = ends[inside], states[inside]
        if self._n == 1:  # the order of the rows, even if the clock was set back
            return EpisodeBatch(starts, ends, states)
        order = np.argsort(ends["time"], kind="stable")
        return EpisodeBatch(starts[np.argsort(starts["episode"], kind="stable")], ends[order], states[order])


class _Segments:
    """The runs of rows of one episode in (num_envs, rows): between holes, flags, and the ends of each line.

    Attributes:
        hole: which rows are holes, bool (num_envs, rows).
        env, begin, last, lengths: each run's sub-environment, the columns of its first and last row, its rows.
        first: index of each run's first row in the flattened rows.
        ended: whether its last row has a flag set.
        is_first, is_final: whether it is the first, the last run of its sub-environment.
    """

    def __init__(self, sequences: Array, flags: Array) -> None:
        self.hole = hole = sequences == HOLE
        begins = ~hole
        stops = begins.copy()
        begins[:, 1:] &= hole[:, :-1] | flags[:, :-1]
        stops[:, :-1] &= hole[:, 1:] | flags[:, :-1]
        self.first, width = np.flatnonzero(begins), max(1, hole.shape[1])
        self.env = self.first // width
        self.begin = self.first - self.env * width
        self.last = np.flatnonzero(stops) - self.env * width
        self.lengths = self.last - self.begin + 1
        self.ended = flags[self.env, self.last]
        self.is_first = np.ones(len(self.env), np.bool_)
        self.is_final = self.is_first.copy()
        self.is_first[1:] = self.is_final[:-1] = self.env[1:] != self.env[:-1]


def sums(values: Array, firsts: Array) -> Array:
    """The sum of each part of `values`; `firsts` are where parts begin. Bit for bit that of adding in order."""
    if not len(firsts):
        return np.zeros(0)
    with np.errstate(over="ignore", invalid="ignore"):  # of infinite values
        if (values == np.rint(values)).all() and np.abs(values).sum() < 2**53:
            return np.add.reduceat(values, firsts) + 0.0  # exact in any order; -0.0 becomes 0.0
        return np.array([np.add.accumulate(part)[-1] for part in np.split(values, firsts)[1:]]) + 0.0
