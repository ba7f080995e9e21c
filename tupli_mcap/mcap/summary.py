"""Reads the footer and the summary of a finished file."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    MetadataIndex,
    Schema,
)

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import MAGIC, PROFILE
from tupli_mcap.mcap.records import crc32, parse_record, records
from tupli_mcap.mcap.source import Source

FOOTER_SIZE = 9 + 20
OTHER_TOOLS = '"mcap doctor" checks other MCAP files, "mcap recover" saves what is good in them'
_FOOTER = struct.Struct("<BQQQI")
_MAX_SUMMARY = 1 << 31


class Summary(NamedTuple):
    """The parsed summary: it begins at offset `start` and lists `chunks` chunks."""

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
    """Keeps a definition; raises FormatError if there is another one of that number."""
    if found.setdefault(number, value) != value:
        raise FormatError(f"{name}: expected {what} once in the summary, found another one")


def foreign(source: Source, why: str) -> FormatError:
    """The error for an MCAP file that is no recording of ours."""
    return FormatError(
        f"{source.name} is an MCAP file, but no tupli_mcap recording ({why}); expected the profile {PROFILE!r} "
        f"({OTHER_TOOLS})"
    )
