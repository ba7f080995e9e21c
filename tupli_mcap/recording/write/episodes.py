"""Puts the starts and ends of episodes into the journal."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import StepError
from tupli_mcap.journal.derive import EpisodeBatch, StartedEpisode
from tupli_mcap.journal.file import Journal
from tupli_mcap.journal.logs import EventLog, ToFile, sealed_records
from tupli_mcap.mcap.records import BODY, HEADER_FIELDS
from tupli_mcap.messages.episodes import (
    END_FIELDS,
    START_FIELDS,
    EpisodeEnd,
    EpisodeStart,
    end_texts,
    record,
    start_texts,
)
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.recording.index import EPISODE_ROWS, IndexBuilder, indexed_seed
from tupli_mcap.spaces.exact import shorten

if TYPE_CHECKING:
    from tupli_mcap.recording.channels import Channels

_Fields = tuple[tuple[str, str, int], ...]
# the fields that differ between messages of plain episodes: name, format, offset in the CDR body
_BOTH: _Fields = (("episode", "<u4", 0), ("env", "<u4", 4))
_START: _Fields = (*_BOTH, ("first_row", "<u8", 8))
_END: _Fields = (*_START, ("length", "<u8", 16), ("return", "<f8", 24), ("end", "u1", 32))
_START_BODY = EpisodeStart(0, 0, 0, False, False, "", "", "{}").encode()
_END_BODY = {known: EpisodeEnd(0, 0, 0, 0, 0.0, 0, known, "{}").encode() for known in (False, True)}


class ResetFacts(NamedTuple):
    """The arguments and results of a reset; `options` and `info` are JSON texts."""

    seed: int | None
    drawn_seed: int | None
    options: str
    info: str
    time_ns: int
    continued: bool = False

    @property
    def goes_on(self) -> bool:
        """True if the reset had no seed, so that the environment's random stream went on."""
        return self.seed is None and self.drawn_seed is None and not self.continued


def plain_reset(time_ns: int, *, continued: bool = False) -> ResetFacts:
    """A reset without arguments and info; or none, if the episode is `continued`."""
    return ResetFacts(None, None, "", "{}", time_ns, continued)


def seed_number(seed: Any) -> int | None:
    """The seed of a reset as an integer. StepError if it is none."""
    try:
        return None if seed is None else operator.index(seed)
    except TypeError as err:
        raise StepError(f"seed: expected an integer or None, found {shorten(seed)}") from err


# makes a StartedEpisode of its fields
_new: Callable[[type[StartedEpisode], tuple[Any, ...]], StartedEpisode] = tuple.__new__


