"""New steps, infos and messages of a growing recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from tupli_mcap.arrays import Array
from tupli_mcap.mcap.records import RECORD_HEADER
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.recover.step_runs import StepFacts


class NewSteps(NamedTuple):
    """Consecutive steps of a sub-environment: rows `first`, `first + 1`, … of its channel.

    `rows` are whole records of a constant layout, `messages` the (log_time, CDR message) of another one.
    """

    env: int
    first: int
    rows: Array | None
    messages: list[tuple[int, bytes]]
    facts: StepFacts

    def __len__(self) -> int:
        return len(self.facts.time)

    def newest(self, count: int) -> NewSteps:
        skip = max(0, len(self) - count)
        rows = None if self.rows is None else self.rows[skip:]
        facts = StepFacts._make([*(column[skip:] for column in self.facts[:-1]), self.facts.bad])
        return NewSteps(self.env, self.first + skip, rows, self.messages[skip:], facts)

    def moved(self, rows: int) -> NewSteps:
        """The same steps, so many rows later."""
        return NewSteps(self.env, self.first + rows, self.rows, self.messages, self.facts)

    def cdr(self) -> Iterator[tuple[int, bytes]]:
        """(log_time, CDR message with its header) of each step."""
        if self.rows is None:
            yield from self.messages
            return
        data, size = self.rows.tobytes(), self.rows.dtype.itemsize
        for i, time_ns in enumerate(self.facts.time.tolist()):
            yield time_ns, data[i * size + RECORD_HEADER.size : (i + 1) * size]


class NewInfo(NamedTuple):
    """The recorded infos of the step in row `row` of a sub-environment's channel, as `named_entries` gives
    them; `time_ns` is wall clock."""

    row: int
    time_ns: int
    values: Mapping[str, Any]


def messages_of(store: ChunkStore, channel: int, rows: range) -> list[tuple[int, bytes]]:
    """(log_time, CDR message with its header) of rows."""
    found = []
    for span in store.spans(channel, rows.start, len(rows)):
        data, places = store.records(span.chunk)
        view = memoryview(data)
        for start, end in places[span.begin : span.end].tolist():
            time_ns = RECORD_HEADER.unpack_from(view, start)[4]
            found.append((time_ns, bytes(view[start + RECORD_HEADER.size : end])))
    return found
