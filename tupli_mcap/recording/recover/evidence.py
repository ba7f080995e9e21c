"""The good parts of a recording, in its file and its journal: rows by channel and row number.

`prefix` reads a file up to its first damage, as every reader of an unfinished recording does.
"""

from __future__ import annotations

import bisect
import contextlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Metadata, MetadataIndex, Schema, Statistics

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.committed import FinalHole
from tupli_mcap.mcap.chunks import Chunk, ChunkClaim, chunk_records, definitions_first
from tupli_mcap.mcap.container import CHUNK_ROWS, IN_CHUNKS, Rows
from tupli_mcap.mcap.records import MAGIC, PROFILE, Summary, foreign
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.walk import Damage, Found, Walk
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore
from tupli_mcap.recording.contents import RECORDING_METADATA, check_metadata, step_channels
from tupli_mcap.recording.index import INDEX_NAME, EpisodeIndex

T = TypeVar("T")
_CACHE = 64 << 20


@dataclass
class FileEnd:
    """The end of a file: `summary` and `index` are None if missing or damaged, and `why` has a sentence for each that
    is damaged.

    `finished` says that there is a footer or an index; `statistics` are those of the summary, if it has some.
    """

    finished: bool = False
    summary: Summary | None = None
    index: EpisodeIndex | None = None
    statistics: Statistics | None = None
    why: list[str] = field(default_factory=list)

    @property
    def data_end(self) -> int | None:
        return None if self.summary is None else self.summary.start

    def known_chunks(self) -> dict[int, ChunkClaim]:
        """The chunks in the index, by offset."""
        if self.index is None:
            return {}
        return {
            int(row["offset"]): ChunkClaim(
                int(row["length"]), int(row["uncompressed"]), IN_CHUNKS[row["compression"]], int(row["crc"])
            )
            for row in self.index.chunks
            if row["compression"] < len(IN_CHUNKS)
        }


class Piece(NamedTuple):
    """`rows` consecutive rows of a channel from `first` on; `entry` (CHUNK_ROWS) is their chunk or place in memory."""

    first: int
    rows: int
    entry: tuple[int, ...]

    @property
    def stop(self) -> int:
        return self.first + self.rows


class UnindexedRows(NamedTuple):
    """The rows of a channel in a chunk that the index cannot describe: it has a damaged header, no CRC, or rows of
    several channels.

    Attributes:
        claim: the right content of the header.
        spans: where they are in the chunk, see `ChunkRecords`.
        defined: the chunk has definitions, which `definitions_first` puts first.
    """

    offset: int
    claim: ChunkClaim
    spans: Array
    defined: bool


