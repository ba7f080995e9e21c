"""The good parts of a recording, in its file and its journal: rows by channel and row number."""

from __future__ import annotations

import bisect
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, overload

import numpy as np
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.journal.committed import FinalHole
from tupli_mcap.mcap.chunk_records import message_headers
from tupli_mcap.mcap.container import CHUNK_ROWS, Rows
from tupli_mcap.mcap.records import BODY
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.walk import ChunkClaim, Damage, Walk
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore, Span
from tupli_mcap.recording.contents import step_channels
from tupli_mcap.recording.recover.file_end import Tail

_CACHE = 64 << 20
_HEADERS = 16  # chunks whose headers are cached, for reading single messages


class Piece(NamedTuple):
    """`rows` consecutive rows of a channel from `first` on; `entry` (CHUNK_ROWS) is their chunk or place in memory."""

    first: int
    rows: int
    entry: tuple[int, ...]

    @property
    def stop(self) -> int:
        return self.first + self.rows


class RepairedChunk(NamedTuple):
    """A chunk whose header is damaged: the right content of the header, and the number of bytes before its rows."""

    offset: int
    claim: ChunkClaim
    skip: int


class _Loaded(Sequence[bytes]):
    """Rows that are in no good chunk: of the journal, or of a chunk with a damaged header, which is read on access."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._walk = Walk(source)
        self.places: list[Rows | RepairedChunk] = []

    def __len__(self) -> int:
        return len(self.places)

    @overload
    def __getitem__(self, i: int) -> bytes: ...
    @overload
    def __getitem__(self, i: slice) -> Sequence[bytes]: ...
    def __getitem__(self, i: int | slice) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(len(self))[i]]
        place = self.places[i]
        if isinstance(place, Rows):
            return place.data
        data = self._walk.unpack(place.offset, place.claim)
        if isinstance(data, str):
            raise FormatError(f"{self._source.name}: chunk at offset {place.offset}: {data}")
        return memoryview(data)[place.skip :]


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
        metadata_indexes: with `strict`, the places of all metadata records.
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
    tail: Tail
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

    def load(self, place: Rows | RepairedChunk, channel: int, first: int, rows: int, size: int) -> Piece:
        """A piece of rows that are in no good chunk, of `size` bytes, for `add`."""
        entry = memory_entry(len(self.loaded), channel, first, rows, size)
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

    def store(self) -> PackedStore:
        """A store of the rows, numbered without gaps."""
        return PackedStore(self)

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
        self._headers: dict[int, Array] = {}  # of the chunks used last

    def packed(self, channel: int, row: int) -> int:
        """The number that a found row has in this store."""
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

    def message(self, channel: int, row: int) -> bytes:
        """The body of one message."""
        (span,) = self.spans(channel, row, 1)
        ((_, body),) = self.messages_of(span)
        return bytes(body)
