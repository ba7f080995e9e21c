"""What a journal still holds: committed rows and records beyond those in the file, and the running states."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.file import JournalContents, LogArea, RowArea
from tupli_mcap.journal.rows import RowDeriver, even_rows
from tupli_mcap.journal.seals import SECTOR, STATE, checksum, seal_of
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, RECORD_HEADER, iter_records
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.encode_rows import HOLE
from tupli_mcap.messages.step import StepLayout

__all__ = [
    "FinalHole",
    "Salvage",
    "committed_rows",
    "image_rows",
    "log_records",
    "running_record",
    "size_behind",
    "to_rows",
]

SEQUENCE_END = 15  # of `sequence` in a Message record
EPISODE_END = BODY + 4  # of `episode` in a step's


class FinalHole(NamedTuple):
    """The place after an episode's last step: what it ended with, the time (ns) of the next reset, the row after."""

    episode: int
    state: bytes
    time_ns: int
    row: int


class Salvage:
    """The rows of one RowArea's channel block, in both halves.

    Of a journal that may be torn, only rows count that prove to be whole: by their checksums, or by lying in
    sectors that were written after them; the latter shows nothing where committed rows may be `rewritten`. `left_out`
    counts the others that `after` met.
    """

    def __init__(
        self,
        contents: JournalContents,
        area: RowArea,
        block: int,
        dtype: np.dtype[Any],
        channel: int,
        *,
        rewritten: bool = False,
    ) -> None:
        shape = (2, area.channels, area.rows + 1, area.row_size)
        if area.row_size != dtype.itemsize or contents.data[area.name].size != np.prod(shape):
            raise FormatError(
                f"the journal's area {area.name!r} has rows of {area.row_size} bytes, not {dtype.itemsize}"
            )
        if block >= area.channels:
            raise FormatError(
                f"the journal's area {area.name!r} has rows of {area.channels} channels, none of number {block}"
            )
        self._bytes = np.ascontiguousarray(contents.data[area.name].reshape(shape)[:, block])
        self._area = area
        self._block = block
        self.rows: Array = self._bytes.view(dtype)[..., 0]
        committed = (
            (self.rows["#opcode"] == 5) & (self.rows["#channel"] == channel) & (self.rows["#log_time"] != 0)
        )
        committed &= self.rows["#sequence"] != HOLE
        committed[:, area.rows] = False  # the spare row is never committed
        halves, places = np.nonzero(committed)
        order = np.argsort(self.rows["#sequence"][halves, places], kind="stable")
        self._halves, self._places = halves[order], places[order]
        self._sequences = self.rows["#sequence"][self._halves, self._places].astype(np.int64)
        self._torn, self._sealed = contents.torn, contents.sealed_rows
        self._rewritten = rewritten
        self.left_out = 0

    def after(self, first: int) -> Array:
        """A copy of the rows with sequence `first`, `first + 1`, … until one is missing."""
        start = int(np.searchsorted(self._sequences, first))
        run = self._sequences[start:]
        good = int(np.argmin(np.append(run == first + np.arange(len(run)), False)))
        if self._torn:
            whole = next((i for i in range(good) if not self._is_whole(start + i)), good)
            self.left_out, good = good - whole, whole
        chosen = slice(start, start + good)
        return self.rows[self._halves[chosen], self._places[chosen]].copy()

    def runs(self, wanted_of: Callable[[Array], Array]) -> list[Array]:
        """Copies of committed rows, in runs of consecutive ones: those whose sequences `wanted_of` says (as a mask)."""
        wanted = np.flatnonzero(wanted_of(self._sequences))
        sequences, places = np.unique(self._sequences[wanted], return_index=True)
        chosen = wanted[places]
        if self._torn:
            whole = np.array([self._is_whole(int(i)) for i in chosen], dtype=np.bool_)
            chosen, sequences = chosen[whole], sequences[whole]
        edges = np.flatnonzero(np.diff(sequences) != 1) + 1
        return [
            self.rows[self._halves[part], self._places[part]].copy()
            for part in np.split(chosen, edges)
            if len(part)
        ]

    @property
    def end(self) -> int:
        """The sequence after the last committed one here; 0 if there is none."""
        return int(self._sequences[-1]) + 1 if len(self._sequences) else 0

    def row(self, sequence: int) -> Array | None:
        """The committed row with `sequence`; None if it is not here."""
        found = self._find(sequence)
        if found is None or (self._torn and not self._is_whole(found)):
            return None
        row: Array = self.rows[self._halves[found], self._places[found]]
        return row

    def following(self, sequence: int, state_end: int) -> bytes | None:
        """The state in the row that was running when the one with `sequence` was committed; None if it is not here."""
        found = self._find(sequence)
        if found is None:
            return None
        half, place = self._halves[found], self._places[found]
        state = self._bytes[half, place + 1, STATE:state_end].tobytes()
        if self._torn:
            sealed = int(self.rows["#publish_time"][half, place]) >> 32
            if not self._sealed or zlib.crc32(state) != sealed:
                return None
        return state

    def finals(self, state_end: int) -> list[FinalHole]:
        """What follows the last steps of episodes, of all committed rows here; nothing of a torn journal."""
        rows = self.rows
        flags = (rows[name][self._halves, self._places].view(np.uint8) for name in ("terminal", "timeout"))
        ended = np.logical_or(*flags)
        if self._torn or not ended.any():
            return []
        halves, places = self._halves[ended], self._places[ended]
        last = rows[halves, places]
        beyond = places + 1 == self._area.rows  # the spare row, which is the other half's first one
        halves, places = np.where(beyond, 1 - halves, halves), np.where(beyond, 0, places + 1)
        after = rows[halves, places]
        valid = (after["#sequence"] == HOLE) & (after["episode"] == last["episode"])
        valid &= after["#log_time"] >= last["#log_time"]
        states = self._bytes[halves[valid], places[valid], STATE:state_end]
        found = zip(
            last["episode"][valid].tolist(),
            states,
            after["#log_time"][valid].tolist(),
            (last["#sequence"][valid].astype(np.int64) + 1).tolist(),
            strict=True,
        )
        return [FinalHole(episode, state.tobytes(), time_ns, row) for episode, state, time_ns, row in found]

    def _find(self, sequence: int) -> int | None:
        found = int(np.searchsorted(self._sequences, sequence))
        if found == len(self._sequences) or self._sequences[found] != sequence:
            return None
        return found

    def _is_whole(self, i: int) -> bool:
        """Whether the i-th committed row was on the disk as it had been committed."""
        half, place, size = int(self._halves[i]), int(self._places[i]), self._area.row_size
        if self._sealed:
            return (
                checksum(self._bytes[half, place].tobytes())
                == int(self.rows["#publish_time"][half, place]) & 0xFFFFFFFF
            )
        if self._rewritten:
            return False
        start = half * self._area.half + self._block * self._area.block + place * size
        if start // SECTOR == (start + size - 1) // SECTOR:
            return True
        # A row of less than a sector lies in two at most. The second one also holds the commitment of the next row,
        # which came later: where that is on the disk, so is the end of this row.
        follows = i + 1 < len(self._sequences) and self._sequences[i + 1] == self._sequences[i] + 1
        beside = follows and (int(self._halves[i + 1]), int(self._places[i + 1])) == (half, place + 1)
        if beside:
            return size <= SECTOR - SEQUENCE_END
        return size <= SECTOR - EPISODE_END and place + 1 < self._area.rows and self._has_hole(half, place)

    def _has_hole(self, half: int, place: int) -> bool:
        """Whether a final hole that is later than a row is the next one of its block."""
        row, hole = self.rows[half, place], self.rows[half, place + 1]
        later = hole["#sequence"] == HOLE and hole["#log_time"] > row["#log_time"]
        return bool(later and hole["episode"] == row["episode"] and (row["terminal"] or row["timeout"]))


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
    rows["#publish_time"] = rows["#log_time"]
    return even_rows(channel, first, rows.view(np.uint8).tobytes(), rows) if len(rows) else None


