"""What every store of rows keeps: the file and the journal together hold all committed rows, at every moment.

A store is looked at as by a reader whose writer was just killed: after each instruction that changed the journal.
"""

from __future__ import annotations

import itertools
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from tupli_mcap.journal.committed import CommittedRows, committed_records, rows_of, running_record
from tupli_mcap.journal.file import Area, Journal, JournalContents, LogArea, RowArea, boot_id, read_journal
from tupli_mcap.journal.logs import EventLog, ToFile
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.rows.contract import RowStore
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.recording.write.rows.single import SingleRows
from tupli_mcap.recording.write.rows.variable import StepLog
from tupli_mcap.recording.write.rows.vector import VectorRows

PUTS = 11  # rows, more than both halves of a journal hold
BOX = StepLayout(spaces.Box(0, 99, (9,), np.float64), spaces.Discrete(99))
TEXT = StepLayout(spaces.Text(99), spaces.Discrete(99))
IMAGE = StepLayout(spaces.Box(0, 255, (4, 5, 3), np.uint8), spaces.Discrete(99))


def only(*numbers: Any) -> int:
    """What all of them are."""
    found = {float(n) for n in numbers}
    assert len(found) == 1, f"parts of several rows: {found}"
    return int(found.pop())


class Subject:
    """A store, its journal and its file. Row n of a channel is made of n: whoever reads another number has found a row
    that is not whole."""

    channels: Sequence[int] = (1,)
    runs = True  # the next row's state is in the journal before the row is

    def __init__(self, directory: Path, kind: type[Any], *, sealed: bool) -> None:
        self.directory, self.kind, self.sealed = directory, kind, sealed
        self.file: dict[int, list[int]] = defaultdict(list)
        self.done = 0  # rows of each channel that `put` has returned from
        self.journal = self.new_journal("first")
        self.store: Any = self.open()
        self.looks = 0

    def area(self) -> Area:
        raise NotImplementedError

    def open(self) -> RowStore:
        raise NotImplementedError

    def put(self, n: int) -> None:
        """Commits row `n`, of each channel."""
        raise NotImplementedError

    def taken(self, contents: JournalContents, channel: int, first: int) -> list[int]:
        """The rows of a channel from `first` on that a reader takes out of the journal."""
        raise NotImplementedError

    def number(self, record: Any) -> int:
        """The number that a record is made of."""
        raise NotImplementedError

    def running(self, contents: JournalContents, channel: int) -> int:
        """The number that the running row's state is made of."""
        raise NotImplementedError

    def new_journal(self, name: str) -> Journal:
        info = {"boot": boot_id(), "seals": "rows" if self.sealed else "records"}
        journal = Journal(self.directory / f"{name}.journal", [self.area()], info)
        journal.publish()
        return journal

    def add_chunk(self, rows: Rows) -> None:
        """The rows are in the file."""
        held = len(self.file[rows.channel])
        assert rows.first == held, f"row {rows.first} of channel {rows.channel} comes after {held} rows"
        self.file[rows.channel] += self.numbers(rows)

    def start_chunks(self, chunks: Sequence[Rows]) -> Callable[[], None]:
        """They are in the file once the store waits for it, and their memory must stay until then."""

        def finish() -> None:
            for rows in chunks:
                self.add_chunk(rows)

        return finish

    def to_file(self) -> ToFile:
        counts = dict.fromkeys(self.channels, 0)
        never: Any = None
        return ToFile(
            counts,
            0,
            lambda: 0,
            self.add_chunk,
            self.start_chunks,
            grow=never,
            durable=False,
            sealed=self.sealed,
        )

    def numbers(self, rows: Rows) -> list[int]:
        data = memoryview(rows.data).cast("B")
        begins = [*rows.offsets.tolist(), len(data)]
        return [self.number(data[a:b]) for a, b in itertools.pairwise(begins)]

    def check(self, contents: JournalContents) -> None:
        """The file and the journal hold each row that was put, and perhaps the one that is being put."""
        for channel in self.channels:
            known = self.file[channel]
            found = known + self.taken(contents, channel, len(known))
            whole = list(range(self.done)), list(range(self.done + 1))
            assert found in whole, f"channel {channel} has lost rows: {found} of {self.done}"

    def check_now(self) -> None:
        """As `check`, of the file that the journal is, and between rows."""
        contents = read_journal(self.journal.path)
        self.check(contents)
        for channel in self.channels:
            if self.runs:
                found = self.running(contents, channel)
                assert found == self.done, f"channel {channel} has lost its running row: {found}"

    def write(self) -> None:
        """The next row, looked at all the while."""
        with watched(self):
            self.put(self.done)
        self.done += 1
        self.check_now()