class EpisodeLog(EventLog):
    """The log of `/episode_start`, `/final_state` and `/episode_end`; every end is added to `index`."""

    def __init__(self, journal: Journal, channels: Channels, index: IndexBuilder, file: ToFile) -> None:
        self._start, self._final, self._end = ids = channels.start, channels.final_state, channels.end
        self._index = index
        self.running: dict[int, StartedEpisode] = {}  # started and not ended, by number
        super().__init__(journal, "events", ids, file)

    def start(self, number: int, env: int, first_row: int, reset: ResetFacts) -> StartedEpisode:
        """Adds an `/episode_start`."""
        given, drawn, options, info, time_ns, continued = reset
        seed = drawn if given is None else given
        body = START_FIELDS.pack(number, env, first_row, given is not None, continued)
        body += start_texts("" if seed is None else str(seed), options, info)
        row = self.sequences[self._start]
        time_ns = self.append(time_ns, (self._start, body))
        self.running[number] = started = _new(StartedEpisode, (number, env, first_row, time_ns, seed, row))
        return started

    def end(
        self,
        now: int,
        episode: StartedEpisode,
        end: int,
        length: int,
        total: float,
        state: bytes | None,
        final_row: int,
        metadata: str,
    ) -> None:
        """Adds `/final_state`, with the CDR bytes of `state`, and `/episode_end`.

        Without a state `/episode_end` alone: the final state is row `final_row` of its channel, or not known (-1).
        """
        number, env, first_row, start_time, seed, start_row = episode
        self.running.pop(number, None)
        has_final = state is not None or final_row >= 0
        body = END_FIELDS.pack(number, env, first_row, length, total, end, has_final) + end_texts(metadata)
        end_row = self.sequences[self._end]
        if state is None:
            now = self.append(now, (self._end, body))
        else:
            final_row = self.sequences[self._final]
            final = NUMBERS.pack(number, env) + state
            now = self.append(now, (self._final, final), (self._end, body))
        row = first_row, length, total, start_time, now, seed, start_row, end_row, final_row, number, env, end
        self._index.add(row, metadata)

    def extend(self, batch: EpisodeBatch) -> None:
        """Adds `/episode_start`, `/final_state` and `/episode_end` of derived episodes."""
        if not len(batch.starts) and not len(batch.ends):
            return
        begun, final, ended = self._tables(batch)
        final_rows = final["#sequence"] if len(final) else np.full(len(ended), -1)
        self.latest_ns = max(self.latest_ns, *(int(t["#log_time"][-1]) for t in (begun, ended) if len(t)))
        self._add_to_index(begun, ended, final_rows)
        self._add({self._start: begun, self._final: final, self._end: ended})

    def _tables(self, batch: EpisodeBatch) -> tuple[Array, Array, Array]:
        """Records of starts, final states and ends."""
        starts, ends, states = batch
        begun = self._table(self._start, _START_BODY, _START, starts)
        ended = self._table(self._end, _END_BODY[states is not None], _END, ends)
        if states is None:
            return begun, self._table(self._final, bytes(8), _BOTH, ends[:0]), ended
        size = states.shape[1]
        final = self._table(self._final, bytes(8 + size), (*_BOTH, ("state", f"V{size}", 8)), ends)
        final["state"] = np.ascontiguousarray(states).view(f"V{size}")[:, 0]
        return begun, final, ended

    def _table(self, channel: int, body: bytes, fields: _Fields, rows: Array) -> Array:
        """Records of one channel: `body` with the fields that `rows` have, in their order and at their times."""
        template, dtype = _record_of(channel, body, fields)
        table: Array = np.frombuffer(bytearray(template * len(rows)), dtype)
        for name, _, _ in fields:
            if name != "state":
                table[name] = rows[name]
        first = self.sequences[channel]
        table["#sequence"] = np.arange(first, first + len(rows))
        table["#log_time"] = np.maximum.accumulate(np.maximum(rows["time"], np.uint64(self.latest_ns)))
        return table

    def _add_to_index(self, begun: Array, ended: Array, final_rows: Array) -> None:
        rows = np.zeros(len(ended), EPISODE_ROWS)
        for name in ("first_row", "length", "return", "episode", "env", "end"):
            rows[name] = ended[name]
        rows["end_time"], rows["end_row"] = ended["#log_time"], ended["#sequence"]
        rows["final_row"] = final_rows
        at = np.searchsorted(begun["episode"], ended["episode"])
        here = np.append(begun["episode"], -1)[at] == ended["episode"]
        rows["start_time"][here] = begun["#log_time"][at[here]]
        rows["start_row"][here] = begun["#sequence"][at[here]]
        for i in np.flatnonzero(~here).tolist():
            _, _, _, time_ns, seed, start_row = self.running.pop(int(ended["episode"][i]))
            rows["start_time"][i], rows["start_row"][i] = time_ns, start_row
            rows["seed"][i], rows["has_seed"][i] = indexed_seed(seed)
        self._index.extend(rows)
        goes_on = np.ones(len(begun), np.bool_)
        goes_on[at[here]] = False
        names = ["episode", "env", "first_row", "#log_time", "#sequence"]
        for number, env, first_row, time_ns, start_row in begun[goes_on][names].tolist():
            self.running[number] = _new(StartedEpisode, (number, env, first_row, time_ns, None, start_row))

    def _add(self, tables: dict[int, Array]) -> None:
        """Adds whole records by channel, all or none of them after a crash."""
        size = sum(table.nbytes for table in tables.values())
        if self._position + size > self._capacity:
            self.flush()
        for channel, table in tables.items():
            if len(table):
                self._whole[channel] += table.view(f"V{table.dtype.itemsize}").tolist()
                self.sequences[channel] += len(table)
        self._can_drop = False
        if size > self._capacity:
            self._write()
            return
        sealed = b"".join(sealed_records(table) for table in tables.values())
        end = self._position + size
        self._records[self._position : end] = sealed
        self._position = self._commit[0] = end


@functools.lru_cache(maxsize=64)
def _record_of(channel: int, body: bytes, fields: _Fields) -> tuple[bytes, np.dtype[Any]]:
    """A record of a channel, and its dtype: that of its header, and of some fields of its body."""
    places = [*HEADER_FIELDS, *((name, kind, BODY + offset) for name, kind, offset in fields)]
    names, formats, offsets = zip(*places, strict=True)
    template = record(channel, 0, 0, body)
    return template, np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": len(template)}
    )
