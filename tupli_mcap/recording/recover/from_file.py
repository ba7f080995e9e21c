"""Collects what is good in a recording's file: up to its first damage (`prefix`), or anywhere (`gather`)."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunk_records import ChunkRecords, chunk_records
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import MAGIC, PROFILE, check_crc, foreign, message_index, parse_record
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.walk import Chunk, ChunkClaim, Damage, Found, Walk
from tupli_mcap.recording.contents import (
    CHANNEL_KEYS,
    RECORDING_KEYS,
    RECORDING_METADATA,
    REPEATED_METADATA,
    check_metadata,
    check_version,
    is_ours,
)
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recover.evidence import Evidence, Piece, RepairedChunk
from tupli_mcap.recording.recover.file_end import Tail

_HEAD = 4096  # the recording's metadata record begins within this many bytes

# ---- up to the first damage


def prefix(source: Source, *, only_metadata: bool = False) -> Evidence:
    """Reads records until the file or its data section ends, or a record is damaged.

    The rows of a last chunk without its message index are taken, but `good_end` is before that chunk. With
    `only_metadata`, it reads only the records before the first chunk.

    Raises:
        FormatError: the chunks of a channel do not hold its rows without gaps. A damaged end raises nothing.
    """
    evidence, walk = Evidence(source, Tail(), strict=True, good_end=len(MAGIC)), Walk(source)
    waiting: tuple[tuple[int, ...], Rows] | None = None  # a chunk whose message index comes next
    for opcode, position, length in walk.places():
        if opcode == Opcode.MESSAGE_INDEX:
            if waiting is None:
                break
            entry, rows = waiting
            _check_follows(evidence, rows)
            evidence.pieces.setdefault(rows.channel, []).append(Piece(rows.first, len(rows.offsets), entry))
            waiting = None
        elif waiting is not None or (opcode == Opcode.CHUNK and only_metadata):
            break
        elif opcode == Opcode.HEADER:  # the contents do not depend on it
            evidence.profile = _profile(source, position, length)
        else:
            record = walk.at(position)
            if isinstance(record, str) or record.repaired:
                break
            if record.chunk is not None:
                waiting = _chunk(evidence, record, record.chunk)
            if waiting is None and not _take_next(evidence, record):
                break
        if waiting is None:
            evidence.good_end = position + length
    if waiting is not None:
        _check_follows(evidence, waiting[1])
        evidence.add_rows(waiting[1].channel, [waiting[1]])
    return evidence


def _check_follows(evidence: Evidence, rows: Rows) -> None:
    if rows.first != evidence.stop(rows.channel):
        raise FormatError(
            f"{evidence.source.name}: the chunks of channel {rows.channel} do not hold its rows without gaps"
        )


def _profile(source: Source, position: int, length: int) -> str:
    body = source.read(position + 9, length - 9)
    return body[4 : 4 + int.from_bytes(body[:4], "little")].decode(errors="replace")


def _take_next(evidence: Evidence, record: Found) -> bool:
    """Takes the record after those of the prefix; returns False at the end of the data section."""
    if record.attachment is not None:
        if record.attachment.name == INDEX_NAME:
            return False
        evidence.attachments[record.attachment.name] = record.attachment
        return True
    if record.opcode not in (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL):
        return False
    parsed = parse_record(record.opcode, record.body, record.offset, evidence.source.name)
    if isinstance(parsed, Metadata):
        evidence.metadata_indexes.append(MetadataIndex(record.offset, record.length, parsed.name))
        if parsed.name == RECORDING_METADATA:
            evidence.metadata = parsed.metadata
    elif isinstance(parsed, Schema):
        evidence.schemas[parsed.id] = parsed
    else:
        evidence.channels[parsed.id] = parsed
    return True


def _chunk(evidence: Evidence, record: Found, chunk: Chunk) -> tuple[tuple[int, ...], Rows] | None:
    """A chunk's row of the chunk table, and its rows; None if they are damaged.

    Takes the definitions in the chunk: its CRC covers them, while those outside of chunks have none.
    """
    try:
        content = chunk_records(chunk.data, evidence.source.name, chunk.packed)
    except FormatError:
        return None
    evidence.schemas |= {schema.id: schema for schema in content.schemas}
    evidence.channels |= {channel.id: channel for channel in content.channels}
    headers = content.headers
    data = bytes(chunk.data[content.skip :])
    rows = Rows(content.channel, content.first, data, headers["#offset"], headers["#log_time"])
    return content.row(record.offset, record.length, chunk), rows


def head(source: Source) -> dict[str, str]:
    """The metadata of a recording, from its first records; raises FormatError if they are missing or foreign."""
    evidence = prefix(source, only_metadata=True)
    if evidence.metadata is None:
        if evidence.profile in (PROFILE, ""):
            raise FormatError(
                f"{source.name}: the file is cut off or damaged before its first step; nothing can be read from it"
            )
        raise foreign(source, f"its profile is {evidence.profile!r}")
    return check_metadata(source, evidence.metadata)


def metadata_at(path: Path) -> dict[str, str]:
    """The same for the file at a path; raises RecordingError if it cannot be opened."""
    with contextlib.closing(PathSource(path)) as source:
        return head(source)


# ---- anywhere


def gather(source: Source, tail: Tail) -> Evidence:
    """Reads the whole file once, without its journal; raises nothing for damage.

    Raises:
        NewerVersionError: the recording's format is not known.
    """
    evidence = Evidence(source, tail)
    if tail.summary is not None:
        evidence.schemas, evidence.channels = dict(tail.summary.schemas), dict(tail.summary.channels)
    chunks: dict[int, list[_FoundChunk]] = {}
    indexed: ChunkRecords | None = None  # those of the last chunk, whose message index comes next
    for item in Walk(source, known=tail.known_chunks(), end=tail.data_end):
        if isinstance(item, Damage):
            evidence.damages.append(item)
        elif item.chunk is not None:
            indexed = _take_chunk(evidence, item, item.chunk, chunks)
        else:
            if item.opcode == Opcode.MESSAGE_INDEX and indexed is not None:
                _check_index(evidence, item, indexed)
            indexed = None
            _take(evidence, item)
    for channel, found_chunks in chunks.items():
        _take_rows(evidence, channel, found_chunks)
    evidence.damages.sort(key=lambda damage: damage.offset)
    evidence.good_end = evidence.damages[0].offset if evidence.damages else source.size
    return evidence


class _FoundChunk(NamedTuple):
    offset: int
    length: int
    piece: Piece
    repaired: str  # what is wrong in its header


def _check_index(evidence: Evidence, record: Found, records: ChunkRecords) -> None:
    number, entries = message_index(record.body)
    if number != records.channel or not np.array_equal(entries, records.index_entries()):
        _add_damage(evidence, record, "the message index says other than its chunk holds")


def _add_damage(evidence: Evidence, record: Found, why: str) -> None:
    """Notes damage of a whole record whose content is wrong."""
    evidence.damages.append(Damage(record.offset, record.offset + record.length, why, record.opcode))


def _take(evidence: Evidence, record: Found) -> None:
    """Takes a record that is no chunk."""
    if record.attachment is not None:
        if record.attachment.name != INDEX_NAME:
            evidence.attachments[record.attachment.name] = record.attachment
        return
    if record.opcode not in (Opcode.HEADER, Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL):
        return
    parsed = parse_record(record.opcode, record.body, record.offset, evidence.source.name)
    if isinstance(parsed, Header):
        evidence.profile = parsed.profile
    elif isinstance(parsed, Metadata) and parsed.name in (RECORDING_METADATA, REPEATED_METADATA):
        _take_metadata(evidence, parsed.metadata, record)
    elif isinstance(parsed, Schema):
        evidence.schemas.setdefault(parsed.id, parsed)
    elif isinstance(parsed, Channel) and _is_whole(evidence, parsed, record):
        evidence.channels.setdefault(parsed.id, parsed)


def _take_metadata(evidence: Evidence, values: dict[str, str], record: Found) -> None:
    try:
        whole = check_crc(values, RECORDING_KEYS, "the recording's metadata")
    except FormatError as err:
        _add_damage(evidence, record, str(err))
    else:
        check_version(whole, evidence.source.name)
        evidence.metadata = evidence.metadata or whole


def _is_whole(evidence: Evidence, channel: Channel, record: Found) -> bool:
    """Whether a channel's metadata have the right `crc`."""
    try:
        if is_ours(channel.topic):
            check_crc(channel.metadata, CHANNEL_KEYS, f"the metadata of channel {channel.topic!r:.80}")
    except FormatError as err:
        _add_damage(evidence, record, str(err))
        return False
    return True


