"""Any other MCAP file written anew: its good chunks, messages, attachments and metadata, chunked and indexed."""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema
from mcap.writer import CompressionType, Writer

from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.recording.checked import message_index
from tupli_mcap.recording.container import PROFILE
from tupli_mcap.recording.contents import RECORDING_METADATA
from tupli_mcap.recording.source import Source
from tupli_mcap.recording.summary import parse_record
from tupli_mcap.recording.survey import Chunk, Damage, Found, KnownChunk, Survey
from tupli_mcap.recording.tail import Tail

__all__ = ["Copied", "copy_foreign"]

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time
_COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}


@dataclass
class Copied:
    """What was copied, and what was not: `lost` counts messages by topic, as far as indexes tell."""

    messages: int = 0
    attachments: int = 0
    damages: list[Damage] = field(default_factory=list)
    lost: dict[str, int] = field(default_factory=dict)
    attachments_lost: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class _Index(NamedTuple):
    offset: int
    channel: int
    messages: int


def copy_foreign(source: Source, tail: Tail, fd: int, compression: str) -> Copied:
    """Copies what is good to the file `fd`, record by record.

    Raises:
        RecordingError: the target cannot be written.
    """
    try:
        with os.fdopen(os.dup(fd), "wb") as file:
            copier = _Copier(source, tail, Writer(file, compression=_COMPRESSIONS[compression]))
            copier.run()
            return copier.copied
    except OSError as err:
        raise RecordingError(f"{source.name} cannot be copied: {err.strerror}; choose another place") from err


class _Copier:
    def __init__(self, source: Source, tail: Tail, writer: Writer) -> None:
        self._source = source
        self._tail = tail
        self._writer = writer
        self._started = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._new_schemas: dict[int, tuple[Schema, int]] = {}
        self._new_channels: dict[int, tuple[Channel, int]] = {}
        self._bad_chunk: Damage | None = None  # whose message indexes tell what was in it
        self._unknown: dict[int, int] = {}
        self._unchecked = 0  # messages
        self.copied = Copied()

    def run(self) -> None:
        summary = self._tail.summary
        known: dict[int, KnownChunk] = {}
        if summary is not None:
            self._schemas |= summary.schemas
            self._channels |= summary.channels
        survey = Survey(self._source, known=known, end=self._tail.data_end, messages=True)
        for found in survey:
            if isinstance(found, Damage):
                self._damaged(found)
            else:
                self._take(found)
        self._start("", "")
        for channel, count in self._unknown.items():
            self.copied.lost[f"channel {channel}"] = count
            self.copied.notes.append(f"{count} messages of channel {channel} are lost with its definition")
        if self._unchecked:
            why = f"{self._unchecked} messages have no CRC: damage within them is copied with them"
            self.copied.notes.append(why)
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _start(self, profile: str, library: str) -> None:
        if not self._started:
            self._writer.start(profile, library)
            self._started = True

    def _damaged(self, damage: Damage) -> None:
        self.copied.damages.append(damage)
        self._bad_chunk = damage if damage.opcode == Opcode.CHUNK else None
        if damage.opcode == Opcode.ATTACHMENT:
            self.copied.attachments_lost.append(f"at offset {damage.offset}")

    def _take(self, found: Found) -> None:
        if found.opcode != Opcode.MESSAGE_INDEX:
            self._bad_chunk = None
        if found.opcode == Opcode.HEADER:
            header = parse_record(found.opcode, found.body, found.offset, self._source.name)
            self._start("" if header.profile == PROFILE else header.profile, header.library)
            return
        self._start("", "")
        if found.chunk is not None:
            self._take_chunk(found, found.chunk)
        elif found.attachment is not None:
            self._take_attachment(found)
        elif found.opcode == Opcode.MESSAGE_INDEX:
            self._take_index(found)
        elif self._record(found.opcode, found.body, found.offset):
            self._unchecked += found.opcode == Opcode.MESSAGE

    def _take_index(self, found: Found) -> None:
        if self._bad_chunk is not None:
            channel, entries = message_index(found.body)
            topic = self._channels[channel].topic if channel in self._channels else f"channel {channel}"
            self.copied.lost[topic] = self.copied.lost.get(topic, 0) + len(entries)

    def _take_chunk(self, found: Found, chunk: Chunk) -> None:
        if found.repaired:
            self.copied.damages.append(Damage(found.offset, found.offset + 49, found.repaired, -1))
        before = self.copied.messages
        try:
            self._records(found, chunk.data)
        finally:
            self._unchecked += 0 if chunk.crc else self.copied.messages - before

    def _records(self, found: Found, data: memoryview) -> None:
        position = 0
        while position < len(data):
            opcode, length = (0, 0) if position + 9 > len(data) else _RECORD.unpack_from(data, position)
            end = position + 9 + length
            if (
                not opcode
                or end > len(data)
                or not self._record(opcode, data[position + 9 : end], found.offset)
            ):
                why = f"the chunk's records are damaged from byte {position} on"
                self._damaged(Damage(found.offset, found.offset + found.length, why, Opcode.CHUNK))
                return
            position = end

    def _record(self, opcode: int, body: memoryview, offset: int) -> bool:
        """Copies a record; False if it is damaged."""
        try:
            if opcode == Opcode.SCHEMA:
                schema: Schema = parse_record(opcode, body, offset, self._source.name)
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel: Channel = parse_record(opcode, body, offset, self._source.name)
                self._channels[channel.id] = channel
            elif opcode == Opcode.METADATA:
                metadata: Metadata = parse_record(opcode, body, offset, self._source.name)
                lost = ".lost" if metadata.name == RECORDING_METADATA else ""  # it is none of ours any more
                self._writer.add_metadata(metadata.name + lost, metadata.metadata)
            elif opcode == Opcode.MESSAGE:
                return self._message(body)
        except FormatError:
            return False
        return True

    def _message(self, body: memoryview) -> bool:
        if len(body) < _MESSAGE.size:
            return False
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
        new = self._channel(channel)
        if new is None:
            self._unknown[channel] = self._unknown.get(channel, 0) + 1
            return True
        self._writer.add_message(new, log_time, bytes(body[_MESSAGE.size :]), publish_time, sequence)
        self.copied.messages += 1
        return True

    def _channel(self, old: int) -> int | None:
        """The id in the new file of a channel; None if its definition is lost."""
        channel = self._channels.get(old)
        if channel is None:
            return None
        if old in self._new_channels and self._new_channels[old][0] == channel:
            return self._new_channels[old][1]
        schema = self._schemas.get(channel.schema_id)
        if schema is None and channel.schema_id:
            return None
        schema_id = 0 if schema is None else self._schema(schema)
        new: int = self._writer.register_channel(
            channel.topic, channel.message_encoding, schema_id, channel.metadata
        )
        self._new_channels[old] = (channel, new)
        return new

    def _schema(self, schema: Schema) -> int:
        if schema.id in self._new_schemas and self._new_schemas[schema.id][0] == schema:
            return self._new_schemas[schema.id][1]
        new: int = self._writer.register_schema(schema.name, schema.encoding, schema.data)
        self._new_schemas[schema.id] = (schema, new)
        return new

    def _take_attachment(self, found: Found) -> None:
        index = found.attachment
        if index is None:
            return
        data = self._source.read(found.offset + found.length - 4 - index.data_size, index.data_size)
        self._writer.add_attachment(index.create_time, index.log_time, index.name, index.media_type, data)
        self.copied.attachments += 1
