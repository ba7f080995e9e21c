"""The valid prefix of a recording without a summary: whole records, chunks with good CRCs and their message indexes."""

from __future__ import annotations

import contextlib
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.journal.logs import group_records
from tupli_mcap.mcap.compression import decompress
from tupli_mcap.mcap.container import COMPRESSIONS, MAGIC, PROFILE, Rows
from tupli_mcap.mcap.records import MAX_CHUNK, parse_record
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.summary import foreign
from tupli_mcap.recording.contents import RECORDING_METADATA, check_metadata
from tupli_mcap.recording.index import INDEX_NAME

__all__ = [
    "Scan",
    "head",
    "metadata_at",
    "scan",
]

_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")
_ATTACHMENT_HEAD = struct.Struct("<QQI")


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
    found = Scan()
    position = len(MAGIC)
    waiting: tuple[tuple[int, ...], Rows] | None = None
    while position + 9 <= source.size:
        opcode, length = _RECORD.unpack(source.read(position, 9))
        end = position + 9 + length
        if end > source.size or length > MAX_CHUNK:
            break
        try:
            if opcode == Opcode.CHUNK:
                if only_metadata or waiting is not None:
                    break
                waiting = _chunk(source, position, length, found)
            elif opcode == Opcode.MESSAGE_INDEX:
                if waiting is None:
                    break
                found.chunks.append(waiting[0])
                channel, rows = waiting[0][7], waiting[0][4]
                found.counts[channel] = found.counts.get(channel, 0) + rows
                waiting = None
            elif waiting is not None or not _other(source, opcode, position, length, found):
                break
        except FormatError:
            break
        position = end
        if waiting is None:
            found.end = position
    if waiting is not None:
        found.unindexed = waiting[1]
    return found


def _other(source: Source, opcode: int, position: int, length: int, found: Scan) -> bool:
    """A record outside chunks; False where the data ends."""
    body = memoryview(source.read(position + 9, length))
    if opcode == Opcode.HEADER:
        size = int.from_bytes(body[:4], "little")
        found.profile = bytes(body[4 : 4 + size]).decode(errors="replace")
    elif opcode == Opcode.METADATA:
        record = parse_record(opcode, body, position, source.name)
        found.metadata[record.name] = record.metadata
        found.metadata_indexes.append(MetadataIndex(position, length + 9, record.name))
    elif opcode == Opcode.ATTACHMENT:
        index = _attachment(body, position)
        if index.name == INDEX_NAME:
            return False
        found.attachments[index.name] = index
    elif opcode == Opcode.SCHEMA:
        schema: Schema = parse_record(opcode, body, position, source.name)
        found.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel: Channel = parse_record(opcode, body, position, source.name)
        found.channels[channel.id] = channel
    else:
        return False
    return True


def _attachment(body: memoryview, position: int) -> AttachmentIndex:
    try:
        log_time, create_time, size = _ATTACHMENT_HEAD.unpack_from(body)
        at = _ATTACHMENT_HEAD.size
        name = bytes(body[at : at + size]).decode()
        at += size
        size = int.from_bytes(body[at : at + 4], "little")
        media_type = bytes(body[at + 4 : at + 4 + size]).decode()
        at += 4 + size
        data_size = int.from_bytes(body[at : at + 8], "little")
    except (struct.error, UnicodeDecodeError) as err:
        raise FormatError(f"damaged attachment at offset {position}") from err
    crc = int.from_bytes(body[-4:], "little")
    if at + 8 + data_size + 4 != len(body) or zlib.crc32(body[:-4]) != crc:
        raise FormatError(f"damaged attachment at offset {position}")
    return AttachmentIndex(position, len(body) + 9, log_time, create_time, data_size, name, media_type)


def _chunk(source: Source, position: int, length: int, found: Scan) -> tuple[tuple[int, ...], Rows]:
    """A chunk's row of the chunk table, and its records; definitions in it are remembered."""
    record = memoryview(source.read(position + 9, length))
    where = f"{source.name}: chunk at offset {position}"
    try:
        _, _, size, crc, name_length = _CHUNK_HEAD.unpack_from(record)
    except struct.error as err:
        raise FormatError(f"{where}: too short") from err
    at = _CHUNK_HEAD.size
    name = bytes(record[at : at + name_length]).decode(errors="replace")
    at += name_length
    packed = int.from_bytes(record[at : at + 8], "little")
    if at + 8 + packed != len(record) or size > MAX_CHUNK:
        raise FormatError(f"{where}: its sizes do not add up")
    data = memoryview(decompress(name, record[at + 8 :], size, where))
    if zlib.crc32(data) != crc:
        raise FormatError(f"{where}: its CRC differs")
    skip = _definitions(source, data, found)
    groups = group_records(data[skip:])
    if len(groups) != 1:
        raise FormatError(f"{where}: expected messages of one channel, found {len(groups)}")
    (rows,) = groups
    compression = COMPRESSIONS.index(name or "none")
    row = (position, length + 9, size, rows.first, len(rows.offsets), skip, crc, rows.channel, compression, 0)
    return row, rows


def _definitions(source: Source, data: memoryview, found: Scan) -> int:
    """Takes the Schema and Channel records a chunk starts with; returns their size."""
    position = 0
    while position + 9 <= len(data) and data[position] in (Opcode.SCHEMA, Opcode.CHANNEL):
        opcode, length = _RECORD.unpack_from(data, position)
        end = position + 9 + length
        if end > len(data):
            raise FormatError(f"{source.name}: a record in a chunk claims {length} bytes")
        _other_definition(source, opcode, data[position + 9 : end], found)
        position = end
    return position


def _other_definition(source: Source, opcode: int, body: memoryview, found: Scan) -> None:
    parsed = parse_record(opcode, body, 0, source.name)
    target: dict[int, object] = found.schemas if opcode == Opcode.SCHEMA else found.channels  # type: ignore[assignment]
    target[parsed.id] = parsed  # under the chunk's CRC, which a definition outside of chunks has not


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
