"""Collects what is good anywhere in a damaged recording's file: its summary and index, then every record.

Opening a recording does not need this; repair and verification do.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Header, Metadata, MetadataIndex, Schema, Statistics

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import Chunk, ChunkRecords, chunk_records, definitions_first, records_by_channel
from tupli_mcap.mcap.container import LIBRARY
from tupli_mcap.mcap.records import (
    FOOTER,
    MAGIC,
    PROFILE,
    Summary,
    attachment_index,
    check_crc,
    checked_attachment,
    has_summary,
    parse_record,
    read_attachment,
    read_summary,
    records,
)
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.walk import Damage, Found, Walk
from tupli_mcap.messages.images.codecs import uses_codecs
from tupli_mcap.recording.contents import (
    CHANNEL_KEYS,
    RECORDING_KEYS,
    RECORDING_METADATA,
    REPEATED_METADATA,
    check_version,
    is_ours,
)
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME, EpisodeIndex
from tupli_mcap.recording.recover.evidence import Evidence, FileEnd, Piece, UnindexedRows

_NAME = len(INDEX_NAME).to_bytes(4, "little") + INDEX_NAME.encode()
_BEFORE_NAME = 9 + 16  # opcode, length and two times
_WINDOW = 1 << 20
_MOST_CHANNELS = 1024  # in a chunk, which is unpacked for each of them
_HEAD = 4096  # the recording's metadata record begins within this many bytes

# ---- the end of the file


def read_file_end(source: Source) -> FileEnd:
    """Reads summary and index; raises nothing if they are missing or damaged."""
    file_end = FileEnd(finished=has_summary(source))
    if file_end.finished:
        try:
            file_end.summary = read_summary(source)
            file_end.statistics = _statistics(source, file_end.summary)
        except FormatError as err:
            file_end.why.append(str(err).removeprefix(f"{source.name}: "))
    place = None if file_end.summary is None else file_end.summary.attachments.get(INDEX_NAME)
    if place is None:
        place = _find_index(source)
    if place is None:
        return file_end
    try:
        file_end.index = EpisodeIndex.decode(read_attachment(source, place), source.name)
        file_end.finished = True
    except FormatError as err:
        file_end.why.append(str(err).removeprefix(f"{source.name}: "))
    return file_end


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


# ---- all of it


def gather(source: Source, file_end: FileEnd, tell: Callable[[int], None] = lambda _: None) -> Evidence:
    """Reads the whole file once, without its journal, and tells how many bytes it has read; raises nothing for damage.
    NewerVersionError if the recording's format is not known; FormatError if another program has put several recordings
    into it."""
    evidence = Evidence(source, file_end)
    if file_end.summary is not None:
        evidence.schemas, evidence.channels = dict(file_end.summary.schemas), dict(file_end.summary.channels)
    chunks: dict[int, list[_FoundChunk]] = {}
    foreign = is_foreign(source)
    indexed: ChunkRecords | None = None  # those of the last chunk, whose message index comes next
    walk = Walk(source, known=file_end.known_chunks(), end=file_end.data_end, need_crc=not foreign)
    for item in walk:
        tell(item.end - item.offset if isinstance(item, Damage) else item.length)
        if isinstance(item, Damage):
            evidence.damages.append(item)
        elif item.chunk is not None:
            parts = _take_chunk(evidence, item, item.chunk, chunks, foreign=foreign)
            indexed = parts[0] if len(parts) == 1 and not foreign else None
        else:
            if item.opcode == Opcode.MESSAGE_INDEX and indexed and not indexed.is_indexed_by(item.body):
                _add_damage(evidence, item, "the message index says other than its chunk holds")
            indexed = None
            _take(evidence, item)
    for channel, found_chunks in chunks.items():
        left_out = _take_rows(evidence, channel, found_chunks)
        if foreign and left_out:  # what is left could mix episodes of two recordings
            why = "another program has merged several recordings into it"
            raise FormatError(f"{source.name}: {why}; merge these with tupli-mcap merge")
    if any(isinstance(place, UnindexedRows) and not place.claim.crc for place in evidence.loaded.places):
        evidence.notes.append("another program wrote it, without checksums that would show damage")
    elif foreign and chunks:
        evidence.notes.append("another program wrote it")
    # each channel of a chunk names the damage of its header
    evidence.damages = sorted(dict.fromkeys(evidence.damages), key=lambda damage: damage.offset)
    evidence.good_end = evidence.damages[0].offset if evidence.damages else source.size
    return evidence


def is_foreign(source: Source) -> bool:
    """Whether the header names another program as the one that wrote the file."""
    header = _header(source)
    return header is not None and not header.library.startswith(LIBRARY)


def _header(source: Source) -> Header | None:
    """The header of the file; None if it is damaged."""
    record = Walk(source).at(len(MAGIC))
    return record.parsed if isinstance(record, Found) and isinstance(record.parsed, Header) else None


class _FoundChunk(NamedTuple):
    offset: int
    length: int
    piece: Piece
    repaired: str  # what is wrong in its header


def _add_damage(evidence: Evidence, record: Found, why: str) -> None:
    """Notes damage of a whole record whose content is wrong."""
    evidence.damages.append(Damage(record.offset, record.offset + record.length, why, record.opcode))


def _take(evidence: Evidence, record: Found) -> None:
    """Takes a record that is no chunk."""
    if record.attachment is not None:
        if record.attachment.name != INDEX_NAME:
            evidence.attachments[record.attachment.name] = record.attachment
        return
    parsed = record.parsed
    if isinstance(parsed, Header):
        evidence.profile = parsed.profile
    elif isinstance(parsed, Metadata) and parsed.name in (RECORDING_METADATA, REPEATED_METADATA):
        whole = _whole(evidence, record, RECORDING_KEYS, "the recording's metadata")
        if whole is not None:
            check_version(whole, evidence.source.name)
            evidence.metadata = evidence.metadata or whole
    elif isinstance(parsed, Metadata):
        evidence.metadata_indexes.append(MetadataIndex(record.offset, record.length, parsed.name))
    elif isinstance(parsed, Schema):
        evidence.schemas.setdefault(parsed.id, parsed)
    elif isinstance(parsed, Channel):
        what = f"the metadata of channel {parsed.topic!r:.80}"
        if not is_ours(parsed.topic) or _whole(evidence, record, CHANNEL_KEYS, what) is not None:
            evidence.channels.setdefault(parsed.id, parsed)


def _whole(evidence: Evidence, record: Found, known: Collection[str], what: str) -> dict[str, str] | None:
    """The metadata in a record without `crc`; None if `crc` is not right, which is damage."""
    try:
        return check_crc(record.parsed.metadata, known, what)
    except FormatError as err:
        _add_damage(evidence, record, str(err))
        return None


def _take_chunk(
    evidence: Evidence, record: Found, chunk: Chunk, chunks: dict[int, list[_FoundChunk]], *, foreign: bool
) -> list[ChunkRecords]:
    """Adds a chunk to those of its channels, and returns its records by channel: none if they are damaged. Of a foreign
    file it may have several channels, if none has pictures that are stored as changes of those before."""
    try:
        if foreign and not uses_codecs(evidence.channels):
            data = definitions_first(chunk.data, chunk.claim.packed)
            parts = records_by_channel(data, "the chunk", chunk.claim.packed)
            if len(parts) > _MOST_CHANNELS:
                raise FormatError(f"the chunk: expected at most {_MOST_CHANNELS} channels in it")
        else:
            parts = [chunk_records(chunk.data, "the chunk", chunk.claim.packed)]
            if not chunk.claim.crc:
                raise FormatError("the chunk has no CRC")
    except FormatError as err:
        _add_damage(evidence, record, str(err))
        return []
    if evidence.file_end.summary is None:  # definitions in chunks have a CRC, those outside have none
        evidence.schemas |= {schema.id: schema for schema in parts[0].schemas}
        evidence.channels |= {channel.id: channel for channel in parts[0].channels}
    for part in parts:
        channel, first, count = part.channel, part.first, len(part.headers)
        piece = Piece(first, count, part.row(record.offset, chunk.claim))
        if record.repaired or foreign:
            place = UnindexedRows(record.offset, chunk.claim, part.spans, part.skip > 0)
            size = int((part.headers["#length"] + 9).sum())
            piece = evidence.load(place, channel, first, count, size)
        found = _FoundChunk(record.offset, record.length, piece, record.repaired)
        chunks.setdefault(channel, []).append(found)
    return parts


def _take_rows(evidence: Evidence, channel: int, chunks: list[_FoundChunk]) -> bool:
    """Takes the chunks of a channel, in any order; returns whether one holds rows that another one holds."""
    left_out = set(evidence.add(channel, [chunk.piece for chunk in chunks]))
    for chunk in chunks:
        if chunk.piece in left_out:
            why = "the chunk holds rows that another one holds"
            evidence.damages.append(Damage(chunk.offset, chunk.offset + chunk.length, why, Opcode.CHUNK))
        elif chunk.repaired:
            evidence.damages.append(Damage(chunk.offset, chunk.offset + 49, chunk.repaired, -1))
    return bool(left_out)


def may_be_recording(source: Source, file_end: FileEnd) -> bool:
    """Whether the file may be a recording of this package: False if it names another profile."""
    if file_end.index is not None or source.size < len(MAGIC) + 9:
        return True
    if file_end.summary is not None and RECORDING_METADATA in file_end.summary.metadata:
        return True
    if RECORDING_METADATA.encode() in source.read(0, min(source.size, _HEAD)):
        return True
    header = _header(source)
    return header is None or header.profile == PROFILE


def is_recording(evidence: Evidence) -> bool:
    """Whether anything in the file shows that it is a recording of this package."""
    known = (
        evidence.profile == PROFILE or evidence.metadata is not None or evidence.file_end.index is not None
    )
    return known or any("observation_space" in channel.metadata for channel in evidence.channels.values())
