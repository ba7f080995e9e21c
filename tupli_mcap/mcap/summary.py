"""What is read when a recording is opened: footer, summary, and the episode index."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import MAGIC, PROFILE
from tupli_mcap.mcap.crc import crc32
from tupli_mcap.mcap.source import Source

__all__ = [
    "OTHER_TOOLS",
    "Summary",
    "has_summary",
    "parse_record",
    "read_attachment",
    "read_metadata",
    "read_summary",
    "records",
]

FOOTER_SIZE = 9 + 20
OTHER_TOOLS = '"mcap doctor" checks other MCAP files, "mcap recover" saves what is good in them'
_FOOTER = struct.Struct("<BQQQI")
_RECORD = struct.Struct("<BQ")
_MAX_SUMMARY = 1 << 31

_PARSERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
}
_STRINGS_BEFORE_MAP: dict[int, tuple[int, int]] = {  # where the first begins, and how many
    Opcode.CHANNEL: (4, 2),
    Opcode.METADATA: (0, 1),
}


class Summary(NamedTuple):
    """The parsed summary. `data_end` is the offset of DataEnd as the summary's start tells it."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    attachments: dict[str, AttachmentIndex]
    metadata: dict[str, MetadataIndex]
    chunks: int
    start: int


def check_magic(source: Source) -> None:
    """Raises FormatError unless the file starts as an MCAP file."""
    if source.size == 0:
        raise FormatError(f"{source.name} is empty; expected an MCAP recording, so delete it or record again")
    head = source.read(0, min(len(MAGIC), source.size))
    if head != MAGIC:
        raise FormatError(
            f"{source.name}: expected an MCAP file, found {head!r} at its start; "
            "give a recording (.mcap), or see what tupli-mcap recover can save"
        )


def has_summary(source: Source) -> bool:
    """True if the file ends as a finished MCAP file does."""
    if source.size < 2 * len(MAGIC) + FOOTER_SIZE:
        return False
    tail = source.read(source.size - len(MAGIC) - FOOTER_SIZE, FOOTER_SIZE + len(MAGIC))
    return (
        tail[FOOTER_SIZE:] == MAGIC and tail[0] == Opcode.FOOTER and tail[1:9] == (20).to_bytes(8, "little")
    )


def read_summary(source: Source) -> Summary:
    """Parses the summary section.

    Raises:
        FormatError: the footer, the summary's CRC or a record in it is wrong.
    """
    end = source.size - len(MAGIC) - FOOTER_SIZE
    footer = source.read(end, FOOTER_SIZE)
    _, _, start, _, crc = _FOOTER.unpack(footer)
    if not len(MAGIC) <= start <= end or end - start > _MAX_SUMMARY:
        raise FormatError(f"{source.name}: expected the summary before offset {end}, the footer says {start}")
    data = source.read(start, end - start)
    if crc32(footer[:-4], crc32(data)) != crc:
        raise FormatError(f"{source.name}: the summary at offset {start} is damaged (its CRC differs)")
    summary = Summary({}, {}, {}, {}, 0, start)
    chunks = 0
    topics: dict[str, int] = {}
    for opcode, position, body in records(data, start, source.name):
        if opcode == Opcode.CHUNK_INDEX:
            chunks += 1
            continue
        if opcode == Opcode.SCHEMA:
            schema: Schema = parse_record(opcode, body, position, source.name)
            _once(summary.schemas, schema.id, schema, f"schema {schema.id}", source.name)
        elif opcode == Opcode.CHANNEL:
            channel: Channel = parse_record(opcode, body, position, source.name)
            _once(summary.channels, channel.id, channel, f"channel {channel.id}", source.name)
            if topics.setdefault(channel.topic, channel.id) != channel.id:
                raise FormatError(
                    f"{source.name}: expected each topic once, found {channel.topic!r:.80} twice"
                )
        elif opcode == Opcode.ATTACHMENT_INDEX:
            attachment: AttachmentIndex = parse_record(opcode, body, position, source.name)
            summary.attachments[attachment.name] = attachment
        elif opcode == Opcode.METADATA_INDEX:
            metadata: MetadataIndex = parse_record(opcode, body, position, source.name)
            summary.metadata[metadata.name] = metadata
    return summary._replace(chunks=chunks)