def _take_chunk(
    evidence: Evidence, record: Found, chunk: Chunk, chunks: dict[int, list[_FoundChunk]]
) -> ChunkRecords | None:
    """Adds a chunk to those of its channel; returns its records, None if they are damaged."""
    try:
        content = chunk_records(chunk.data, "the chunk", chunk.packed)
        if not chunk.crc:
            raise FormatError("the chunk has no CRC")
    except FormatError as err:
        _add_damage(evidence, record, str(err))
        return None
    if evidence.tail.summary is None:  # definitions in chunks have a CRC, those outside have none
        evidence.schemas |= {schema.id: schema for schema in content.schemas}
        evidence.channels |= {channel.id: channel for channel in content.channels}
    channel, count, size = content.channel, len(content.headers), len(chunk.data)
    piece = Piece(content.first, count, content.row(record.offset, record.length, chunk))
    if record.repaired:
        claim = ChunkClaim(record.length, size, chunk.compression, chunk.crc)
        place = RepairedChunk(record.offset, claim, content.skip)
        piece = evidence.load(place, channel, content.first, count, size - content.skip)
    chunks.setdefault(channel, []).append(_FoundChunk(record.offset, record.length, piece, record.repaired))
    return content


def _take_rows(evidence: Evidence, channel: int, chunks: list[_FoundChunk]) -> None:
    """Takes the chunks of a channel, in any order."""
    left_out = set(evidence.add(channel, [chunk.piece for chunk in chunks]))
    for chunk in chunks:
        if chunk.piece in left_out:
            why = "the chunk holds rows that another one holds"
            evidence.damages.append(Damage(chunk.offset, chunk.offset + chunk.length, why, Opcode.CHUNK))
        elif chunk.repaired:
            evidence.damages.append(Damage(chunk.offset, chunk.offset + 49, chunk.repaired, -1))


def may_be_recording(source: Source, tail: Tail) -> bool:
    """Whether the file may be a recording of this package: False if it names another profile."""
    if tail.index is not None or source.size < len(MAGIC) + 9:
        return True
    if tail.summary is not None and RECORDING_METADATA in tail.summary.metadata:
        return True
    if RECORDING_METADATA.encode() in source.read(0, min(source.size, _HEAD)):
        return True
    header = Walk(source).at(len(MAGIC))
    if isinstance(header, str) or header.opcode != Opcode.HEADER:
        return True
    profile: str = parse_record(header.opcode, header.body, header.offset, source.name).profile
    return profile == PROFILE


def is_recording(evidence: Evidence) -> bool:
    """Whether anything in the file shows that it is a recording of this package."""
    known = evidence.profile == PROFILE or evidence.metadata is not None or evidence.tail.index is not None
    return known or any("observation_space" in channel.metadata for channel in evidence.channels.values())
