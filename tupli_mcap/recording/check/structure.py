"""Checks the structure of a file: every record, every CRC, the order of records, and the summary against the data."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Header, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import Chunk, ChunkRecords, chunk_records
from tupli_mcap.mcap.container import CHUNK_ROWS, Container
from tupli_mcap.mcap.records import CDR_HEADER, FOOTER, MAGIC, PROFILE, check_crc, parse_record, records
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.walk import Damage, Found, Walk
from tupli_mcap.recording.check.report import Findings, VerifyReport
from tupli_mcap.recording.contents import (
    CHANNEL_KEYS,
    RECORDING_KEYS,
    RECORDING_METADATA,
    REPEATED_METADATA,
    check_version,
    is_ours,
)
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recover.evidence import FileEnd

_CDR = int.from_bytes(CDR_HEADER, "little")
_SUMMARY_OFFSET = struct.Struct("<BQQ")  # opcode of a group of records, where it starts, its length
_KINDS: dict[int, str] = {
    Opcode.CHUNK: "chunk", Opcode.ATTACHMENT: "attachment", Opcode.MESSAGE_INDEX: "message_index",
    Opcode.METADATA: "metadata",
}  # fmt: skip

_SUMMARY = {
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX,
    Opcode.STATISTICS,
}  # fmt: skip


class Structure:
    """Walks the data section of a recording, then compares the summary and the index with it.

    `journal_lost`: there is no journal with the rows that a killed writer was about to write.
    """

    def __init__(
        self, source: Source, file_end: FileEnd, findings: Findings, *, journal_lost: bool = False
    ) -> None:
        self._source = source
        self._file_end = file_end
        self._findings, self._error = findings, findings.error
        self._journal_lost = journal_lost
        self._found = Container(-1, source.name, "none")  # collects what the summary must hold
        self.schemas, self.channels = self._found.schemas, self._found.channels
        self._said: dict[str, str] = {}  # the recording's metadata
        self._latest: dict[int, int] = {}
        # offset and records of a chunk whose message index comes next
        self._waiting: tuple[int, ChunkRecords] | None = None
        self._behind_damage = False
        self._records = 0
        self.missing = False  # there was damage that may have cost rows
        self._ended = False
        self._outside: set[tuple[type[Any], int]] = set()  # definitions outside chunks
        self._names: set[tuple[int, str]] = set()
        self.repeated: set[str] = set()  # names of several attachments, or of several metadata records

    @property
    def report(self) -> VerifyReport:
        """The problems found."""
        return self._findings.report

    # ---- the data section

    def run(self, tell: Callable[[int], None] = lambda _: None) -> None:
        """Checks everything that does not depend on the layout, and tells how many bytes it has read; raises
        NewerVersionError if the recording's format is not known."""
        if self._source.read(0, min(len(MAGIC), self._source.size)) != MAGIC:
            self._error("file", "expected the magic of MCAP at the start", offset=0)
        walk = Walk(self._source, known=self._file_end.known_chunks(), end=self._file_end.data_end)
        for item in walk:
            self._records += 1
            if isinstance(item, Damage):
                self._damaged(item)
                tell(item.end - item.offset)
            else:
                self._take(item)
                tell(item.length)
        self._finish()

    def _damaged(self, damage: Damage) -> None:
        self._waiting = None
        self._behind_damage = True
        unfinished = self._findings.report.state != "complete"
        if unfinished and damage.end == self._source.size and self._is_cut(damage):
            what = f"the last record is cut off, {damage.end - damage.offset} bytes are left of it"
            if not (self._journal_lost and self.channels):
                self._findings.note("record", what, "nothing to be done", offset=damage.offset)
                return  # the last write of a killed writer; its journal has these rows
            self.missing = True
            self._error("record", f"{what}, and no journal holds it", offset=damage.offset)
            return
        self.missing = True
        what = f"{damage.why}; {damage.end - damage.offset} bytes are damaged"
        self._error(_KINDS.get(damage.opcode, "record"), what, offset=damage.offset)

    def _is_cut(self, damage: Damage) -> bool:
        """Whether a record extends beyond the end of the file."""
        head = self._source.read(damage.offset, min(9, damage.end - damage.offset))
        return len(head) < 9 or damage.offset + 9 + int.from_bytes(head[1:], "little") > self._source.size

    def _take(self, record: Found) -> None:
        if self._ended:
            self._error("record", "expected the summary after the end of the data", offset=record.offset)
        waiting, self._waiting = self._waiting, None
        behind_damage, self._behind_damage = self._behind_damage, False
        if waiting is not None and record.opcode != Opcode.MESSAGE_INDEX:
            self._error("message_index", "expected the message index of the chunk", offset=waiting[0])
        if (self._records == 1) != (record.opcode == Opcode.HEADER):
            self._error("record", "expected one header, as the first record", offset=record.offset)
        if record.chunk is not None:
            self._chunk(record, record.chunk)
        elif record.attachment is not None:
            self._found.attachment_indexes.append(record.attachment)
            self._name(Opcode.ATTACHMENT, record.attachment.name)
        elif record.opcode == Opcode.MESSAGE_INDEX:
            with self._findings.following(behind_damage):
                if waiting is None:
                    why = "expected it behind a good chunk only"
                    self._error("message_index", why, offset=record.offset)
                elif not waiting[1].is_indexed_by(record.body):
                    why = "it has other times or offsets than its chunk"
                    self._error("message_index", why, offset=record.offset)
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._outside.add((type(record.parsed), record.parsed.id))
            self._define(record.parsed, record.offset)
        elif record.opcode == Opcode.DATA_END:
            self._ended = True
            end = record.offset + record.length
            if self._file_end.data_end not in (None, end):
                self._error("record", "expected the summary after the end of the data", offset=end)
            if bytes(record.body) != bytes(4):
                self._error("record", "expected 0 as the CRC of the data section", offset=record.offset)
        elif record.opcode in (Opcode.HEADER, Opcode.METADATA):
            self._named(record)
        else:
            self._error("record", f"a record with opcode {record.opcode} is unknown", offset=record.offset)

    def _named(self, record: Found) -> None:
        """Checks the header or a metadata record."""
        parsed = record.parsed
        if isinstance(parsed, Header):
            if parsed.profile != PROFILE:
                why = f"expected the profile {PROFILE!r}, found {parsed.profile!r:.40}"
                self._error("record", why, offset=record.offset)
            return
        self._found.metadata_indexes.append(MetadataIndex(record.offset, record.length, parsed.name))
        self._name(Opcode.METADATA, parsed.name)
        if parsed.name in (RECORDING_METADATA, REPEATED_METADATA):
            if self._crc(parsed.metadata, RECORDING_KEYS, "metadata", record.offset):
                check_version(parsed.metadata, self._source.name)
            # a recording of the first writers has `crc` only in what was repeated when it was changed
            said = {key: value for key, value in parsed.metadata.items() if key != "crc"}
            self._said = self._said or said
            if said != self._said:
                self._error("metadata", f"expected what {RECORDING_METADATA!r} says", offset=record.offset)
        if self._records == 2 and parsed.name != RECORDING_METADATA:
            self._error("metadata", f"expected {RECORDING_METADATA!r} first", offset=record.offset)

    def _name(self, opcode: int, name: str) -> None:
        if (opcode, name) in self._names:
            self.repeated.add(name)
        self._names.add((opcode, name))

    def _crc(self, values: dict[str, str], known: Sequence[str], kind: str, offset: int) -> bool:
        """Whether `crc` is right for the pairs."""
        try:
            check_crc(values, known, "the metadata")
        except FormatError as err:
            self._error(kind, str(err), offset=offset)
            return False
        return True

    def _define(self, record: Schema | Channel, offset: int) -> None:
        known: dict[int, Any] = self.schemas if isinstance(record, Schema) else self.channels
        kind = "schema" if isinstance(record, Schema) else "channel"
        if record.id in known:
            if known[record.id] != record:
                self._error("layout", f"{kind} {record.id} is defined in two ways", offset=offset)
            return
        known[record.id] = record
        if isinstance(record, Channel) and is_ours(record.topic):
            self._crc(record.metadata, CHANNEL_KEYS, "layout", offset)

    def _chunk(self, record: Found, chunk: Chunk) -> None:
        self._findings.report.chunks += 1
        if record.repaired:
            self._error("chunk", record.repaired, offset=record.offset)
        try:
            content = chunk_records(chunk.data, "the chunk", chunk.claim.packed)
        except FormatError as err:
            self._error("chunk", str(err), offset=record.offset)
            return
        for schema in content.schemas:
            self._define(schema, record.offset)
        for channel in content.channels:
            self._define(channel, record.offset)
        self._waiting = record.offset, content
        self._rows(record, chunk, content)

    def _rows(self, record: Found, chunk: Chunk, content: ChunkRecords) -> None:
        """Checks the rows of a chunk: in order, without gap, with the times in its header."""
        headers, number = content.headers, content.channel
        topic = self.channels[number].topic if number in self.channels else f"{number}"
        place = {"offset": record.offset, "channel": topic}
        counts = self._found.counts
        expected = counts.get(number, 0)
        if content.first != expected and not (self.missing and content.first > expected):
            self._error("rows", f"expected row {expected}, found row {content.first}", **place)
        if (number in counts) == bool(content.skip) and not (self.missing and not content.skip):
            self._error("chunk", "expected definitions in the first chunk of a channel only", **place)
        times = headers["#log_time"]
        counts[number] = content.first
        row = content.row(record.offset, chunk.claim)
        self._found.note_chunk(row, int(times[0]), int(times[-1]))
        self._findings.report.messages += len(headers)
        if (times[1:] < times[:-1]).any() or int(times[0]) < self._latest.get(number, 0):
            self._error("rows", "expected times that do not decrease", **place)
        self._latest[number] = int(times[-1])
        if (headers["#publish_time"] != times).any():
            self._error("rows", "expected publish times equal to log times", **place)
        if (headers["#cdr"] != _CDR).any():
            self._error("rows", "expected plain little-endian CDR", **place)
        if (chunk.start_time, chunk.end_time) != (int(times[0]), int(times[-1])):
            self._error("chunk", "its header has other times than its messages", **place)

    # ---- the summary

    def _finish(self) -> None:
        for why in self._file_end.why:
            self._error("summary", why)
        known = {(Schema, number) for number in self.schemas} | {
            (Channel, number) for number in self.channels
        }
        for kind, number in sorted((kind.__name__.lower(), number) for kind, number in known - self._outside):
            self._error("layout", f"{kind} {number} is not defined outside of the chunks")
        if not self._file_end.finished or self._findings.report.state == "unfinished":
            return  # its writer was killed, maybe while it wrote the end
        if self._waiting is not None:
            why = "expected the message index of the chunk"
            self._error("message_index", why, offset=self._waiting[0])
        if not self._ended:
            self._error("record", "expected the end of the data section, found none")
        attachments = self._found.attachment_indexes
        if not attachments or attachments[-1].name != INDEX_NAME:
            self._error("index", f"expected {INDEX_NAME!r} as the last attachment")
        if self._file_end.index is not None:
            table = np.frombuffer(self._found.chunk_rows, CHUNK_ROWS)
            if not np.array_equal(table, self._file_end.index.chunks):
                with self._findings.following(self.missing):
                    self._error("index", "the episode index lists other chunks than there are")
        if self._file_end.summary is None:
            if not self._file_end.why:
                self._error("summary", "the footer is damaged or cut off", offset=self._source.size)
            return
        # the bytes of a replaced one may still be there
        self._found.attachment_indexes = list({index.name: index for index in attachments}.values())
        self._summary(self._file_end.summary.start)

    def _summary(self, start: int) -> None:
        end = self._source.size - len(MAGIC) - FOOTER.size
        data = self._source.read(start, end - start)
        parsed: dict[int, list[Any]] = {}
        groups: dict[int, list[int]] = {}
        pointed: set[int] = set()
        for opcode, offset, body in records(data, start, self._source.name):
            if opcode == Opcode.SUMMARY_OFFSET:
                self._offsets(body, groups, pointed, offset)
                continue
            parsed.setdefault(opcode, []).append(parse_record(opcode, body, offset, self._source.name))
            group = groups.setdefault(opcode, [offset, offset])
            if group[1] != offset:
                self._error("summary", f"records with opcode {opcode} are not together", offset=offset)
            group[1] = offset + 9 + len(body)
        for opcode in sorted(parsed.keys() - _SUMMARY):
            why = f"expected no record with opcode {opcode} in the summary"
            self._error("summary", why, offset=groups[opcode][0])
        for opcode in sorted((groups.keys() & _SUMMARY) - pointed):
            why = f"no summary offset points to the records with opcode {opcode}"
            self._error("summary", why, offset=groups[opcode][0])
        wanted: dict[int, list[Any]] = {}
        for opcode, offset, body in records(self._found.summary(start), start, self._source.name):
            if opcode in _SUMMARY:
                wanted.setdefault(opcode, []).append(parse_record(opcode, body, offset, self._source.name))
        for opcode in sorted(_SUMMARY):
            listed, right = (_ordered(opcode, known.get(opcode, [])) for known in (parsed, wanted))
            if listed != right:
                what = Opcode(opcode).name.lower().replace("_", " ")
                why = (
                    f"its {len(listed)} {what} records differ from those of the data, which has {len(right)}"
                )
                with self._findings.following(self.missing):
                    self._error("summary", why, offset=groups.get(opcode, [start])[0])

    def _offsets(
        self, body: memoryview, groups: dict[int, list[int]], pointed: set[int], offset: int
    ) -> None:
        if len(body) != _SUMMARY_OFFSET.size:
            why = f"a summary offset has {len(body)} bytes, not {_SUMMARY_OFFSET.size}"
            self._error("summary", why, offset=offset)
            return
        opcode, start, length = _SUMMARY_OFFSET.unpack(body)
        pointed.add(opcode)
        if groups.get(opcode) != [start, start + length]:
            self._error("summary", "a summary offset points elsewhere", offset=offset)


def _ordered(opcode: int, records: list[Any]) -> list[Any]:
    """The records, definitions sorted by id and attachments by place: the summary may have these in another order."""
    if opcode == Opcode.ATTACHMENT_INDEX:
        return sorted(records, key=lambda r: r.offset)
    return sorted(records, key=lambda r: r.id) if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) else records
