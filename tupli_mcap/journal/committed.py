"""Reads a journal: its committed rows, which it completes for chunks, its records, and the running states."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.file import LOG_HEADER, JournalContents, LogArea, RowArea
from tupli_mcap.journal.logs import STATE, checksum, joined_rows, seal_of
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, HOLE, RECORD_HEADER, iter_records
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.step import StepLayout

Taken = TypeVar("Taken")
Taken_co = TypeVar("Taken_co", covariant=True)
SECTOR = 512  # bytes a disk writes as one
SEQUENCE_END = 15  # offset after `sequence` in a Message record
EPISODE_END = BODY + 4  # offset after `episode` in a step's record


class FinalHole(NamedTuple):
    """The hole after an episode's last step: final state, time (ns) of the next reset, number of the row after it."""

    episode: int
    state: bytes
    time_ns: int
    row: int


class Committed(Protocol[Taken_co]):
    """The committed rows of one channel in a journal.

    Attributes:
        numbers: of the rows, int64, ascending, each once.
        whole: which of them count, bool. In a torn journal these are the rows that are known to be whole, else all.
    """

    numbers: Array
    whole: Array

    def take(self, places: Array) -> Taken_co:
        """Copies of consecutive rows, given by their places in `numbers`."""
        ...

    @property
    def end(self) -> int:
        """The number after that of the last committed row; 0 if there is none."""
        return int(self.numbers[-1]) + 1 if len(self.numbers) else 0


def rows_of(committed: Committed[Taken], in_file: int, stop: int | None = None) -> Taken | None:
    """Applies the reader's rule to a channel that has `in_file` rows in the file.

    Returns rows `in_file`, `in_file + 1`, … up to the first that is missing, or to `stop`; None if there are none. All
    others are stale.
    """
    start = int(np.searchsorted(committed.numbers, in_file))
    count = _run(committed.numbers[start:], in_file, committed.whole[start:])
    count = count if stop is None else min(count, stop - in_file)
    return committed.take(np.arange(start, start + count)) if count > 0 else None


def torn_rows(committed: Committed[Any], in_file: int) -> int:
    """How many more rows `rows_of` would return if none were torn."""
    start = int(np.searchsorted(committed.numbers, in_file))
    numbers, whole = committed.numbers[start:], committed.whole[start:]
    return _run(numbers, in_file, np.ones_like(whole)) - _run(numbers, in_file, whole)


def _run(numbers: Array, first: int, whole: Array) -> int:
    """How many numbers at the start are `first`, `first + 1`, … and belong to whole rows."""
    good = whole & (numbers == first + np.arange(len(numbers)))
    return int(np.argmin(np.append(good, False)))


def rows_among(committed: Committed[Taken], wanted: Array) -> list[Taken]:
    """The whole rows that the mask `wanted` selects, in runs of consecutive ones."""
    places = np.flatnonzero(wanted & committed.whole)
    edges = np.flatnonzero(np.diff(committed.numbers[places]) != 1) + 1
    return [committed.take(part) for part in np.split(places, edges) if len(part)]


