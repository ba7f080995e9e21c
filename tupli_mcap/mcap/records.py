"""Parses and checks the records of MCAP files: every size in a file is a claim, every defect a FormatError."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream, RecordBuilder
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
from tupli_mcap.mcap.source import Source

try:
    from isal.isal_zlib import crc32 as _crc32
except ImportError:
    from zlib import crc32 as _crc32

MAGIC = b"\x89MCAP0\r\n"  # begins and ends a file
_PAGES = (b"<!doctyp", b"<html")
_GZIP = b"\x1f\x8b"
PROFILE = "tupli_mcap"
RECORD = struct.Struct("<BQ")  # start of every record: opcode, and the length of what follows
# RECORD, times of the first and the last message, uncompressed size, CRC, length of the compression's name; then the
# name, and the length of the compressed bytes (u64)
CHUNK_HEAD = struct.Struct("<BQQQQII")
ATTACHMENT_HEAD = struct.Struct("<BQQQI")  # RECORD, log_time, create_time, length of the name
MESSAGE_INDEX = struct.Struct("<BQHI")  # RECORD, channel, length of the entries
# RECORD, channel, sequence, log_time, publish_time; then the CDR header
RECORD_HEADER = struct.Struct("<BQHIQQ")
CDR_HEADER = b"\x00\x01\x00\x00"
HOLE = 0xFFFFFFFF  # the `sequence` of a row without a message, in a journal
BODY = RECORD_HEADER.size + len(CDR_HEADER)  # offset of the CDR body in a Message record
HEADER_FIELDS: list[tuple[str, str, int]] = [
    ("#opcode", "u1", 0),
    ("#length", "<u8", 1),
    ("#channel", "<u2", 9),
    ("#sequence", "<u4", 11),
    ("#log_time", "<u8", 15),
    ("#publish_time", "<u8", 23),
    ("#cdr", "<u4", 31),
]
FOOTER = struct.Struct("<BQQQI")  # RECORD, where the summary and the offsets in it begin, CRC
OTHER_TOOLS = (
    '"mcap doctor" checks other MCAP files, "mcap recover" saves what is good in them, and '
    "tupli_mcap.EpisodeWriter makes episodes of a robot's bag"
)
MAX_CHUNK = 1 << 31  # bytes, uncompressed
MAX_ROWS_A_BYTE = 16
"""Messages for each compressed byte of a chunk, at most: each message has another `sequence`, so no compressor gets far
below a byte for each."""

_MAX_SUMMARY = 1 << 31
_PIECE = 1 << 20
_MOST_TEXT = 1 << 17  # bytes of name and media type of an attachment
_KEY = "crc"
PARSERS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.METADATA_INDEX: MetadataIndex,
    Opcode.STATISTICS: Statistics,
    Opcode.METADATA: Metadata,
}
_SUMMARIZED = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)


def records(data: bytes | memoryview, base: int, name: str) -> Iterator[tuple[int, int, memoryview]]:
    """(opcode, file offset, body) of the records in `data`, which starts at file offset `base`."""
    view, position = memoryview(data), 0
    while position < len(view):
        if position + 9 > len(view):
            raise FormatError(
                f"{name}: expected a record at offset {base + position}, found {len(view) - position} bytes"
            )
        opcode, length = RECORD.unpack_from(view, position)
        start, end = position + 9, position + 9 + length
        if end > len(view):
            raise FormatError(
                f"{name}: the record at offset {base + position} claims {length} bytes, beyond its section"
            )
        yield opcode, base + position, view[start:end]
        position = end


def parse_record(opcode: int, body: memoryview, offset: int, name: str) -> Any:
    """A record parsed by the `mcap` package; every defect is a FormatError.

    The package reads texts and maps that are cut off, or longer than they say. So a record is good only if it is
    written again as it was.
    """
    if opcode not in PARSERS:
        raise FormatError(f"{name}: expected another record at offset {offset}, found opcode {opcode}")
    damaged = (
        f"{name}: the record with opcode {opcode} at offset {offset} is damaged: expected fields that fill its "
        f"{len(body)} bytes, found others"
    )
    try:
        parsed = PARSERS[opcode].read(ReadDataStream(io.BytesIO(body)))
        written = written_records(parsed)
    except (McapError, struct.error, ValueError, MemoryError, OverflowError) as err:
        raise FormatError(f"{damaged} ({err})") from err
    if memoryview(written)[RECORD.size :] != body:
        raise FormatError(damaged)
    return parsed


def written_records(*records: Any) -> bytes:
    """Records of the `mcap` package as a file has them."""
    builder = RecordBuilder()
    for each in records:
        each.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def read_metadata(source: Source, index: MetadataIndex) -> dict[str, str]:
    """The pairs of a Metadata record, with `crc`, which is not checked."""
    record = source.read(index.offset, index.length)
    if len(record) < 9 or record[0] != Opcode.METADATA:
        raise FormatError(f"{source.name}: expected the metadata {index.name!r} at offset {index.offset}")
    metadata: Metadata = parse_record(Opcode.METADATA, memoryview(record)[9:], index.offset, source.name)
    return metadata.metadata


def with_crc(values: Mapping[str, str]) -> dict[str, str]:
    """The pairs and, as the last one, `crc`: the CRC-32 of the others in 8 hexadecimal digits."""
    pairs = {key: value for key, value in values.items() if key != _KEY}
    return {**pairs, _KEY: _crc(pairs)}


def check_crc(values: Mapping[str, str], known: Collection[str], where: str) -> dict[str, str]:
    """The pairs without `crc`; FormatError if `crc` differs, or if it is missing, and there are other keys than the
    `known` ones: `crc` is optional in format 1, but a damaged key must not pass for a missing one."""
    pairs = {key: value for key, value in values.items() if key != _KEY}
    if _KEY not in values:
        # A damaged length may have put the key into a value. Such a value holds the zeros of the key's length.
        other = sorted(pairs.keys() - set(known)) or [key for key, value in pairs.items() if "\0" in value]
        if other:
            raise FormatError(
                f"{where}: expected a key 'crc' beside {other!r:.80}, found none; the file is damaged"
            )
    elif values[_KEY] != _crc(pairs):
        raise FormatError(f"{where} is damaged: expected crc {_crc(pairs)}, found {values[_KEY]!r:.20}")
    return pairs


def _crc(pairs: Mapping[str, str]) -> str:
    """CRC-32 of the pairs in the order of their keys, each text as MCAP stores it: its length (u32), its bytes."""
    texts = [text.encode() for pair in sorted(pairs.items()) for text in pair]
    return f"{zlib.crc32(b''.join(len(text).to_bytes(4, 'little') + text for text in texts)):08x}"


def message_index(body: memoryview) -> tuple[int, np.ndarray[Any, np.dtype[np.uint64]]]:
    """The channel and the entries (log_time, offset) of a MessageIndex record.

    FormatError if its sizes do not add up.
    """
    channel, size = int.from_bytes(body[:2], "little"), int.from_bytes(body[2:6], "little")
    if len(body) != 6 + size or size % 16:
        raise FormatError(f"expected a message index of {len(body) - 6} bytes, it says {size}")
    return channel, np.frombuffer(body[6:], "<u8").reshape(-1, 2)


def attachment_index(source: Source, offset: int, length: int) -> AttachmentIndex:
    """The header of an attachment whose body has `length` bytes.

    Sizes are read before texts: a search after damage then leaves most false starts after a few bytes.

    FormatError if the sizes in the header do not add up to `length`.
    """
    left = 9 + length - ATTACHMENT_HEAD.size - 4 - 8 - 4  # for the texts and the data
    if left < 0:
        raise FormatError("the attachment's header is damaged")
    head = source.read(offset, ATTACHMENT_HEAD.size)
    _, _, log_time, create_time, name_size = ATTACHMENT_HEAD.unpack(head)
    if name_size > min(left, _MOST_TEXT):
        raise FormatError("the attachment's sizes do not add up")
    at = offset + ATTACHMENT_HEAD.size + name_size
    type_size = int.from_bytes(source.read(at, 4), "little")
    if name_size + type_size > min(left, _MOST_TEXT):
        raise FormatError("the attachment's sizes do not add up")
    data_size = int.from_bytes(source.read(at + 4 + type_size, 8), "little")
    if name_size + type_size + data_size != left:
        raise FormatError("the attachment's sizes do not add up")
    try:
        name = bytes(source.read(at - name_size, name_size)).decode()
        media_type = bytes(source.read(at + 4, type_size)).decode()
    except UnicodeDecodeError as err:
        raise FormatError("the attachment's header is damaged") from err
    return AttachmentIndex(offset, 9 + length, log_time, create_time, data_size, name, media_type)


def checked_attachment(source: Source, offset: int, length: int) -> AttachmentIndex:
    """The header of the attachment at `offset`, whose body has `length` bytes; its CRC is checked in pieces.
    FormatError if it is damaged."""
    found = attachment_index(source, offset, length)
    crc, position, end = 0, offset + 9, offset + 9 + length - 4
    expected = int.from_bytes(source.read(end, 4), "little")
    while position < end:
        piece = source.read(position, min(_PIECE, end - position))
        crc = zlib.crc32(piece, crc)
        position += len(piece)
    if crc != expected:
        raise FormatError(f"the attachment {found.name!r:.80} is damaged (its CRC differs)")
    return found


def read_attachment(source: Source, index: AttachmentIndex) -> bytes:
    """The data of an attachment, its CRC checked. FormatError if it is damaged, or not where the index says."""
    record = source.read(index.offset, index.length)
    fixed = ATTACHMENT_HEAD.size + len(index.name.encode()) + 4 + len(index.media_type.encode()) + 8
    data = record[fixed : fixed + index.data_size]
    if record[:1] != bytes([Opcode.ATTACHMENT]) or fixed + index.data_size + 4 != len(record):
        raise FormatError(f"{source.name}: expected the attachment {index.name!r} at offset {index.offset}")
    crc = int.from_bytes(record[-4:], "little")
    if crc32(memoryview(record)[9:-4]) != crc:
        raise FormatError(
            f"{source.name}: the attachment {index.name!r} at offset {index.offset} is damaged (its CRC differs)"
        )
    return data


def iter_records(data: memoryview) -> Iterator[tuple[int, int, int, int, int]]:
    """(offset, end, channel, sequence, log_time) of the Message records in `data`; FormatError if there are
    bytes that are no whole Message record."""
    start = 0
    while start < len(data):
        if start + BODY > len(data):
            raise FormatError(f"expected a message record at byte {start}, found {len(data) - start} bytes")
        opcode, length, channel, sequence, log_time, _ = RECORD_HEADER.unpack_from(data, start)
        end = start + 9 + length
        if opcode != 5 or length < BODY - 9 or end > len(data):
            raise FormatError(
                f"expected a message record at byte {start}, found opcode {opcode} of {length} bytes"
            )
        yield start, end, channel, sequence, log_time
        start = end


# Every use of ISA-L must end with a loop of NumPy. ISA-L leaves the upper halves of vector registers dirty, which slows
# down whatever the thread does next on Intel processors, the environment included. NumPy's loops clear them.
_ZEROS = np.zeros(256)  # long enough for NumPy to use vector registers


def crc32(data: Any, value: int = 0, /) -> int:
    """The CRC-32 of `data` that follows bytes whose CRC-32 is `value`."""
    found: int = _crc32(data, value)
    np.add(_ZEROS, _ZEROS, out=_ZEROS)
    return found


def crc32_each(parts: Iterable[bytes]) -> list[int]:
    """The CRC-32 of each part."""
    found = list(map(_crc32, parts))
    np.add(_ZEROS, _ZEROS, out=_ZEROS)
    return found


# ---- the end of a finished file


class Summary(NamedTuple):
    """The parsed summary: it begins at offset `start` and lists `chunks` chunks."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    attachments: dict[str, AttachmentIndex]
    metadata: dict[str, MetadataIndex]
    chunks: int
    start: int


