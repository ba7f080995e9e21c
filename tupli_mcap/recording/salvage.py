"""What a journal still holds: committed rows and records beyond those in the file, and the running states."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY, RECORD_HEADER
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.container import Rows
from tupli_mcap.recording.journal import JournalContents, LogArea, RowArea
from tupli_mcap.recording.logs import iter_records
from tupli_mcap.recording.rows import RowDeriver, even_rows
from tupli_mcap.recording.vector_rows import HOLE

__all__ = ["Salvage", "committed_rows", "image_rows", "log_records", "running_record", "to_rows"]

Array = np.ndarray[Any, Any]


class Salvage:
    """The rows of one RowArea's channel block, in both halves."""

    def __init__(
        self, contents: JournalContents, area: RowArea, block: int, dtype: np.dtype[Any], channel: int
    ) -> None:
        shape = (2, area.channels, area.rows + 1, area.row_size)
        if area.row_size != dtype.itemsize or contents.data[area.name].size != np.prod(shape):
            raise FormatError(
                f"the journal's area {area.name!r} has rows of {area.row_size} bytes, not {dtype.itemsize}"
            )
        self._bytes = contents.data[area.name].reshape(shape)[:, block]
        self.rows: Array = np.ascontiguousarray(self._bytes).view(dtype)[..., 0]
        committed = (
            (self.rows["#opcode"] == 5) & (self.rows["#channel"] == channel) & (self.rows["#log_time"] != 0)
        )
        committed &= self.rows["#sequence"] != HOLE
        committed[:, area.rows] = False  # the spare row is never committed
        self._halves, self._places = np.nonzero(committed)
        self._sequences = self.rows["#sequence"][self._halves, self._places].astype(np.int64)
        self._limit = area.rows

    def after(self, first: int) -> Array:
        """A copy of the rows with sequence `first`, `first + 1`, … until one is missing."""
        order = np.argsort(self._sequences, kind="stable")
        sequences = self._sequences[order]
        start = int(np.searchsorted(sequences, first))
        run = sequences[start:]
        good = int(np.argmin(np.append(run == first + np.arange(len(run)), False)))
        chosen = order[start : start + good]
        return self.rows[self._halves[chosen], self._places[chosen]].copy()

    def runs(self, first: int, stop: int) -> list[Array]:
        """Copies of the committed rows with `first` <= sequence < `stop`, in runs of consecutive ones."""
        wanted = np.flatnonzero((self._sequences >= first) & (self._sequences < stop))
        sequences, places = np.unique(self._sequences[wanted], return_index=True)
        chosen = wanted[places]
        edges = np.flatnonzero(np.diff(sequences) != 1) + 1
        return [
            self.rows[self._halves[part], self._places[part]].copy()
            for part in np.split(chosen, edges)
            if len(part)
        ]

    def following(self, sequence: int) -> Array | None:
        """The row that was running when the one with `sequence` was committed; None if that one is not here."""
        found = np.flatnonzero(self._sequences == sequence)
        if not len(found):
            return None
        half, place = int(self._halves[found[0]]), int(self._places[found[0]])
        row: Array = self.rows[half, place + 1]
        return row


def committed_rows(
    salvage: Salvage, first: int, channel: int, last: Array | None
) -> tuple[Rows | None, Array]:
    """Completed rows from sequence `first` on; `last` is the row before them in the file."""
    rows = salvage.after(first)
    if not len(rows):
        return None, rows
    deriver = RowDeriver()
    if last is not None:
        deriver = RowDeriver(int(last["episode"]), int(last["step"]), int(last["#log_time"]))
    deriver.fill(rows)
    return even_rows(channel, first, rows.view(np.uint8).tobytes(), rows), rows


def image_rows(salvage: Salvage, first: int, steps: int, channel: int) -> Rows | None:
    """Images of committed steps: rows from `first` up to `steps`."""
    rows = salvage.after(first)[: max(0, steps - first)]
    return even_rows(channel, first, rows.view(np.uint8).tobytes(), rows) if len(rows) else None


def log_records(
    contents: JournalContents, area: LogArea, counts: dict[int, int] | None
) -> list[tuple[int, int, int, bytes]]:
    """(channel, sequence, log_time, record) of the committed records that are not in the file, in order.

    `counts` are the rows of each channel that are in the file; None: all committed records, each once.
    """
    found: list[tuple[int, int, int, bytes]] = []
    for half in range(area.halves):
        data = _half(contents, area, half)
        for start, end, channel, sequence, log_time in iter_records(data):
            found.append((channel, sequence, log_time, bytes(data[start:end])))
    found.sort(key=lambda entry: (entry[0], entry[1]))
    if counts is None:
        return list({entry[:2]: entry for entry in found}.values())
    expected, kept = dict(counts), []
    for entry in found:
        if entry[1] == expected.get(entry[0], 0):
            expected[entry[0]] = entry[1] + 1
            kept.append(entry)
    return kept


def _half(contents: JournalContents, area: LogArea, half: int) -> memoryview:
    raw = contents.data[area.name]
    start = half * area.half
    end = int(raw[start : start + 8].view("<u8")[0])
    if end > area.capacity:
        raise FormatError(f"the journal's area {area.name!r} claims {end} bytes of {area.capacity}")
    return memoryview(raw.data)[start + 64 : start + 64 + end]


def to_rows(entries: Sequence[tuple[int, int, int, bytes]]) -> list[Rows]:
    """Entries of `log_records` as rows by channel."""
    groups: dict[int, list[tuple[int, int, int, bytes]]] = {}
    for entry in entries:
        groups.setdefault(entry[0], []).append(entry)
    rows = []
    for channel, group in groups.items():
        sizes = np.array([len(entry[3]) for entry in group])
        offsets = (np.cumsum(sizes) - sizes).astype(np.uint64)
        times = np.array([entry[2] for entry in group], dtype=np.uint64)
        rows.append(Rows(channel, group[0][1], b"".join(entry[3] for entry in group), offsets, times))
    return rows


def running_record(
    contents: JournalContents, area: LogArea, sequence: int, layout: StepLayout
) -> bytes | None:
    """The state (CDR bytes after `episode` and `env`) of the running record, which will have `sequence`; None if it is
    not here."""
    for half in range(area.halves):
        start = half * area.half + 64 + len(_half(contents, area, half))
        raw = memoryview(contents.data[area.name].data)[start : (half + 1) * area.half]
        if len(raw) < BODY:
            continue
        opcode, _, _, found, _, _ = RECORD_HEADER.unpack_from(raw)
        if (opcode, found) != (5, sequence):
            continue
        try:
            body = raw[BODY:]
            return bytes(body[8 : MessageDecoder(layout).state(body)])
        except FormatError:
            continue
    return None
