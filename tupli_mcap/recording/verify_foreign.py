"""Structure, CRCs and indexes of an MCAP file that is no recording of ours."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from tupli_mcap.errors import FormatError
from tupli_mcap.recording.checked import message_index
from tupli_mcap.recording.container import MAGIC
from tupli_mcap.recording.findings import Findings
from tupli_mcap.recording.source import Source
from tupli_mcap.recording.summary import FOOTER_SIZE, parse_record, records
from tupli_mcap.recording.survey import Chunk, Damage, Found, Survey
from tupli_mcap.recording.tail import Tail

__all__ = ["verify_foreign"]

_RECORD = struct.Struct("<BQ")
_PIECE = 1 << 20


def verify_foreign(source: Source, tail: Tail, findings: Findings) -> None:
    """Checks what any MCAP file promises; what its messages mean is not known here."""
    findings.note(
        "file",
        "it is no recording of tupli-mcap: structure, CRCs and indexes are checked, contents are not",
        "nothing to be done",
    )
    if source.read(0, min(len(MAGIC), source.size)) != MAGIC:
        findings.error("file", "expected the magic of MCAP at the start", offset=0)
    checker = _Checker(source, tail, findings)
    checker.run()


class _Checker:
    def __init__(self, source: Source, tail: Tail, findings: Findings) -> None:
        self._source = source
        self._tail = tail
        self._findings = findings
        self._counts: dict[int, int] = {}
        self._chunks: dict[int, Found] = {}
        self._entries: dict[int, list[tuple[int, int]]] | None = None  # of the last chunk, by channel
        self._attachments = self._metadata = 0

    def run(self) -> None:
        ended = False
        for found in Survey(self._source, end=self._tail.data_end, messages=True):
            if isinstance(found, Damage):
                size = found.end - found.offset
                why = f"{found.why}; {size} bytes are damaged"
                self._findings.error("record", why, offset=found.offset)
                self._entries = None
                continue
            ended = ended or found.opcode == Opcode.DATA_END
            self._take(found)
        for why in self._tail.why:
            self._findings.error("summary", why)
        if not ended:
            self._findings.error("record", "expected the end of the data section: the file is cut off")
        elif not self._tail.finished:
            self._findings.error("summary", "expected the footer and the closing magic: the file is cut off")
        self._summary()

    def _take(self, found: Found) -> None:
        if found.chunk is not None:
            self._chunk(found, found.chunk)
        elif found.attachment is not None:
            self._attachments += 1
            self._findings.report.attachments += 1
        elif found.opcode == Opcode.METADATA:
            self._metadata += 1
        elif found.opcode == Opcode.MESSAGE:
            self._count(int.from_bytes(found.body[:2], "little"))
        elif found.opcode == Opcode.MESSAGE_INDEX and self._entries is not None:
            channel, entries = message_index(found.body)
            wanted = sorted(self._entries.get(channel, []))
            if sorted(map(tuple, entries.tolist())) != wanted:
                why = f"it says other times or offsets of channel {channel} than its chunk has"
                self._findings.error("message_index", why, offset=found.offset)
        elif found.opcode == Opcode.DATA_END:
            self._data_crc(found)

    def _count(self, channel: int) -> None:
        self._counts[channel] = self._counts.get(channel, 0) + 1
        self._findings.report.messages += 1

    def _chunk(self, found: Found, chunk: Chunk) -> None:
        self._findings.report.chunks += 1
        self._chunks[found.offset] = found._replace(chunk=None, body=memoryview(b""))
        self._entries = {}
        if found.repaired:
            self._findings.error("chunk", found.repaired, offset=found.offset)
        position, data = 0, chunk.data
        times: list[int] = []
        while position < len(data):
            opcode, length = (0, 0) if position + 9 > len(data) else _RECORD.unpack_from(data, position)
            end = position + 9 + length
            if not opcode or end > len(data) or (opcode == Opcode.MESSAGE and length < 22):
                why = f"its records are damaged from byte {position} on"
                self._findings.error("chunk", why, offset=found.offset)
                return
            if opcode == Opcode.MESSAGE:
                channel = int.from_bytes(data[position + 9 : position + 11], "little")
                time = int.from_bytes(data[position + 15 : position + 23], "little")
                self._entries.setdefault(channel, []).append((time, position))
                times.append(time)
                self._count(channel)
            position = end
        if times and (min(times), max(times)) != (chunk.start_time, chunk.end_time):
            self._findings.error(
                "chunk", "its header says other times than its messages", offset=found.offset
            )

    def _data_crc(self, found: Found) -> None:
        expected = int.from_bytes(found.body, "little")
        crc = 0
        if not expected:
            return
        for at in range(0, found.offset, _PIECE):
            crc = zlib.crc32(self._source.read(at, min(_PIECE, found.offset - at)), crc)
        if crc != expected:
            self._findings.error("record", "the CRC of the data section differs", offset=found.offset)

    def _summary(self) -> None:
        if self._tail.summary is None:
            return
        start = self._tail.summary.start
        data = self._source.read(start, self._source.size - len(MAGIC) - FOOTER_SIZE - start)
        try:
            for opcode, offset, body in records(data, start, self._source.name):
                if opcode == Opcode.CHUNK_INDEX:
                    self._chunk_index(parse_record(opcode, body, offset, self._source.name), offset)
        except FormatError as err:
            self._findings.error("summary", str(err).removeprefix(f"{self._source.name}: "))
        statistics = self._tail.statistics
        if statistics is None:
            return
        told = np.array(
            [
                statistics.message_count,
                statistics.chunk_count,
                statistics.attachment_count,
                statistics.metadata_count,
            ]
        )
        here = np.array([sum(self._counts.values()), len(self._chunks), self._attachments, self._metadata])
        if (told != here).any():
            counted = "messages, chunks, attachments and metadata"
            why = f"its statistics count {told.tolist()} {counted}, found {here.tolist()}"
            self._findings.error("summary", why, offset=start)

    def _chunk_index(self, index: ChunkIndex, offset: int) -> None:
        chunk = self._chunks.get(index.chunk_start_offset)
        if chunk is None or chunk.length != index.chunk_length:
            why = f"a chunk index points at offset {index.chunk_start_offset}, where no such chunk is"
            self._findings.error("summary", why, offset=offset)