class _Loaded:
    """Rows that are in no good chunk: of the journal, or parts of chunks, which are read on access."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._walk = Walk(source, need_crc=False)  # its chunks were checked
        self.places: list[Rows | UnindexedRows] = []

    def __getitem__(self, i: int) -> Any:
        place = self.places[i]
        if isinstance(place, Rows):
            return place.data
        data = self._walk.unpack(place.offset, place.claim)
        if isinstance(data, str):
            raise FormatError(f"{self._source.name}: chunk at offset {place.offset}: {data}")
        data = memoryview(data)
        if place.defined:
            data = definitions_first(data, place.claim.packed)
        return memoryview(b"".join([data[begin:end] for begin, end in place.spans.tolist()]))


def memory_entry(number: int, channel: int, first: int, rows: int, size: int) -> tuple[int, ...]:
    """A row of CHUNK_ROWS for rows in memory: the `number`-th there, of `size` bytes."""
    return IN_MEMORY + number, 0, size, first, rows, 0, 0, channel, 0, 0


@dataclass
class Evidence:
    """Everything that was found of a recording.

    Attributes:
        strict: it holds only what a reader takes: the file up to its first damage, and rows of the journal that
            continue it without a gap. Repair also takes what lies beyond damage and gaps.
        good_end: offset where the undamaged start of the file ends.
        metadata: of the recording; None if they are lost.
        metadata_indexes: the places of the metadata records of other programs; with `strict`, of all.
        pieces: by channel, in the order of rows, without overlap.
        damages: in the order of the file.
        states: the running states, by sub-environment.
        finals: final holes, by sub-environment and the row after the episode's last one.
        final_lost: after a power loss, a running state may belong to the episode after a lost final state.
        left_out: number of steps in the journal that may be torn, by channel.
        beyond: number of steps in the journal that come after missing ones, by channel.
        journal: "none", "used", "missing", "damaged" or "stale".
        notes: sentences for people.
    """

    source: Source
    file_end: FileEnd
    strict: bool = False
    good_end: int = 0
    profile: str = ""
    metadata: dict[str, str] | None = None
    metadata_indexes: list[MetadataIndex] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, AttachmentIndex] = field(default_factory=dict)
    pieces: dict[int, list[Piece]] = field(default_factory=dict)
    damages: list[Damage] = field(default_factory=list)
    states: dict[int, bytes] = field(default_factory=dict)
    finals: dict[tuple[int, int], FinalHole] = field(default_factory=dict)
    final_lost: bool = False
    left_out: dict[int, int] = field(default_factory=dict)
    beyond: dict[int, int] = field(default_factory=dict)
    journal: str = "none"
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.loaded = _Loaded(self.source)

    def add(self, channel: int, pieces: Iterable[Piece]) -> list[Piece]:
        """Takes pieces; returns those that it leaves out because a piece that begins earlier has one of their rows.

        Of two pieces that begin with the same row it takes the one earlier in the file; the file comes before memory.
        """
        kept, left = [], []
        stop = 0
        for piece in sorted([*self.pieces.get(channel, []), *pieces], key=lambda p: (p.first, p.entry)):
            if piece.first < stop:
                left.append(piece)
            else:
                kept.append(piece)
                stop = piece.stop
        if kept:
            self.pieces[channel] = kept
        return left

    def add_rows(self, channel: int, batches: Iterable[Rows]) -> None:
        """Takes rows that are in memory."""
        self.add(
            channel,
            [self.load(rows, channel, rows.first, len(rows.offsets), len(rows.data)) for rows in batches],
        )

    def load(self, place: Rows | UnindexedRows, channel: int, first: int, rows: int, size: int) -> Piece:
        """A piece of rows that are in no good chunk, of `size` bytes, for `add`."""
        entry = memory_entry(len(self.loaded.places), channel, first, rows, size)
        self.loaded.places.append(place)
        return Piece(first, rows, entry)

    def lacks(self, channel: int, rows: Array) -> Array:
        """A mask of the row numbers (int64) that are missing."""
        ranges = np.array([(-1, -1), *self.ranges(channel)], np.int64)
        stops: Array = ranges[np.searchsorted(ranges[:, 0], rows, side="right") - 1, 1]
        return rows >= stops

    def stop(self, channel: int) -> int:
        """The row after the last one."""
        pieces = self.pieces.get(channel)
        return pieces[-1].stop if pieces else 0

    def ranges(self, channel: int) -> list[tuple[int, int]]:
        """The rows of a channel, as half-open ranges."""
        ranges: list[tuple[int, int]] = []
        for piece in self.pieces.get(channel, []):
            if ranges and ranges[-1][1] == piece.first:
                ranges[-1] = (ranges[-1][0], piece.stop)
            else:
                ranges.append((piece.first, piece.stop))
        return ranges


class RecordedChannels(NamedTuple):
    """Ids of channels: `steps` by sub-environment, `images` by leaf, then sub-environment; None if not known."""

    steps: list[int]
    images: dict[str, list[int | None]]
    start: int | None
    end: int | None
    final: int | None
    info: int | None

    @classmethod
    def of(cls, evidence: Evidence, layout: StepLayout) -> RecordedChannels:
        """The channels of a recording, by their topics."""
        steps = step_channels(evidence.channels, evidence.source.name)
        topics = {channel.topic: channel.id for channel in evidence.channels.values()}
        images = {
            leaf.name: [topics.get(Topics.of_step(channel.topic).image(leaf.name)) for channel in steps]
            for leaf in layout.images
        }
        names = (EPISODE_START, EPISODE_END, FINAL_STATE, INFO)
        return cls([channel.id for channel in steps], images, *(topics.get(name) for name in names))


class PackedStore(ChunkStore):
    """The rows that were found, numbered without gaps; `packed` gives the new number of a row."""

    def __init__(self, evidence: Evidence) -> None:
        table: list[tuple[int, ...]] = []
        self._firsts: dict[int, tuple[list[int], list[int]]] = {}
        for channel, pieces in evidence.pieces.items():
            counts = np.cumsum([0, *(piece.rows for piece in pieces)]).tolist()
            self._firsts[channel] = ([piece.first for piece in pieces], counts[:-1])
            table += [
                (*piece.entry[:3], first, *piece.entry[4:])
                for piece, first in zip(pieces, counts[:-1], strict=True)
            ]
        super().__init__(evidence.source, np.array(table, CHUNK_ROWS), evidence.loaded, _CACHE)

    def packed(self, channel: int, row: int) -> int:
        """The number that a found row has in this store."""
        firsts, counts = self._firsts[channel]
        at = bisect.bisect_right(firsts, row) - 1
        return counts[at] + row - firsts[at]

    def message(self, channel: int, row: int) -> bytes:
        """The body of one message."""
        ((_, body),) = self.messages(channel, row, 1)
        return bytes(body)


def decoded(
    store: PackedStore, channel: int | None, decode: Callable[[memoryview], T], *, strict: bool
) -> Iterator[tuple[int, int, T]]:
    """(row, log_time, message) of a channel, without those that cannot be decoded; FormatError for one if `strict`."""
    for row, time_ns, body in store.all_messages(channel):
        try:
            message = decode(body)
        except FormatError:
            if strict:
                raise
        else:
            yield row, time_ns, message


# ---- the file up to its first damage


def prefix(source: Source, *, only_metadata: bool = False) -> Evidence:
    """Reads records until the file or its data section ends, or a record is damaged.

    The rows of a last chunk without its message index are taken, but `good_end` is before that chunk. With
    `only_metadata`, it reads only the records before the first chunk.

    FormatError if the chunks of a channel do not hold its rows without gaps. A damaged end raises nothing.
    """
    evidence, walk = Evidence(source, FileEnd(), strict=True, good_end=len(MAGIC)), Walk(source)
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
        evidence.attachments.pop(record.attachment.name, None)  # the summary lists them as they lie
        evidence.attachments[record.attachment.name] = record.attachment
        return True
    parsed = record.parsed
    if isinstance(parsed, Metadata):
        evidence.metadata_indexes.append(MetadataIndex(record.offset, record.length, parsed.name))
        if parsed.name == RECORDING_METADATA:
            evidence.metadata = parsed.metadata
    elif isinstance(parsed, Schema):
        evidence.schemas[parsed.id] = parsed
    elif isinstance(parsed, Channel):
        evidence.channels[parsed.id] = parsed
    return isinstance(parsed, Metadata | Schema | Channel)


def _chunk(evidence: Evidence, record: Found, chunk: Chunk) -> tuple[tuple[int, ...], Rows] | None:
    """A chunk's row of the chunk table, and its rows; None if they are damaged.

    Takes the definitions in the chunk: its CRC covers them, while those outside of chunks have none.
    """
    try:
        content = chunk_records(chunk.data, evidence.source.name, chunk.claim.packed)
    except FormatError:
        return None
    evidence.schemas |= {schema.id: schema for schema in content.schemas}
    evidence.channels |= {channel.id: channel for channel in content.channels}
    headers = content.headers
    data = bytes(chunk.data[content.skip :])
    rows = Rows(content.channel, content.first, data, headers["#offset"], headers["#log_time"])
    return content.row(record.offset, chunk.claim), rows


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
