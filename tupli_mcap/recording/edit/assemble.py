"""Writes a recording made of parts of others. Every command that makes a recording of others uses it."""

from __future__ import annotations

import contextlib
import itertools
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Metadata, MetadataIndex

from tupli_mcap import files
from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.journal.committed import even_rows
from tupli_mcap.journal.logs import joined_rows
from tupli_mcap.mcap.chunks import decompress, headers_at
from tupli_mcap.mcap.container import COMPRESSIONS, IN_CHUNKS, Container, Prepared, Rows
from tupli_mcap.mcap.lock import writers_kept_out
from tupli_mcap.mcap.records import CHUNK_HEAD, read_metadata, written_records
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.episodes import EpisodeEnd, EpisodeStart, record
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE
from tupli_mcap.progress import progress
from tupli_mcap.recording.columns.chunk_store import IN_MEMORY, ChunkStore
from tupli_mcap.recording.columns.runs import runs_of
from tupli_mcap.recording.contents import RECORDING_METADATA, REPEATED_METADATA
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME, EpisodeRow, IndexBuilder
from tupli_mcap.recording.opened import OpenFile

_CHUNK = 256 * 1024


class CopiedEpisode(NamedTuple):
    """The records of an episode besides its steps, with its new numbers.

    Attributes:
        starts: (log_time, start) of the resets without a step before it, and of its own.
        end: (log_time, end).
        end_row: row of the end in its source, which orders ends with equal times.
        final: log_time of its final state, and a function that returns the message's body; None if it is not known.
    """

    starts: Sequence[tuple[int, EpisodeStart]]
    end: tuple[int, EpisodeEnd]
    end_row: int
    final: tuple[int, Callable[[], bytes]] | None


