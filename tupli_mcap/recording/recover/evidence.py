"""Everything good in a damaged recording: rows by channel and row number, wherever they lie, file or journal."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, overload

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Metadata, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.committed import FinalHole
from tupli_mcap.mcap.chunk_records import ChunkRecords, chunk_records, message_headers
from tupli_mcap.mcap.container import CHUNK_ROWS, MAGIC, PROFILE
from tupli_mcap.mcap.records import BODY, check_crc, message_index, parse_record
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.walk import Chunk, ChunkClaim, Damage, Found, Walk
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore, Span
from tupli_mcap.recording.contents import (
    CHANNEL_KEYS,
    RECORDING_KEYS,
    RECORDING_METADATA,
    check_version,
    is_ours,
)
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recover.file_end import Tail

__all__ = ["Gathered", "Piece", "Pieces", "gather", "is_recording", "may_be_recording"]

_CACHE = 64 << 20
_HEADERS = 16  # chunks whose headers are kept: a message at a time is taken from them
_HEAD = 4096  # the recording's metadata record begins within so many bytes


class Piece(NamedTuple):
    """`rows` consecutive rows of a channel from `first` on; `size` bytes, in the place `number` of what is loaded."""

    first: int
    rows: int
    size: int
    number: int

    @property
    def stop(self) -> int:
        return self.first + self.rows


class _Place(NamedTuple):
    """Where a chunk's messages are."""

    offset: int
    length: int
    chunk: Chunk  # without its data
    size: int
    skip: int
    repaired: str  # what is wrong in its header