@contextmanager
def watched(subject: Subject) -> Iterator[None]:
    """Checks the subject after each instruction of the package that changes its journal."""
    name, area = next(iter(subject.journal.areas.items()))
    last = b""

    def look(frame: FrameType, event: str, arg: Any) -> Any:
        nonlocal last
        ours = "/tupli_mcap/" in frame.f_code.co_filename or "<tupli_mcap" in frame.f_code.co_filename
        if not ours:
            return None
        frame.f_trace_opcodes = True
        data = bytes(subject.journal.buffer(name))
        if data != last:
            last = data
            subject.looks += 1
            sys.settrace(None)
            areas = {name: np.frombuffer(data, np.uint8)}
            subject.check(JournalContents(subject.journal.info, {name: area}, areas))
            sys.settrace(look)
        return look

    sys.settrace(look)
    try:
        yield
    finally:
        sys.settrace(None)


class OfRows(Subject):
    """Steps of constant size."""

    message = BOX.step_message

    def area(self) -> RowArea:
        return RowArea("steps", self.message.record_size, 4, len(self.channels))

    def committed(self, contents: JournalContents, channel: int) -> CommittedRows:
        return CommittedRows(contents, "steps", self.channels.index(channel), self.message.dtype, channel)

    def taken(self, contents: JournalContents, channel: int, first: int) -> list[int]:
        rows = rows_of(self.committed(contents, channel), first)
        return [] if rows is None else [self.number(row) for row in rows]

    def number(self, record: Any) -> int:
        row = record if isinstance(record, np.void) else np.frombuffer(record, self.message.dtype)[0]
        return only(*row["state"].tolist(), row["reward"], row["action"], row["#sequence"])

    def running(self, contents: JournalContents, channel: int) -> int:
        if self.done == 0:
            return 0
        state = self.committed(contents, channel).following(self.done - 1, BOX.state_end)
        assert state is not None, "the running row's state is not there"
        return only(*np.frombuffer(state).tolist())


class Single(OfRows):
    def open(self) -> SingleRows:
        store: SingleRows = self.kind(BOX, self.journal, 1, [], self.to_file())
        store.put_state(np.zeros(9))
        return store

    def put(self, n: int) -> None:
        self.store.put(n, np.full(9, n + 1.0), float(n), False, False)


class Vector(OfRows):
    channels = (1, 2, 3)

    def open(self) -> VectorRows:
        store: VectorRows = self.kind(BOX, self.journal, self.channels, [], self.to_file())
        store.put_state(np.zeros((3, 9)))
        return store

    def put(self, n: int) -> None:
        none, numbers = np.zeros(3, np.bool_), np.full(3, n << 32, np.uint64)
        states, actions = np.full((3, 9), n + 1.0), np.full(3, n)
        batch = self.store.check(actions, states, np.full(3, float(n)), none, none, None)
        self.store.put(batch, numbers, ends=False)


class OfRecords(Subject):
    """Records of any size."""

    def taken(self, contents: JournalContents, channel: int, first: int) -> list[int]:
        committed = committed_records(contents, self.area().name).get(channel)
        rows = None if committed is None else rows_of(committed, first)
        return [] if rows is None else self.numbers(rows)


class Variable(OfRecords):
    def area(self) -> LogArea:
        return LogArea("steps/0", 400, 2)

    def open(self) -> StepLog:
        store: StepLog = self.kind(TEXT, self.journal, "steps/0", 1, [], self.to_file())
        store.put_state(self.text(0))
        return store

    @staticmethod
    def text(n: int) -> str:
        return f"{n} " * (1 + 7 * n % 5)

    def put(self, n: int) -> None:
        self.store.put(n, self.text(n + 1), float(n), False, False)

    def number(self, record: Any) -> int:
        found = MessageDecoder(TEXT).step(record[BODY:])
        n = only(found["reward"], found["action"])
        assert found["state"] == self.text(n)
        return n

    def running(self, contents: JournalContents, channel: int) -> int:
        state = running_record(contents, "steps/0", self.done, TEXT)
        assert state is not None, "the running row's state is not there"
        assert state[4:].rstrip(b"\0").decode() == self.text(self.done)
        return self.done


class Images(Subject):
    """Row n is there for a reader when step n is."""

    message = IMAGE.image_messages["state"]

    def area(self) -> RowArea:
        return RowArea("state/0", self.message.dtype.itemsize, 4)

    def open(self) -> ImageRows:
        (leaf,) = IMAGE.images
        store: ImageRows = self.kind(leaf, self.message, self.journal, "state/0", 1, self.to_file())
        store.put_first(np.zeros((4, 5, 3), np.uint8))
        return store

    def put(self, n: int) -> None:
        self.store.put(np.full((4, 5, 3), n + 1, np.uint8))

    def committed(self, contents: JournalContents) -> CommittedRows:
        return CommittedRows(contents, "state/0", 0, self.message.dtype, 1)

    def taken(self, contents: JournalContents, channel: int, first: int) -> list[int]:
        rows = rows_of(self.committed(contents), first, self.done)
        return [] if rows is None else [self.number(row) for row in rows]

    def number(self, record: Any) -> int:
        row = record if isinstance(record, np.void) else np.frombuffer(record, self.message.dtype)[0]
        return only(*row["data"].flat, row["#sequence"])

    def running(self, contents: JournalContents, channel: int) -> int:
        row = self.committed(contents).row(self.done)
        assert row is not None
        return only(*row["data"].flat)