class Assembler:
    """Writes a recording: call `begin`, then add rows channel by channel, then `finish`.

    Rows get their numbers in the order in which they are added. Times that would decrease within a channel are raised.

    Attributes:
        container: the target.
        index: the episodes so far.
        held: number of rows, but for starts and ends of episodes, whose `log_time` was raised to that of the row ahead.
        copied: number of chunks that were copied unchanged.
    """

    def __init__(self, container: Container) -> None:
        self.container = container
        self.index = IndexBuilder()
        self.held = 0
        self.copied = 0
        self._latest: dict[int, int] = {}
        self._of_others: set[bytes] = set()

    def begin(
        self, metadata: Mapping[str, str], attachments: Mapping[str, tuple[str, bytes]], time_ns: int
    ) -> None:
        """Writes the header, the recording's metadata, and attachments: name -> (media type, bytes)."""
        self.container.start()
        self.container.add_metadata(RECORDING_METADATA, metadata)
        for name, (media_type, data) in attachments.items():
            self.container.add_attachment(name, media_type, data, time_ns)

    def copy_metadata(self, source: Source, places: Iterable[MetadataIndex]) -> None:
        """Copies the metadata records that other programs have added to a source; equal ones once.
        FormatError if one is not where the source says."""
        for place in places:
            if place.name in (RECORDING_METADATA, REPEATED_METADATA):
                continue
            record = written_records(Metadata(place.name, read_metadata(source, place)))
            if record not in self._of_others:
                self._of_others.add(record)
                offset = self.container.position
                self.container.metadata_indexes.append(MetadataIndex(offset, len(record), place.name))
                self.container.write(record)

    def next_row(self, channel: int) -> int:
        """The number of rows that a channel has, and so the number of its next one."""
        return self.container.counts[channel]

    def latest(self, channel: int) -> int:
        """The time (ns) of a channel's last row; later rows must not have an earlier one."""
        return self._latest.get(channel, 0)

    def copy_first(self, source: OpenFile, channel: int, count: int, dtype: np.dtype[Any] | None) -> int:
        """Copies chunks of the first `count` rows of a channel, which has the same id here; returns how many rows."""
        if self.next_row(channel) or count == 0:
            return 0
        if channel in self.container.codecs:  # only in memory they are of constant size
            dtype = None
        for chunk, packed in _first_chunks(source, self.container, channel, count, dtype):
            self.container.finish_chunks(([chunk], [packed]))
            self._latest[channel] = int(chunk.rows.times[-1])
            self.copied += 1
        return self.next_row(channel)

    def add_rows(self, channel: int, parts: Iterable[Array]) -> None:
        """Adds rows of constant size (arrays of whole records), in chunks of the usual size."""
        batch: list[Array] = []
        size = 0
        for part in parts:
            batch.append(part)
            size += part.nbytes
            if size >= _CHUNK:
                self._add_batch(channel, batch)
                batch, size = [], 0
        if batch:
            self._add_batch(channel, batch)

    def _add_batch(self, channel: int, batch: list[Array]) -> None:
        # as bytes: NumPy may not copy the padding between fields
        data = bytearray().join(part.tobytes() for part in batch)
        rows: Array = np.frombuffer(data, batch[0].dtype)
        if not len(rows):
            return
        first, latest = self.next_row(channel), np.uint64(self.latest(channel))
        rows["#channel"] = channel
        rows["#sequence"] = first + np.arange(len(rows))
        early = rows["#log_time"] < latest
        if early.any():
            self.held += int(early.sum())
            for name in ("#log_time", "#publish_time"):
                rows[name] = np.maximum(rows[name], latest)
        self.add_chunk(even_rows(channel, data, rows))

    def add_messages(self, channel: int, messages: Iterable[tuple[int, bytes]]) -> None:
        """Adds messages (log_time, body) of any size, in chunks of the usual size."""
        sequence, latest = self.next_row(channel), self.latest(channel)
        batch: list[bytes] = []
        size = 0
        for log_time, body in messages:
            self.held += log_time < latest
            latest = max(log_time, latest)
            batch.append(record(channel, sequence + len(batch), latest, body))
            size += len(batch[-1])
            if size >= _CHUNK:
                self.add_chunk(joined_rows(channel, sequence, batch, sealed=False))
                sequence += len(batch)
                batch, size = [], 0
        if batch:
            self.add_chunk(joined_rows(channel, sequence, batch, sealed=False))

    def add_chunk(self, rows: Rows) -> None:
        """Adds rows to their channel."""
        self.container.add_chunk(rows)
        self._latest[rows.channel] = int(rows.times[-1])

    def add_episodes(self, episodes: Sequence[CopiedEpisode]) -> None:
        """Adds starts, ends and final states in the order of their times, and the episodes to the index."""
        ids = {channel.topic: channel.id for channel in self.container.channels.values()}
        by_start = sorted(range(len(episodes)), key=lambda i: episodes[i].starts[-1][0])
        by_end = sorted(range(len(episodes)), key=lambda i: (episodes[i].end[0], episodes[i].end_row))
        places: dict[int, int] = {}
        messages = []
        for i in by_start:
            messages += [(time_ns, start.encode()) for time_ns, start in episodes[i].starts]
            places[i] = len(messages) - 1
        started = [self.next_row(ids[EPISODE_START]) + places[i] for i in range(len(episodes))]
        messages = _in_time(messages)
        start_times = [messages[places[i]][0] for i in range(len(episodes))]
        self.add_messages(ids[EPISODE_START], messages)
        ends = _in_time([(episodes[i].end[0], episodes[i].end[1].encode()) for i in by_end])
        ended = dict(zip(by_end, itertools.count(self.next_row(ids[EPISODE_END])), strict=False))
        end_times = {i: time_ns for i, (time_ns, _) in zip(by_end, ends, strict=True)}
        self.add_messages(ids[EPISODE_END], ends)
        with_final = [(found[0], i, found[1]) for i in by_end if (found := episodes[i].final) is not None]
        with_final.sort(key=itemgetter(0))
        finals = {i: self.next_row(ids[FINAL_STATE]) + row for row, (_, i, _) in enumerate(with_final)}
        self.add_messages(ids[FINAL_STATE], ((time_ns, body()) for time_ns, _, body in with_final))
        for i, episode in enumerate(episodes):
            start, end = episode.starts[-1][1], episode.end[1]
            row = EpisodeRow(
                end.first_row, end.length, end.episode_return, start_times[i], end_times[i], start.seed_number,
                started[i], ended[i], finals.get(i, -1), end.episode, end.env, end.end,
            )  # fmt: skip
            self.index.add(row, end.metadata)

    def finish(self, time_ns: int) -> None:
        """Writes the episode index and the summary."""
        data = self.index.encode(self.container.chunk_rows)
        self.container.add_attachment(INDEX_NAME, INDEX_MEDIA_TYPE, data, time_ns)
        self.container.finish()


def writable(rows: Array) -> Array:
    """A copy of rows that may be changed; NumPy's own may lack the padding between fields."""
    return np.frombuffer(bytearray(rows.tobytes()), rows.dtype)


