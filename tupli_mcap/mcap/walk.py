"""Walks over the records of a file and finds those that are whole, beyond damage too.

A chunk or an attachment is whole if its CRC is right, any other record if it parses to its last byte. After a damaged
record the walk goes on at the next offset where a record begins. A chunk with a damaged header is read with the sizes
and the CRC in the episode index. One record is in memory at a time, attachments in pieces.
"""

from __future__ import annotations

import bisect
import re
import zlib
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.chunks import MAX_RATIO, Chunk, ChunkClaim, decompress
from tupli_mcap.mcap.records import (
    CHUNK_HEAD,
    MAGIC,
    MAX_CHUNK,
    PARSERS,
    RECORD,
    attachment_index,
    checked_attachment,
    message_index,
    parse_record,
)
from tupli_mcap.mcap.source import Source

_PIECE = 1 << 20
_FIRST_PIECE = 1 << 12
_PARSING = 16  # cost of parsing a byte, in CRC checks of a byte
_SUMMARY = (Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX)
_END = (Opcode.DATA_END, Opcode.FOOTER, Opcode.SUMMARY_OFFSET, *_SUMMARY)
# of bodies of constant size
_SIZES: dict[int, int] = {Opcode.DATA_END: 4, Opcode.FOOTER: 20, Opcode.SUMMARY_OFFSET: 17}
_LEAST: dict[int, int] = {
    Opcode.HEADER: 8, Opcode.SCHEMA: 14, Opcode.CHANNEL: 16, Opcode.MESSAGE: 22, Opcode.CHUNK: 40,
    Opcode.MESSAGE_INDEX: 6, Opcode.CHUNK_INDEX: 64, Opcode.ATTACHMENT: 36, Opcode.STATISTICS: 46,
    Opcode.ATTACHMENT_INDEX: 48, Opcode.METADATA: 8, Opcode.METADATA_INDEX: 20, **_SIZES,
}  # fmt: skip
# Start of a record: its opcode, and a length below 2^40. It is a lookahead, so that matches may overlap.
_CANDIDATE = re.compile(rb"(?=[\x01-\x0f].{5}\x00\x00\x00)", re.DOTALL)


class Found(NamedTuple):
    """A whole record: `length` counts its first 9 bytes too; `body` is empty for a chunk and an attachment.

    `parsed` is the record of the `mcap` package, if its opcode is one of PARSERS; `repaired` says what is wrong in the
    header of a chunk whose records are good.
    """

    opcode: int
    offset: int
    length: int
    body: memoryview
    parsed: Any = None
    chunk: Chunk | None = None
    attachment: AttachmentIndex | None = None
    repaired: str = ""


class Damage(NamedTuple):
    """Bytes `offset:end` that are no whole record; `opcode` is their first byte."""

    offset: int
    end: int
    why: str
    opcode: int