class CommittedRows(Committed[Array]):
    """The committed rows of one channel in an area of rows, in both halves.

    In a torn journal, a row is whole if its checksum is right. Without checksums it is whole if the disk has something
    in its last sector that was written after it; this does not hold if committed rows may be `rewritten`.

    FormatError if the area has rows of another size, or no block of this number.
    """

    def __init__(
        self,
        journal: JournalContents,
        name: str,
        block: int,
        dtype: np.dtype[Any],
        channel: int,
        *,
        rewritten: bool = False,
    ) -> None:
        area = journal.area(name, RowArea)
        shape = (2, area.channels, area.rows + 1, area.row_size)
        if area.row_size != dtype.itemsize or journal.data[name].size != np.prod(shape):
            raise FormatError(
                f"the journal's area {name!r}: expected rows of {dtype.itemsize} bytes, found {area.row_size}"
            )
        if block >= area.channels:
            raise FormatError(
                f"the journal's area {name!r}: expected more than {block} blocks of rows, found {area.channels}"
            )
        self._bytes = np.ascontiguousarray(journal.data[name].reshape(shape)[:, block])
        self._area = area
        self._block = block
        self._torn, self._sealed, self._rewritten = journal.torn, journal.sealed_rows, rewritten
        rows: Array = self._bytes.view(dtype)[..., 0]
        committed = (rows["#opcode"] == 5) & (rows["#channel"] == channel) & (rows["#log_time"] != 0)
        committed &= rows["#sequence"] != HOLE
        committed[:, area.rows] = False  # the spare row is never committed
        halves, places = np.nonzero(committed)
        self.rows = rows
        self.numbers, order = np.unique(rows["#sequence"][halves, places].astype(np.int64), return_index=True)
        self._halves, self._places = halves[order], places[order]
        self.whole: Array = np.ones(len(order), np.bool_)
        if self._torn:
            self.whole = np.fromiter(map(self._is_whole, range(len(order))), np.bool_)

    def take(self, places: Array) -> Array:
        """Copies of the rows at `places`. They are copied as bytes: NumPy may not copy the padding between fields."""
        copies: Array = self._bytes[self._halves[places], self._places[places]].view(self.rows.dtype)[:, 0]
        return copies

    def row(self, sequence: int) -> Array | None:
        """The committed row with `sequence`; None if it is missing or torn."""
        found = self._find(sequence)
        if found is None or not self.whole[found]:
            return None
        row: Array = self.rows[self._halves[found], self._places[found]]
        return row

    def following(self, sequence: int, state_end: int) -> bytes | None:
        """The state in the slot after the row with `sequence`; None if the row is missing, the state was not known when
        the row was committed, or a torn journal does not have it whole."""
        found = self._find(sequence)
        if found is None:
            return None
        half, place = self._halves[found], self._places[found]
        if self.rows["#opcode"][half, place + 1] != 5:
            return None
        state = self._bytes[half, place + 1, STATE:state_end].tobytes()
        if self._torn:
            sealed = int(self.rows["#publish_time"][half, place]) >> 32
            if not self._sealed or zlib.crc32(state) != sealed:
                return None
        return state

    def finals(self, state_end: int) -> list[FinalHole]:
        """The final holes after all committed rows that end an episode; none of a torn journal."""
        rows = self.rows
        flags = (rows[name][self._halves, self._places].view(np.uint8) for name in ("terminal", "timeout"))
        ended = np.logical_or(*flags)
        if self._torn or not ended.any():
            return []
        halves, places = self._halves[ended], self._places[ended]
        last = rows[halves, places]
        # the spare row: its state was copied to the other half's first row
        beyond = places + 1 == self._area.rows
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
        found = int(np.searchsorted(self.numbers, sequence))
        return found if found < len(self.numbers) and self.numbers[found] == sequence else None

    def _is_whole(self, i: int) -> bool:
        """Whether the disk has the i-th committed row as it was committed."""
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
        # A row of less than a sector lies in two at most. The second one also holds the next row's `sequence`, which
        # was stored later: if the disk has that, it has the end of this row.
        follows = i + 1 < len(self.numbers) and self.numbers[i + 1] == self.numbers[i] + 1
        beside = follows and (int(self._halves[i + 1]), int(self._places[i + 1])) == (half, place + 1)
        if beside:
            return size <= SECTOR - SEQUENCE_END
        return size <= SECTOR - EPISODE_END and place + 1 < self._area.rows and self._has_hole(half, place)

    def _has_hole(self, half: int, place: int) -> bool:
        """Whether a final hole that was made later follows a row in its block."""
        row, hole = self.rows[half, place], self.rows[half, place + 1]
        later = hole["#sequence"] == HOLE and hole["#log_time"] > row["#log_time"]
        return bool(later and hole["episode"] == row["episode"] and (row["terminal"] or row["timeout"]))


