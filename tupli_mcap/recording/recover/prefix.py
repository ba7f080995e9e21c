"""Reads the valid prefix of a recording without a summary: whole records, and chunks with CRC and message index."""

from __future__ import annotations

import contextlib
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Metadata, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunk_records import chunk_records
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import MAGIC, PROFILE, foreign, parse_record
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.walk import Chunk, Found, Walk
from tupli_mcap.recording.contents import RECORDING_METADATA, check_metadata
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recover.evidence import Evidence, Piece
from tupli_mcap.recording.recover.file_end import Tail


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
            if waiting is None and not _take(evidence, record):
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


def _take(evidence: Evidence, record: Found) -> bool:
    """Takes a record outside of chunks; returns False at the end of the data section."""
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
