"""Reads the summary and the episode index at the end of a file; either may be missing or damaged."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Statistics

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import COMPRESSIONS
from tupli_mcap.mcap.records import (
    FOOTER,
    MAGIC,
    Summary,
    attachment_index,
    checked_attachment,
    has_summary,
    parse_record,
    read_attachment,
    read_summary,
    records,
)
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.walk import ChunkClaim
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME, EpisodeIndex

_NAME = len(INDEX_NAME).to_bytes(4, "little") + INDEX_NAME.encode()
_BEFORE_NAME = 9 + 16  # opcode, length and two times
_WINDOW = 1 << 20


@dataclass
class Tail:
    """The end of a file: `summary` and `index` are None if missing or damaged, and `why` has a sentence for each.

    `finished` says that there is a footer or an index.
    """

    finished: bool = False
    summary: Summary | None = None
    index: EpisodeIndex | None = None
    statistics: Statistics | None = None
    why: list[str] = field(default_factory=list)

    @property
    def data_end(self) -> int | None:
        return None if self.summary is None else self.summary.start

    def known_chunks(self) -> dict[int, ChunkClaim]:
        """The chunks in the index, by offset."""
        if self.index is None:
            return {}
        return {
            int(row["offset"]): ChunkClaim(
                int(row["length"]),
                int(row["uncompressed"]),
                COMPRESSIONS[row["compression"]].replace("none", ""),
                int(row["crc"]),
            )
            for row in self.index.chunks
            if row["compression"] < len(COMPRESSIONS)
        }


def read_tail(source: Source) -> Tail:
    """Reads summary and index; raises nothing if they are missing or damaged."""
    tail = Tail(finished=has_summary(source))
    if tail.finished:
        try:
            tail.summary = read_summary(source)
            tail.statistics = _statistics(source, tail.summary)
        except FormatError as err:
            tail.why.append(str(err).removeprefix(f"{source.name}: "))
    place = None if tail.summary is None else tail.summary.attachments.get(INDEX_NAME)
    if place is None:
        place = _find_index(source)
    if place is None:
        return tail
    try:
        tail.index = EpisodeIndex.decode(read_attachment(source, place), source.name)
        tail.finished = True
    except FormatError as err:
        tail.why.append(str(err).removeprefix(f"{source.name}: "))
    return tail


def _statistics(source: Source, summary: Summary) -> Statistics | None:
    data = source.read(summary.start, source.size - len(MAGIC) - FOOTER.size - summary.start)
    for opcode, position, body in records(data, summary.start, source.name):
        if opcode == Opcode.STATISTICS:
            statistics: Statistics = parse_record(opcode, body, position, source.name)
            return statistics
    return None


def _find_index(source: Source) -> AttachmentIndex | None:
    """The last attachment with the index's name and a right CRC; the search goes backwards from the end.

    Attachments do not overlap, so damaged ones have no more bytes together than the file. If they claim more, the
    search ends; otherwise each of many claims could take a checksum over the whole file.
    """
    end = budget = source.size
    while end > 0:
        start = max(0, end - _WINDOW)
        window = source.read(start, min(_WINDOW + len(_NAME), source.size - start))
        at = window.rfind(_NAME)
        while at >= 0:
            place = start + at - _BEFORE_NAME
            length = _length_at(source, place)
            if length:
                with contextlib.suppress(FormatError):
                    return checked_attachment(source, place, length)
                budget -= length
                if budget < 0:
                    return None
            at = window.rfind(_NAME, 0, at)
        end = start
    return None


def _length_at(source: Source, place: int) -> int:
    """The length of the record at an offset if its header is that of an episode index, else 0."""
    if place < 0:
        return 0
    length = int.from_bytes(source.read(place + 1, 8), "little")
    if source.read(place, 1) != b"\x09" or length > source.size - place - 9:
        return 0
    try:
        attachment = attachment_index(source, place, length)
    except FormatError:
        return 0
    return length if (attachment.name, attachment.media_type) == (INDEX_NAME, INDEX_MEDIA_TYPE) else 0