class Pieces(Sequence[bytes]):
    """The rows of pieces, loaded when asked for."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._walk = Walk(source)
        self._places: list[_Place | bytes] = []

    def add(self, place: _Place | bytes) -> int:
        self._places.append(place)
        return len(self._places) - 1

    def place(self, piece: Piece) -> _Place:
        """Where the chunk is that a piece was in."""
        place = self._places[piece.number]
        if isinstance(place, bytes):
            raise TypeError("the piece is not of a chunk")
        return place

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, i: int) -> bytes: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[bytes]: ...
    def __getitem__(self, i: int | slice) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(len(self))[i]]
        place = self._places[i]
        if isinstance(place, bytes):
            return place
        claim = ChunkClaim(place.length, place.size, place.chunk.compression, place.chunk.crc)
        data = self._walk.unpack(place.offset, claim)
        if isinstance(data, str):
            raise FormatError(f"{self._source.name}: chunk at offset {place.offset}: {data}")
        return memoryview(data)[place.skip :]


@dataclass
class Gathered:
    """`pieces` of a channel are in order and do not overlap; `damages` are in the order of the file.

    `metadata` is None where the recording's is lost. `states` are those of the running steps, by sub-environment;
    `finals` what follows the last steps of episodes, by sub-environment and the row after.
    `at_journal`: where each channel's rows from the journal begin.
    """

    source: Source
    tail: Tail
    loaded: Pieces
    profile: str = ""
    metadata: dict[str, str] | None = None
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, AttachmentIndex] = field(default_factory=dict)
    pieces: dict[int, list[Piece]] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    states: dict[int, bytes] = field(default_factory=dict)
    finals: dict[tuple[int, int], FinalHole] = field(default_factory=dict)
    final_lost: bool = (
        False  # after a power loss: a state may be the one after a final state that is not here
    )
    journal: str = "none"
    notes: list[str] = field(default_factory=list)
    awaited: ChunkRecords | None = None  # the last chunk's, whose message index comes next

    def add(self, channel: int, pieces: Iterable[Piece]) -> list[Piece]:
        """Takes rows, and returns the pieces that are not taken: one that begins earlier holds a row of theirs.

        Where two begin with the same row, the one that was loaded first is taken.
        """
        kept, left = [], []
        stop = 0
        for piece in sorted([*self.pieces.get(channel, []), *pieces], key=lambda p: (p.first, p.number)):
            if piece.first < stop:
                left.append(piece)
            else:
                kept.append(piece)
                stop = piece.stop
        if kept:
            self.pieces[channel] = kept
        return left

    def lacks(self, channel: int, rows: Array) -> Array:
        """Which of some row numbers (int64) are not here, as a mask."""
        ranges = np.array([(-1, -1), *self.ranges(channel)], np.int64)
        stops: Array = ranges[np.searchsorted(ranges[:, 0], rows, side="right") - 1, 1]
        return rows >= stops

    def store(self) -> PackedStore:
        """The rows, numbered without gaps."""
        return PackedStore(self)

    def ranges(self, channel: int) -> list[tuple[int, int]]:
        """The rows of a channel that are here, as half-open ranges."""
        found: list[tuple[int, int]] = []
        for piece in self.pieces.get(channel, []):
            if found and found[-1][1] == piece.first:
                found[-1] = (found[-1][0], piece.stop)
            else:
                found.append((piece.first, piece.stop))
        return found


class PackedStore(ChunkStore):
    """The rows that are here, as a store without gaps; `packed` says which of its rows a row is."""

    def __init__(self, gathered: Gathered) -> None:
        table: list[tuple[int, ...]] = []
        self._firsts: dict[int, tuple[list[int], list[int]]] = {}
        for channel, pieces in gathered.pieces.items():
            counts = np.cumsum([0, *(piece.rows for piece in pieces)]).tolist()
            self._firsts[channel] = ([piece.first for piece in pieces], counts[:-1])
            table += [
                (IN_MEMORY + piece.number, 0, piece.size, first, piece.rows, 0, 0, channel, 0, 0)
                for piece, first in zip(pieces, counts[:-1], strict=True)
            ]
        rows = np.array(table, CHUNK_ROWS)
        super().__init__(gathered.source, rows, gathered.loaded, _CACHE)
        self._headers: dict[int, np.ndarray[Any, Any]] = {}  # of the chunks that were last asked for

    def packed(self, channel: int, row: int) -> int:
        """The number here of a row that is here."""
        firsts, counts = self._firsts[channel]
        at = bisect.bisect_right(firsts, row) - 1
        return counts[at] + row - firsts[at]

    def messages_of(self, span: Span) -> Iterator[tuple[int, memoryview]]:
        """(log_time, body) of the messages of a span."""
        data = memoryview(self.load(span.chunk))
        headers = self._headers.get(span.chunk)
        if headers is None:
            while len(self._headers) >= _HEADERS:
                del self._headers[next(iter(self._headers))]
            headers = self._headers[span.chunk] = message_headers(data)
        for header in headers[span.begin : span.end]:
            start = int(header["#offset"])
            yield int(header["#log_time"]), data[start + BODY : start + 9 + int(header["#length"])]


def gather(source: Source, tail: Tail) -> Gathered:
    """Reads the whole file once, its journal not yet; raises nothing for what is damaged.

    Raises:
        NewerVersionError: the recording's format is not known.
    """
    gathered = Gathered(source, tail, Pieces(source))
    if tail.summary is not None:
        gathered.schemas |= tail.summary.schemas
        gathered.channels |= tail.summary.channels
    pieces: dict[int, list[Piece]] = {}
    for found in Walk(source, known=tail.known_chunks(), end=tail.data_end):
        if isinstance(found, Damage):
            gathered.damages.append(found)
        elif found.chunk is not None:
            _take_chunk(gathered, found, found.chunk, pieces)
        else:
            _take(gathered, found)
    for channel, mine in pieces.items():
        _take_rows(gathered, channel, mine)
    gathered.damages.sort(key=lambda damage: damage.offset)
    return gathered


def _take(gathered: Gathered, found: Found) -> None:
    """Takes a record that is no chunk."""
    name = gathered.source.name
    awaited, gathered.awaited = gathered.awaited, None
    if found.opcode == Opcode.MESSAGE_INDEX and awaited is not None:
        number, entries = message_index(found.body)
        if number != awaited.channel or not np.array_equal(entries, awaited.index_entries()):
            end = found.offset + found.length
            why = "the message index says other than its chunk holds"
            gathered.damages.append(Damage(found.offset, end, why, Opcode.MESSAGE_INDEX))
    if found.attachment is not None:
        if found.attachment.name != INDEX_NAME:
            gathered.attachments[found.attachment.name] = found.attachment
    elif found.opcode == Opcode.HEADER:
        gathered.profile = parse_record(found.opcode, found.body, found.offset, name).profile
    elif found.opcode == Opcode.METADATA:
        record: Metadata = parse_record(found.opcode, found.body, found.offset, name)
        if record.name == RECORDING_METADATA and gathered.metadata is None:
            _take_metadata(gathered, record.metadata, found)
    elif found.opcode == Opcode.SCHEMA:
        schema: Schema = parse_record(found.opcode, found.body, found.offset, name)
        gathered.schemas.setdefault(schema.id, schema)
    elif found.opcode == Opcode.CHANNEL:
        channel: Channel = parse_record(found.opcode, found.body, found.offset, name)
        if _is_whole(gathered, channel, found):
            gathered.channels.setdefault(channel.id, channel)


def _take_metadata(gathered: Gathered, values: dict[str, str], found: Found) -> None:
    try:
        gathered.metadata = check_crc(values, RECORDING_KEYS, "the recording's metadata")
    except FormatError as err:
        end = found.offset + found.length
        gathered.damages.append(Damage(found.offset, end, str(err), Opcode.METADATA))
    else:
        check_version(gathered.metadata, gathered.source.name)


def _is_whole(gathered: Gathered, channel: Channel, found: Found) -> bool:
    """Whether a channel's metadata have the checksum they say."""
    try:
        if is_ours(channel.topic):
            check_crc(channel.metadata, CHANNEL_KEYS, f"the metadata of channel {channel.topic!r:.80}")
    except FormatError as err:
        end = found.offset + found.length
        gathered.damages.append(Damage(found.offset, end, str(err), Opcode.CHANNEL))
        return False
    return True