def _in_time(messages: Sequence[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """The messages with times raised so that they never decrease."""
    times = itertools.accumulate((time_ns for time_ns, _ in messages), max)
    return [(time_ns, body) for time_ns, (_, body) in zip(times, messages, strict=True)]


def _first_chunks(
    file: OpenFile, container: Container, channel: int, count: int, dtype: np.dtype[Any] | None
) -> Iterator[tuple[Prepared, bytes]]:
    """The chunks that hold only rows of the first `count` of a channel, and their compressed bytes.

    A row says which one it is (`sequence`), of which channel and of which episode; so only the first rows of a
    recording are those of another one, up to the first that is left out. Each chunk is unpacked, and its CRC checked:
    no damage is handed on.

    Args:
        container: the target, in which the channel has the same id.
        dtype: of rows of constant size, where they lie so in the chunk; None where they vary.

    Raises:
        FormatError: a chunk is damaged.
    """
    store, end = file.store, 0
    for chunk in store.chunks(channel):
        row = store.table[chunk]
        end += int(row["rows"])
        offset, length, skip = int(row["offset"]), int(row["length"]), int(row["skip"])
        method = IN_CHUNKS[COMPRESSIONS.index(container.compression)]
        if end > count or offset >= IN_MEMORY or IN_CHUNKS[int(row["compression"])] != method:
            return
        rows = _rows(store, chunk, channel, dtype)
        packed = file.source.read(offset, length)[CHUNK_HEAD.size + len(method) + 8 :]
        definitions = container.definitions(channel) if int(row["first"]) == 0 else b""
        size = int(row["uncompressed"])
        whole = decompress(method, memoryview(packed), size, store.name) if skip else rows.data
        if skip != len(definitions) or bytes(whole[:skip]) != definitions:
            return
        yield Prepared(rows, skip, whole, int(row["crc"])), packed


def _rows(store: ChunkStore, chunk: int, channel: int, dtype: np.dtype[Any] | None) -> Rows:
    if dtype is not None:
        rows = store.rows(chunk, dtype, keep=False)
        return even_rows(channel, rows.view(np.uint8).data, rows)
    data, places = store.records(chunk, keep=False)
    starts = places[:, 0]
    times = headers_at(data)["#log_time"][starts]
    return Rows(channel, int(store.table[chunk]["first"]), data, starts.astype(np.uint64), times)


@contextlib.contextmanager
def copying(parts: Iterable[tuple[OpenFile, Array]], name: str) -> Iterator[None]:
    """Shows a progress bar while episodes of recordings, as rows of their indexes, are copied to the file `name`."""
    stores, size = [], 0.0
    for file, rows in parts:
        lengths = file.store.table["length"]
        read = np.unique(file.store.locate(*map(np.asarray, runs_of(rows, file.steps)))[0])
        of_steps = np.isin(file.store.table["channel"], file.steps)
        # of the other chunks, such as those of images, about as large a part
        size += float(lengths.sum()) * float(lengths[read].sum()) / max(float(lengths[of_steps].sum()), 1.0)
        stores.append(file.store)
    with progress(int(size), f"writing {name}", in_bytes=True) as bar:
        try:
            for store in stores:
                store.tell = bar.advance
            yield
        finally:
            for store in stores:
                store.tell = None


# ---- the file


@contextlib.contextmanager
def replacing(goal: Path, *, held: bool = False, overwrite: bool = True) -> Iterator[tuple[int, Path]]:
    """Yields a descriptor and a path; the file becomes `goal`, synced, when the block ends without an error. It gets
    the permissions of the file that it replaces.

    Missing directories are made, and a symbolic link is followed. A new file's directory is rid of the files that
    killed processes left there.

    Args:
        held: whether the caller holds the lock of the recording that is replaced.
        overwrite: whether a file at `goal` is replaced; the caller has looked, but one may come meanwhile.

    Raises:
        LockedError: somebody is recording to `goal`, which would be replaced.
        RecordingError: the system refuses, here or in the block, or `goal` exists (without `overwrite`); it is
            unchanged.
    """
    place = Path(os.path.realpath(goal)) if os.path.islink(goal) else goal  # noqa: PTH114 - not an error for a long name
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        if not held:
            with contextlib.suppress(OSError):  # one that may not be read
                files.remove_left(files.left_in(place.parent))
        kept_out = (
            writers_kept_out(goal) if overwrite and not held and goal.is_file() else contextlib.nullcontext()
        )
        with kept_out, files.replacing(place, overwrite=overwrite) as new:
            fd = files.create(new)
            try:
                yield fd, new
                with contextlib.suppress(FileNotFoundError):  # it replaces none
                    new.chmod(stat.S_IMODE(place.stat().st_mode))
            finally:
                os.close(fd)
    except OSError as err:
        if isinstance(err, FileExistsError) and os.path.lexists(place):
            raise RecordingError(
                f"{goal} was made by somebody else meanwhile, and is not overwritten; choose another path"
            ) from err
        raise RecordingError(f"{goal} cannot be written: {os_reason(err)}") from err
