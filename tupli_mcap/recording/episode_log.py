"""Starts and ends of episodes on their way to the journal: what every episode does, in as few calls as it takes.

Little of this is in the processor's caches when an episode ends, so that every function on the way costs.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, NamedTuple
from zlib import crc32

from tupli_mcap.messages.layout import BODY, CDR_HEADER
from tupli_mcap.recording.channels import Channels
from tupli_mcap.recording.events import END_FIELDS, START_FIELDS, end_texts, start_texts
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.journal import LogArea
from tupli_mcap.recording.logs import FRONT, EventLog, Sink

__all__ = ["EPISODE_AND_ENV", "EpisodeLog", "ResetFacts", "StartedEpisode"]

_RECORD = BODY - len(CDR_HEADER)  # bytes of a record before its CDR header
_LENGTH = _RECORD - 9  # of which its length counts
EPISODE_AND_ENV = struct.Struct("<II")


class ResetFacts(NamedTuple):
    """What a reset was given and gave; `options` and `info` are JSON texts."""

    seed: int | None
    drawn_seed: int | None
    options: str
    info: str
    time_ns: int
    continued: bool = False

    @property
    def goes_on(self) -> bool:
        """True if the reset had no seed, so that it went on with the random stream of what came before it."""
        return self.seed is None and self.drawn_seed is None and not self.continued


class StartedEpisode(NamedTuple):
    """An episode whose start is in the journal."""

    number: int
    env: int
    first_row: int
    start_time: int
    seed: int | None
    start_row: int


# makes a StartedEpisode of its fields without a call of Python
_new: Callable[[type[StartedEpisode], tuple[Any, ...]], StartedEpisode] = tuple.__new__


class EpisodeLog(EventLog):
    """The log of `/episode_start`, `/final_state` and `/episode_end`; `index` is told of every end."""

    def __init__(
        self,
        area: LogArea,
        buffer: memoryview,
        sink: Sink,
        channels: Channels,
        counts: dict[int, int],
        index: IndexBuilder,
        time_ns: int,
    ) -> None:
        self._start, self._final, self._end = ids = channels.start, channels.final_state, channels.end
        self._index = index
        super().__init__(area, buffer, sink, {channel: counts[channel] for channel in ids}, time_ns)

    def start(self, number: int, env: int, first_row: int, reset: ResetFacts) -> StartedEpisode:
        """Adds an `/episode_start`."""
        given, drawn, options, info, time_ns, continued = reset
        seed = drawn if given is None else given
        texts = start_texts("" if seed is None else str(seed), options, info)
        tail = CDR_HEADER + START_FIELDS.pack(number, env, first_row, given is not None, continued) + texts
        channel, sequences, position = self._start, self.sequences, self._position
        row, end = sequences[channel], position + _RECORD + len(tail)
        if end > self._capacity:
            self.append(time_ns, (channel, tail[len(CDR_HEADER) :]))
        else:
            if time_ns > self.latest_ns:
                self.latest_ns = time_ns
            front = FRONT.pack(5, _LENGTH + len(tail), channel, row, self.latest_ns)
            record = front + crc32(tail, crc32(front)).to_bytes(8, "little") + tail
            sequences[channel] = row + 1
            self._whole[channel].append(record)
            self._records[position:end] = record
            self._last, self._last_channel, self._can_drop = position, channel, True
            self._position = self._commit[0] = end
        return _new(StartedEpisode, (number, env, first_row, self.latest_ns, seed, row))

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
        has_final = state is not None or final_row >= 0
        end_tail = CDR_HEADER + END_FIELDS.pack(number, env, first_row, length, total, end, has_final)
        end_tail += end_texts(metadata)
        final, last, sequences, position = self._final, self._end, self.sequences, self._position
        end_row = sequences[last]
        if state is None:
            now = self.append(now, (last, end_tail[len(CDR_HEADER) :]))
        else:
            final_row = sequences[final]
            final_tail = CDR_HEADER + EPISODE_AND_ENV.pack(number, env) + state
            stop = position + 2 * _RECORD + len(final_tail) + len(end_tail)
            if stop > self._capacity:
                header = len(CDR_HEADER)
                now = self.append(now, (final, final_tail[header:]), (last, end_tail[header:]))
            else:
                if now > self.latest_ns:
                    self.latest_ns = now
                else:
                    now = self.latest_ns
                front = FRONT.pack(5, _LENGTH + len(final_tail), final, final_row, now)
                final_record = front + crc32(final_tail, crc32(front)).to_bytes(8, "little") + final_tail
                front = FRONT.pack(5, _LENGTH + len(end_tail), last, end_row, now)
                end_record = front + crc32(end_tail, crc32(front)).to_bytes(8, "little") + end_tail
                sequences[final], sequences[last] = final_row + 1, end_row + 1
                self._whole[final].append(final_record)
                self._whole[last].append(end_record)
                self._records[position:stop] = final_record + end_record
                self._can_drop = False
                self._position = self._commit[0] = stop
        self._index.add(
            first_row, length, total, start_time, now, seed, start_row, end_row, final_row, number, env, end,
            metadata,
        )  # fmt: skip