def log_records(
    contents: JournalContents, area: LogArea, counts: dict[int, int] | None
) -> list[tuple[int, int, int, bytes]]:
    """(channel, sequence, log_time, record) of the committed records that are not in the file, in order.

    `counts` are the rows of each channel that are in the file; None: all committed records, each once.
    A record whose checksum differs ends its half.
    """
    found: list[tuple[int, int, int, bytes]] = []
    for half in range(area.halves):
        data = _half(contents, area, half)
        for start, end, channel, sequence, log_time in _whole_records(contents, data):
            time = log_time.to_bytes(8, "little")
            found.append(
                (
                    channel,
                    sequence,
                    log_time,
                    b"".join((data[start : start + 23], time, data[start + 31 : end])),
                )
            )
    found.sort(key=lambda entry: (entry[0], entry[1]))
    if counts is None:
        return list({entry[:2]: entry for entry in found}.values())
    expected, kept = dict(counts), []
    for entry in found:
        if entry[1] == expected.get(entry[0], 0):
            expected[entry[0]] = entry[1] + 1
            kept.append(entry)
    return kept


def _whole_records(contents: JournalContents, data: memoryview) -> Iterator[tuple[int, int, int, int, int]]:
    try:
        for start, end, channel, sequence, log_time in iter_records(data):
            if contents.sealed_records and checksum(data[start:end]) != seal_of(data, start)[0]:
                return
            yield start, end, channel, sequence, log_time
    except FormatError:  # torn
        return


def size_behind(contents: JournalContents, area: LogArea) -> int:
    """Bytes the file had when it took up what a log of one half held before; 0 where the journal does not say."""
    return int(contents.data[area.name][8:16].view("<u8")[0])


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
            state = bytes(body[8 : MessageDecoder(layout).state(body)])
        except FormatError:
            continue
        if not contents.torn or _running_seal(contents, area, sequence) == zlib.crc32(state):
            return state
    return None


def _running_seal(contents: JournalContents, area: LogArea, sequence: int) -> int | None:
    """The checksum of the state of the running record, which will have `sequence`, from the record before it."""
    for half in range(area.halves):
        data = _half(contents, area, half)
        for start, _, _, found, _ in _whole_records(contents, data):
            if found == sequence - 1:
                return seal_of(data, start)[1]
    return None
