"""The valid prefix of a recording without a summary: whole records, chunks with good CRCs and their message indexes."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Metadata, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunk_records import chunk_records
from tupli_mcap.mcap.container import MAGIC, PROFILE, Rows
from tupli_mcap.mcap.records import parse_record
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.summary import foreign
from tupli_mcap.mcap.walk import Chunk, Found, Walk
from tupli_mcap.recording.contents import RECORDING_METADATA, check_metadata
from tupli_mcap.recording.index import INDEX_NAME

__all__ = [
    "Scan",
    "head",
    "metadata_at",
    "scan",
]


@dataclass
class Scan:
    """What a scan found. `unindexed` are the rows of a last chunk whose message index is missing."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    metadata_indexes: list[MetadataIndex] = field(default_factory=list)
    attachments: dict[str, AttachmentIndex] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[tuple[int, ...]] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    unindexed: Rows | None = None
    profile: str = ""
    end: int = len(MAGIC)


def scan(source: Source, *, only_metadata: bool = False) -> Scan:
    """Reads records until the file ends, is damaged, or its data section ends. Executes nothing, raises nothing
    for a damaged tail."""
    found, walk = Scan(), Walk(source)
    waiting: tuple[tuple[int, ...], Rows] | None = None
    for opcode, position, length in walk.places():
        if opcode == Opcode.MESSAGE_INDEX:
            if waiting is None:
                break
            found.chunks.append(waiting[0])
            channel, rows = waiting[0][7], waiting[0][4]
            found.counts[channel] = found.counts.get(channel, 0) + rows
            waiting = None
        elif waiting is not None or (opcode == Opcode.CHUNK and only_metadata):
            break
        elif opcode == Opcode.HEADER:  # whatever it says is no part of the recording
            found.profile = _profile(source, position, length)
        else:
            record = walk.at(position)
            if isinstance(record, str) or record.repaired:
                break
            if record.chunk is not None:
                waiting = _chunk(source, record, record.chunk, found)
            if waiting is None and not _take(source, record, found):
                break
        if waiting is None:
            found.end = position + length
    if waiting is not None:
        found.unindexed = waiting[1]
    return found


def _profile(source: Source, position: int, length: int) -> str:
    body = source.read(position + 9, length - 9)
    return body[4 : 4 + int.from_bytes(body[:4], "little")].decode(errors="replace")


def _take(source: Source, record: Found, found: Scan) -> bool:
    """Takes a record outside of chunks; False where the data ends."""
    if record.attachment is not None:
        if record.attachment.name == INDEX_NAME:
            return False
        found.attachments[record.attachment.name] = record.attachment
        return True
    if record.opcode not in (Opcode.METADATA, Opcode.SCHEMA, Opcode.CHANNEL):
        return False
    parsed = parse_record(record.opcode, record.body, record.offset, source.name)
    if isinstance(parsed, Metadata):
        found.metadata[parsed.name] = parsed.metadata
        found.metadata_indexes.append(MetadataIndex(record.offset, record.length, parsed.name))
    elif isinstance(parsed, Schema):
        found.schemas[parsed.id] = parsed
    else:
        found.channels[parsed.id] = parsed
    return True


def _chunk(source: Source, record: Found, chunk: Chunk, found: Scan) -> tuple[tuple[int, ...], Rows] | None:
    """A chunk's row of the chunk table, and its rows; None if they are no good. Definitions in it are remembered: they
    are under the chunk's CRC, which those outside of chunks have not."""
    try:
        content = chunk_records(chunk.data, source.name, chunk.packed)
    except FormatError:
        return None
    found.schemas |= {schema.id: schema for schema in content.schemas}
    found.channels |= {channel.id: channel for channel in content.channels}
    headers = content.headers
    data = bytes(chunk.data[content.skip :])
    rows = Rows(content.channel, content.first, data, headers["#offset"], headers["#log_time"])
    return content.row(record.offset, record.length, chunk), rows


def is_ours(found: Scan) -> bool:
    """True if the header names our profile."""
    return found.profile == PROFILE


def head(source: Source) -> dict[str, str]:
    """The metadata of a recording, from its first records. Raises FormatError if they are missing or not ours."""
    found = scan(source, only_metadata=True)
    if RECORDING_METADATA not in found.metadata:
        if is_ours(found) or found.profile == "":
            raise FormatError(
                f"{source.name}: the file is cut off or damaged before its first step; nothing can be read from it"
            )
        raise foreign(source, f"its profile is {found.profile!r}")
    return check_metadata(source, found.metadata[RECORDING_METADATA])


def metadata_at(path: Path) -> dict[str, str]:
    """The same of the file at a path. Raises RecordingError too: it cannot be opened."""
    with contextlib.closing(PathSource(path)) as source:
        return head(source)