class Walk:
    """Iterating gives every record of the data section, DataEnd included, and every damage, in the file's order.

    Args:
        known: the chunks in an index, by offset.
        end: the offset where the data section ends; None if it is not known.
        need_crc: whether a chunk without a CRC, as other programs write it, is damaged.
    """

    def __init__(
        self,
        source: Source,
        *,
        known: Mapping[int, ChunkClaim] | None = None,
        end: int | None = None,
        need_crc: bool = True,
    ) -> None:
        self._source, self._need_crc = source, need_crc
        self._end = source.size if end is None else min(end, source.size)
        # a file that was cut off may have an index of more
        self._known = {offset: claim for offset, claim in (known or {}).items() if offset < self._end}
        self._known_offsets = sorted(self._known)
        # bytes of CRC checks for false starts while looking for a record
        self._budget = 4 * source.size + (64 << 20)

    def __iter__(self) -> Iterator[Found | Damage]:
        position = len(MAGIC)
        while position < self._end:
            found = self.at(position)
            if isinstance(found, Found):
                if found.opcode in _END and found.opcode != Opcode.DATA_END:
                    return
                yield found
                if found.opcode == Opcode.DATA_END:
                    return
                position = found.offset + found.length
                continue
            following = self._following(position)
            opcode = self._source.read(position, 1)[0]
            yield Damage(position, following, found, opcode)
            position = following

    def places(self, position: int = len(MAGIC)) -> Iterator[tuple[int, int, int]]:
        """(opcode, offset, length) of records, unchecked: from an offset up to the first that is cut off."""
        while position + RECORD.size <= self._end:
            opcode, length = RECORD.unpack(self._source.read(position, RECORD.size))
            if length > self._end - position - RECORD.size:
                return
            yield opcode, position, RECORD.size + length
            position += RECORD.size + length

    # ---- one record

    def at(self, position: int, *, searching: bool = False) -> Found | str:
        """The record at an offset, or why there is none; with `searching` another record must follow it."""
        left = self._end - position - RECORD.size
        if left < 0:
            return f"expected a record, found {left + RECORD.size} bytes"
        opcode, length = RECORD.unpack(self._source.read(position, RECORD.size))
        if opcode == Opcode.CHUNK or position in self._known:
            return self._chunk(position)
        if length > left:
            why = f"the record with opcode {opcode} claims {length} bytes, but {left} are left"
        elif opcode == Opcode.ATTACHMENT:
            return self._attachment(position, length)
        elif searching and opcode != Opcode.FOOTER and not self._stands_at(position + 9 + length):
            why = "no record follows it"
        elif isinstance(checked := self._other(opcode, position, length), Found):
            return checked
        else:
            why = checked
        hidden = self._chunk(position)  # it may be a chunk whose opcode or length is damaged
        return hidden if isinstance(hidden, Found) else why

    def _other(self, opcode: int, position: int, length: int) -> Found | str:
        if opcode == Opcode.MESSAGE:
            return "a message is outside of chunks"
        if opcode in _LEAST:
            if length < _LEAST[opcode] or length != _SIZES.get(opcode, length):
                return f"the record with opcode {opcode} claims {length} bytes"
        elif opcode < 0x80 or not self._stands_at(position + 9 + length):
            return f"expected a record, found opcode {opcode}"
        if self._budget < 0:
            return "too much damage: the limit of bytes to search for records is reached"
        body, parsed = memoryview(self._source.read(position + 9, length)), None
        try:
            if opcode in PARSERS:
                parsed = parse_record(opcode, body, position, self._source.name)
            elif opcode == Opcode.MESSAGE_INDEX:
                message_index(body)
        except FormatError as err:
            self._budget -= _PARSING * length
            return str(err).removeprefix(f"{self._source.name}: ")
        return Found(opcode, position, 9 + length, body, parsed)

    def _attachment(self, position: int, length: int) -> Found | str:
        try:
            index = checked_attachment(self._source, position, length)
        except FormatError as err:
            self._budget -= length
            return str(err)
        return Found(Opcode.ATTACHMENT, position, 9 + length, memoryview(b""), attachment=index)

    def _chunk(self, position: int) -> Found | str:
        """The chunk at an offset, read as the index describes it, else as its own header does."""
        if position + CHUNK_HEAD.size + 8 > self._end:
            return "a chunk is cut off"
        head = self._source.read(position, CHUNK_HEAD.size)
        _, _, start, end, *_ = CHUNK_HEAD.unpack(head)
        why = "the chunk's header is damaged"
        for claim, repaired in self._claims(position, head):
            data = self.unpack(position, claim)
            if not isinstance(data, str):
                chunk = Chunk(start, end, claim, memoryview(data))
                return Found(
                    Opcode.CHUNK, position, claim.length, memoryview(b""), chunk=chunk, repaired=repaired
                )
            why = data
        return why

    def _claims(self, position: int, head: bytes) -> Iterator[tuple[ChunkClaim, str]]:
        """Descriptions of a chunk to try, each with what is wrong in its header if the description is right."""
        opcode, claimed, _, _, size, crc, name_size = CHUNK_HEAD.unpack(head)
        known = self._known.get(position)
        if known is not None:
            known = known._replace(crc=known.crc or crc)
            name = known.compression.encode()
            right = Opcode.CHUNK, known.length - 9, known.size, known.crc, len(name)
            behind = self._source.read(
                position + len(head), min(len(name) + 8, self._end - position - len(head))
            )
            whole = (opcode, claimed, size, crc, name_size) == right
            whole = whole and behind == name + known.packed.to_bytes(8, "little")
            yield known, "" if whole else "its header is damaged"
        if name_size > 4:
            return
        tail = self._source.read(position + len(head), min(name_size + 8, self._end - position - len(head)))
        compression = bytes(tail[:name_size]).decode(errors="replace")
        if len(tail) < name_size + 8 or compression not in ("", "zstd", "lz4"):
            return
        told = len(head) + name_size + 8 + int.from_bytes(tail[name_size:], "little")
        for length in dict.fromkeys((told, claimed + 9)):
            claim = ChunkClaim(length, size, compression, crc)
            agreed = length == told == claimed + 9 and opcode == Opcode.CHUNK
            fits = claim.packed >= 0 and position + length <= self._end
            if agreed or not fits or self._stands_at(position + length):
                yield claim, "" if agreed else "its opcode or length is damaged"

    def unpack(self, position: int, claim: ChunkClaim) -> Any:
        """The records of a chunk, or why they are damaged."""
        size, packed = claim.size, claim.packed
        start, left = position + claim.length - packed, self._end - position - claim.length + packed
        if not 0 <= packed <= left:
            return f"the chunk claims {packed} bytes, but {left} are left"
        if size > MAX_CHUNK or size > MAX_RATIO.get(claim.compression, 0) * packed or self._budget < 0:
            return f"the chunk claims {size} bytes in {packed}"
        try:
            data = decompress(
                claim.compression, memoryview(self._source.read(start, packed)), size, "the chunk"
            )
        except FormatError as err:
            self._budget -= packed
            return str(err)
        if (claim.crc or self._need_crc) and zlib.crc32(data) != claim.crc:
            self._budget -= packed + size
            return "the chunk's CRC differs"
        return data

    def _adds_up(self, position: int) -> bool:
        """Whether the sizes in the header of a chunk or an attachment make up its length."""
        opcode, length = RECORD.unpack(self._source.read(position, 9))
        if opcode == Opcode.CHUNK:
            *_, crc, size = CHUNK_HEAD.unpack(self._source.read(position, CHUNK_HEAD.size))
            packed = 9 + length - CHUNK_HEAD.size - size - 8
            if size > 4 or packed < 0 or not crc:
                return False
            rest = self._source.read(position + CHUNK_HEAD.size, size + 8)
            return rest[:size] in (b"", b"zstd", b"lz4") and int.from_bytes(rest[size:], "little") == packed
        if opcode != Opcode.ATTACHMENT:
            return False
        try:
            attachment_index(self._source, position, length)
        except FormatError:
            return False
        return True

    # ---- going on after damage

    def _stands_at(self, position: int) -> bool:
        """Whether the bytes at an offset may be the start of a record."""
        if position >= self._end:
            return position == self._end
        if position + 9 > self._end:
            return False
        if position in self._known:
            return True
        opcode, length = RECORD.unpack(self._source.read(position, 9))
        least = _LEAST.get(opcode)
        fits = least is not None and least <= length <= self._end - position - 9
        return fits and length == _SIZES.get(opcode, length)

    def _following(self, position: int) -> int:
        """The offset where the walk continues after a damaged record."""
        if position + 9 <= self._end:
            claimed = position + 9 + int.from_bytes(self._source.read(position + 1, 8), "little")
            if position in self._known:
                claimed = position + self._known[position].length
            if position < claimed < self._end and self._stands_at(claimed):  # an index may claim 0 bytes
                return claimed
        return self._search(position + 1)

    def _search(self, position: int) -> int:
        """The next offset with a record that can be checked."""
        at = bisect.bisect_left(self._known_offsets, position)
        limit = self._known_offsets[at] if at < len(self._known_offsets) else self._end
        piece = _FIRST_PIECE
        while position < limit and self._budget >= 0:
            window = self._source.read(position, min(piece + 8, self._end - position))
            for match in _CANDIDATE.finditer(window):
                candidate = position + match.start()
                if candidate >= min(limit, position + piece) or self._budget < 0:
                    break
                # if the sizes add up it is a chunk or an attachment, whether good or damaged
                if self._stands_at(candidate) and (
                    self._adds_up(candidate) or isinstance(self.at(candidate, searching=True), Found)
                ):
                    return candidate
            position += piece
            piece = min(2 * piece, _PIECE)  # small at first: the next record is often near
        return limit


def attachment_name(source: Source, damage: Damage) -> str | None:
    """The name of a damaged attachment; None if its header cannot be read."""
    if damage.opcode != Opcode.ATTACHMENT:
        return None
    try:
        return attachment_index(source, damage.offset, damage.end - damage.offset - 9).name
    except FormatError:
        return None