def _take_chunk(gathered: Gathered, found: Found, chunk: Chunk, pieces: dict[int, list[Piece]]) -> None:
    """Adds a chunk to the `pieces` of its channel."""
    gathered.awaited = None
    try:
        records = chunk_records(chunk.data, "the chunk", chunk.packed)
        if not chunk.crc:
            raise FormatError("the chunk has no CRC")
    except FormatError as err:
        end = found.offset + found.length
        gathered.damages.append(Damage(found.offset, end, str(err), Opcode.CHUNK))
        return
    if gathered.tail.summary is None:  # these have a CRC, those outside of chunks have none
        gathered.schemas |= {schema.id: schema for schema in records.schemas}
        gathered.channels |= {channel.id: channel for channel in records.channels}
    gathered.awaited = records
    size = len(chunk.data)
    empty = chunk._replace(data=memoryview(b""))
    place = _Place(found.offset, found.length, empty, size, records.skip, found.repaired)
    number = gathered.loaded.add(place)
    piece = Piece(records.first, len(records.headers), size - records.skip, number)
    pieces.setdefault(records.channel, []).append(piece)


def _take_rows(gathered: Gathered, channel: int, pieces: list[Piece]) -> None:
    """Takes the chunks of a channel, in whatever order they lie in the file."""
    left = set(gathered.add(channel, pieces))
    for piece in pieces:
        place = gathered.loaded.place(piece)
        if piece in left:
            why = "the chunk holds rows that another one holds"
            gathered.damages.append(Damage(place.offset, place.offset + place.length, why, Opcode.CHUNK))
        elif place.repaired:
            gathered.damages.append(Damage(place.offset, place.offset + 49, place.repaired, -1))


def may_be_recording(source: Source, tail: Tail) -> bool:
    """Whether the file is worth to be looked at as one of ours: False if it says that it is something else."""
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


def is_recording(gathered: Gathered) -> bool:
    """Whether the file is one of ours, as far as it can be told."""
    known = gathered.profile == PROFILE or gathered.metadata is not None or gathered.tail.index is not None
    return known or any("observation_space" in channel.metadata for channel in gathered.channels.values())