class RowDeriver:
    """Fills the fields that `step()` leaves out: `step`, a `log_time` that never decreases, `publish_time`.

    It remembers the running episode from one batch of a channel's rows to the next.
    """

    def __init__(self, episode: int = -1, step: int = -1, time_ns: int = 0) -> None:
        self._episode = episode
        self._step = step
        self._time = time_ns

    def fill(self, rows: Array) -> None:
        """Completes consecutive rows in place."""
        n = len(rows)
        if not n:
            return
        times = rows["#log_time"].astype(np.uint64)
        times[0] = max(int(times[0]), self._time)
        np.maximum.accumulate(times, out=times)
        rows["#log_time"] = times
        rows["#publish_time"] = times
        episodes = rows["episode"].astype(np.int64)
        index = np.arange(n)
        starts = np.zeros(n, dtype=np.int64)
        starts[1:] = np.where(episodes[1:] != episodes[:-1], index[1:], 0)
        np.maximum.accumulate(starts, out=starts)
        steps = index - starts
        if episodes[0] == self._episode:
            first = int(np.searchsorted(starts, 1))
            steps[:first] += self._step + 1
        rows["step"] = steps
        self._episode, self._step, self._time = int(episodes[-1]), int(steps[-1]), int(times[-1])


def even_rows(channel: int, data: Any, rows: Array) -> Rows:
    """`Rows` of constant size, at least one: `rows` is the structured view of `data`."""
    offsets = np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.dtype.itemsize)
    return Rows(channel, int(rows["#sequence"][0]), data, offsets, rows["#log_time"].astype(np.uint64))


class CommittedRecords(Committed[Rows]):
    """The committed records of one channel in a log, in the order of `numbers`."""

    def __init__(self, channel: int, records: Mapping[int, bytes]) -> None:
        self._channel = channel
        self.numbers: Array = np.array(sorted(records), np.int64)
        self.whole: Array = np.ones(len(records), np.bool_)
        self._records = [records[number] for number in self.numbers.tolist()]

    def take(self, places: Array) -> Rows:
        """The records at `places`."""
        chosen = [self._records[i] for i in places.tolist()]
        return joined_rows(self._channel, int(self.numbers[places[0]]), chosen, sealed=True)


def committed_records(
    journal: JournalContents, name: str, in_file: Mapping[int, int] | None = None
) -> dict[int, CommittedRecords]:
    """The committed records of a log, by channel, without the first `in_file` records of each.

    A half is read up to a record whose checksum is wrong.
    """
    found: dict[int, dict[int, bytes]] = {}
    area = journal.area(name, LogArea)
    for half in range(area.halves):
        data = _half(journal, area, half)
        for start, end, channel, sequence, _ in _whole_records(journal, data, in_file or {}):
            found.setdefault(channel, {})[sequence] = bytes(data[start:end])
    return {channel: CommittedRecords(channel, found[channel]) for channel in sorted(found)}


def _whole_records(
    contents: JournalContents, data: memoryview, in_file: Mapping[int, int]
) -> Iterator[tuple[int, int, int, int, int]]:
    """As `iter_records`, without records that are in the file, up to one whose checksum is wrong."""
    sealed = contents.sealed_records
    try:
        for start, end, channel, sequence, log_time in iter_records(data):
            if sequence < in_file.get(channel, 0):
                continue
            if sealed and checksum(data[start:end]) != seal_of(data, start)[0]:
                return
            yield start, end, channel, sequence, log_time
    except FormatError:  # torn
        return


def size_behind(journal: JournalContents) -> int:
    """Size of the file (bytes) after the log of events last went into it; 0 if the journal does not say."""
    return int(journal.data[journal.area("events", LogArea).name][8:16].view("<u8")[0])


def _half(contents: JournalContents, area: LogArea, half: int) -> memoryview:
    raw = contents.data[area.name]
    start = half * area.half
    end = int(raw[start : start + 8].view("<u8")[0])
    if end > area.capacity:
        raise FormatError(f"the journal's area {area.name!r} claims {end} bytes of {area.capacity}")
    return memoryview(raw.data)[start + LOG_HEADER : start + LOG_HEADER + end]


def running_record(contents: JournalContents, name: str, sequence: int, layout: StepLayout) -> bytes | None:
    """The state (CDR bytes after `episode` and `env`) of the running record, which will have `sequence`; None if it is
    not here."""
    area = contents.area(name, LogArea)
    for half in range(area.halves):
        start = half * area.half + LOG_HEADER + len(_half(contents, area, half))
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
    """The checksum of the running state before row `sequence`, taken from the record before that row."""
    for half in range(area.halves):
        data = _half(contents, area, half)
        for start, _, _, found, _ in _whole_records(contents, data, {}):
            if found == sequence - 1:
                return seal_of(data, start)[1]
    return None