class ForeignError(FormatError):
    """A file that is no recording; its text ends in what to do, after a semicolon."""


def check_magic(source: Source) -> None:
    """Raises ForeignError unless the file starts as an MCAP file."""
    if source.size == 0:
        raise ForeignError(
            f"{source.name} is empty; expected an MCAP recording, so delete it or record again"
        )
    head = source.read(0, min(len(MAGIC), source.size))
    if head.startswith(_GZIP):
        raise ForeignError(
            f"{source.name}: expected an MCAP file, found one compressed with gzip; unpack it; if a web server "
            "compresses it (Content-Encoding), have it send the file as it is"
        )
    if head.lower().startswith(_PAGES):
        raise ForeignError(
            f"{source.name}: expected an MCAP file, found a web page; give the address of a recording itself, not of a "
            "list of files or a sign-in"
        )
    if head != MAGIC:
        raise ForeignError(
            f"{source.name}: expected an MCAP file, found {head!r} at its start; "
            "give a recording (.mcap), or see what tupli-mcap recover can save"
        )


def has_summary(source: Source) -> bool:
    """True if the file ends as a finished MCAP file does."""
    size = FOOTER.size + len(MAGIC)
    if source.size < len(MAGIC) + size:
        return False
    tail = source.read(source.size - size, size)
    return tail.startswith(RECORD.pack(Opcode.FOOTER, FOOTER.size - RECORD.size)) and tail.endswith(MAGIC)