def _once(found: dict[int, Any], number: int, value: Any, what: str, name: str) -> None:
    """Keeps a definition; FormatError where there is another one of that number."""
    if found.setdefault(number, value) != value:
        raise FormatError(f"{name}: expected {what} once in the summary, found another one")


def records(data: bytes | memoryview, base: int, name: str) -> Iterator[tuple[int, int, memoryview]]:
    """(opcode, file offset, body) of the records in `data`, which starts at file offset `base`."""
    view, position = memoryview(data), 0
    while position < len(view):
        if position + 9 > len(view):
            raise FormatError(
                f"{name}: expected a record at offset {base + position}, found {len(view) - position} bytes"
            )
        opcode, length = _RECORD.unpack_from(view, position)
        start, end = position + 9, position + 9 + length
        if end > len(view):
            raise FormatError(
                f"{name}: the record at offset {base + position} claims {length} bytes, beyond its section"
            )
        yield opcode, base + position, view[start:end]
        position = end


class _Exact(io.BytesIO):
    """Bytes that are not read beyond their end: the package would take what is left for a longer text."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is not None and len(data) < size:
            raise EOFError(f"expected {size} bytes, found {len(data)}")
        return data


def parse_record(opcode: int, body: memoryview, offset: int, name: str) -> Any:
    """A record parsed by the `mcap` package; every defect is a FormatError."""
    if opcode not in _PARSERS:
        raise FormatError(f"{name}: expected another record at offset {offset}, found opcode {opcode}")
    stream = _Exact(body)
    try:
        parsed = _PARSERS[opcode].read(ReadDataStream(stream))
    except (
        McapError,
        struct.error,
        UnicodeDecodeError,
        EOFError,
        ValueError,
        MemoryError,
        OverflowError,
    ) as err:
        raise FormatError(
            f"{name}: the record with opcode {opcode} at offset {offset} is damaged: {err}"
        ) from err
    if stream.tell() != len(body):
        raise FormatError(
            f"{name}: the record with opcode {opcode} at offset {offset} has {len(body)} bytes, not {stream.tell()}"
        )
    if opcode in _STRINGS_BEFORE_MAP and not _map_fits(opcode, body):
        raise FormatError(
            f"{name}: the record with opcode {opcode} at offset {offset} is damaged: its map has another length"
        )
    return parsed


def _map_fits(opcode: int, body: memoryview) -> bool:
    """Whether the map that ends a record has the length it says: the package reads pairs beyond it."""
    at, strings = _STRINGS_BEFORE_MAP[opcode]
    for _ in range(strings):
        at += 4 + int.from_bytes(body[at : at + 4], "little")
    return int.from_bytes(body[at : at + 4], "little") == len(body) - at - 4


def read_attachment(source: Source, index: AttachmentIndex) -> bytes:
    """The data of an attachment, its CRC checked."""
    record = source.read(index.offset, index.length)
    fixed = 9 + 16 + 4 + len(index.name.encode()) + 4 + len(index.media_type.encode()) + 8
    data = record[fixed : fixed + index.data_size]
    if record[:1] != bytes([Opcode.ATTACHMENT]) or fixed + index.data_size + 4 != len(record):
        raise FormatError(f"{source.name}: expected the attachment {index.name!r} at offset {index.offset}")
    crc = int.from_bytes(record[-4:], "little")
    if crc32(memoryview(record)[9:-4]) != crc:
        raise FormatError(
            f"{source.name}: the attachment {index.name!r} at offset {index.offset} is damaged (its CRC differs)"
        )
    return data


def read_metadata(source: Source, index: MetadataIndex) -> dict[str, str]:
    """The values of a Metadata record."""
    record = source.read(index.offset, index.length)
    if len(record) < 9 or record[0] != Opcode.METADATA:
        raise FormatError(f"{source.name}: expected the metadata {index.name!r} at offset {index.offset}")
    metadata: Metadata = parse_record(Opcode.METADATA, memoryview(record)[9:], index.offset, source.name)
    return metadata.metadata


def foreign(source: Source, why: str) -> FormatError:
    """The error for an MCAP file that is no recording of ours."""
    return FormatError(
        f"{source.name} is an MCAP file, but no tupli_mcap recording ({why}); expected the profile {PROFILE!r} "
        f"({OTHER_TOOLS})"
    )