class Records(OfRecords):
    """Two channels, whose records are put together."""

    channels = (1, 2)
    runs = False

    def area(self) -> LogArea:
        return LogArea("events", 500)

    def open(self) -> EventLog:
        store: EventLog = self.kind(self.journal, "events", self.channels, self.to_file())
        return store

    def put(self, n: int) -> None:
        self.store.append(n + 1, (1, bytes([n]) * (n + 1)), (2, bytes([n]) * 20))

    def number(self, record: Any) -> int:
        return only(*record[BODY:])

    def check(self, contents: JournalContents) -> None:
        super().check(contents)
        held = [len(self.file[c]) + len(self.taken(contents, c, len(self.file[c]))) for c in self.channels]
        assert held[0] == held[1]


STORES: list[Any] = [
    pytest.param(Single, SingleRows, False, id="single"),
    pytest.param(Single, SingleRows, True, id="single, sealed"),
    pytest.param(Vector, VectorRows, False, id="vector"),
    pytest.param(Vector, VectorRows, True, id="vector, sealed"),
    pytest.param(Variable, StepLog, False, id="variable"),
    pytest.param(Images, ImageRows, False, id="images"),
    pytest.param(Images, ImageRows, True, id="images, sealed"),
    pytest.param(Records, EventLog, False, id="records"),
]
MOVING = [one for one in STORES if one.values[0] in (Variable, Images, Records)]


def keeps_all_rows(subject: Subject) -> None:
    """A row is there as a whole or not at all, and its half is used again only once it is in the file."""
    for n in range(PUTS):
        subject.write()
        if n in (1, 6):
            with watched(subject):
                subject.store.flush()
            subject.check_now()
            whole = {channel: list(range(subject.done)) for channel in subject.channels}
            assert subject.file == whole, f"the file lacks rows: {dict(subject.file)}"
    subject.store.flush()
    assert subject.file == {channel: list(range(PUTS)) for channel in subject.channels}
    assert subject.looks > 2 * PUTS  # also while a row was half there


def moves_with_its_running_row(subject: Subject) -> None:
    for _ in range(3):
        subject.write()
    subject.store.flush()
    journal = subject.new_journal("second")
    subject.store.move(journal)
    subject.journal = journal
    subject.check_now()
    while subject.done < PUTS:
        subject.write()
    subject.store.flush()
    assert subject.file == {channel: list(range(PUTS)) for channel in subject.channels}


@pytest.mark.parametrize(("subject", "kind", "sealed"), STORES)
def test_the_file_and_the_journal_hold_all_rows(
    tmp_path: Path, subject: type[Subject], kind: type[Any], sealed: bool
) -> None:
    keeps_all_rows(subject(tmp_path, kind, sealed=sealed))


@pytest.mark.parametrize(("subject", "kind", "sealed"), MOVING)
def test_a_store_moves_with_its_running_row(
    tmp_path: Path, subject: type[Subject], kind: type[Any], sealed: bool
) -> None:
    moves_with_its_running_row(subject(tmp_path, kind, sealed=sealed))


class CommitsBefore(VectorRows):
    """Says that a row is there before it is."""

    def put(self, batch: Any, numbers: Any, *, ends: bool) -> None:
        self._sequence[self._half, :, self._row] = self.counts
        self._pair[self._half, :, self._row] = 1
        super().put(batch, numbers, ends=ends)


class WaitsForNothing(ImageRows):
    """Uses a half again whose chunk is not in the file."""

    def _wait(self, half: int) -> None:
        pass


class LeavesTheRunningRow(StepLog):
    """Does not take it to another journal."""

    def move(self, journal: Journal) -> None:
        self._pending, running = bytearray(), self._pending
        super().move(journal)
        self._pending = running


@pytest.mark.parametrize(
    ("subject", "kind", "check", "found"),
    [
        (Vector, CommitsBefore, keeps_all_rows, "parts of several rows"),
        (Images, WaitsForNothing, keeps_all_rows, "the file lacks rows"),
        (Variable, LeavesTheRunningRow, moves_with_its_running_row, "the running row's state is not there"),
    ],
)
def test_a_broken_store_is_found_out(
    tmp_path: Path, subject: type[Subject], kind: type[Any], check: Callable[[Subject], None], found: str
) -> None:
    with pytest.raises(AssertionError, match=found):
        check(subject(tmp_path, kind, sealed=False))