def read_summary(source: Source) -> Summary:
    """Parses the summary section: definitions, and the places of attachments and metadata; chunk indexes are counted.
    FormatError if the footer, the summary's CRC or one of the parsed records is wrong."""
    end = source.size - len(MAGIC) - FOOTER.size
    footer = source.read(end, FOOTER.size)
    _, _, start, _, crc = FOOTER.unpack(footer)
    if not len(MAGIC) <= start <= end or end - start > _MAX_SUMMARY:
        raise FormatError(f"{source.name}: expected the summary before offset {end}, the footer says {start}")
    data = source.read(start, end - start)
    if crc32(footer[:-4], crc32(data)) != crc:
        why = "is damaged (its CRC differs)" if crc else "has no checksum"
        raise FormatError(f"{source.name}: the summary at offset {start} {why}")
    summary = Summary({}, {}, {}, {}, 0, start)
    chunks = 0
    topics: dict[str, int] = {}
    for opcode, position, body in records(data, start, source.name):
        parsed = parse_record(opcode, body, position, source.name) if opcode in _SUMMARIZED else None
        if isinstance(parsed, Schema):
            _once(summary.schemas, parsed.id, parsed, f"schema {parsed.id}", source.name)
        elif isinstance(parsed, Channel):
            _once(summary.channels, parsed.id, parsed, f"channel {parsed.id}", source.name)
            if topics.setdefault(parsed.topic, parsed.id) != parsed.id:
                raise FormatError(
                    f"{source.name}: expected each topic once, found {parsed.topic!r:.80} twice"
                )
        elif isinstance(parsed, AttachmentIndex):
            summary.attachments[parsed.name] = parsed
        elif isinstance(parsed, MetadataIndex):
            summary.metadata[parsed.name] = parsed
        elif opcode == Opcode.CHUNK_INDEX:
            chunks += 1
    return summary._replace(chunks=chunks)


def _once(found: dict[int, Any], number: int, value: Any, what: str, name: str) -> None:
    """Keeps a definition; raises FormatError if there is another one of that number."""
    if found.setdefault(number, value) != value:
        raise FormatError(f"{name}: expected {what} once in the summary, found another one")


def foreign(source: Source, why: str) -> ForeignError:
    """The error for an MCAP file that is no recording of ours."""
    return ForeignError(f"{source.name} is an MCAP file, but no tupli_mcap recording ({why}); {OTHER_TOOLS}")
