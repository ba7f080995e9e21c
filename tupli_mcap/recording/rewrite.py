"""A recording written anew: fewer episodes, other attachments. Episode numbers, times and values stay."""

from __future__ import annotations

import itertools
import os
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.layout import BODY
from tupli_mcap.recording.cameras import EncodedFrame, encode_frame, encode_pair
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.container import Container, Rows
from tupli_mcap.recording.contents import RECORDING_METADATA
from tupli_mcap.recording.events import EpisodeEnd, EpisodeStart, record
from tupli_mcap.recording.imagecodecs import image_codecs, image_format
from tupli_mcap.recording.index import INDEX_MEDIA_TYPE, INDEX_NAME, EpisodeRow, IndexBuilder
from tupli_mcap.recording.logs import group_records
from tupli_mcap.recording.reader import Recording
from tupli_mcap.recording.replacing import replacing
from tupli_mcap.recording.rows import even_rows
from tupli_mcap.recording.signed import SIGNATURE_NAME, stays_signed

__all__ = ["Follower", "NewFrames", "rewrite_recording"]

_CHUNK = 256 * 1024
_FOLLOWS = "follows"  # in the metadata of a companion channel: the topic it was made from


class Follower(NamedTuple):
    """A companion channel: `make` gives it a message for each step of the channel `follows`, in the same row."""

    topic: str
    schema: str
    text: str
    follows: str
    make: Callable[[int, Rows], Rows]


class NewFrames(Protocol):
    """Frames of some episodes, which take the place of those that a camera has of them."""

    camera: str

    def of(self, episode: int) -> Iterable[tuple[int, EncodedFrame]] | None:
        """(step, frame) of an episode, in order; None: what the recording has of it stays."""
        ...


def rewrite_recording(
    source: Recording,
    target: str | os.PathLike[str],
    *,
    episodes: Sequence[int] | None = None,
    attachments: Mapping[str, tuple[str, bytes]] | None = None,
    benchmark_id: str | None = None,
    compression: str = "zstd",
    followers: Sequence[Follower] = (),
    frames: NewFrames | None = None,
) -> None:
    """Writes `target` (replaced in one rename) from `source`.

    Args:
        episodes: numbers of the episodes to keep (all by default).
        attachments: name -> (media type, bytes), added to the source's or replacing them.
        benchmark_id: replaces the source's.
        followers: companion channels to make. Those of the source are left out: they can be made again.
        frames: of a camera that may be a new one.

    A signature stays if nothing it covers is changed, and is left out otherwise.

    Raises:
        RecordingError: the target cannot be written.
        FormatError: the source is damaged.
    """
    target = Path(target)
    with replacing(target) as (fd, _):
        _Rewriter(source, Container(fd, str(target), compression), frames).run(
            episodes, attachments or {}, benchmark_id, followers
        )


class _Rewriter:
    def __init__(self, source: Recording, container: Container, frames: NewFrames | None = None) -> None:
        self._new_frames = frames
        self._held: dict[
            int, int
        ] = {}  # times must not decrease, whatever the clock did between two episodes
        self._source = source
        self._container = container
        self._contents = source._contents
        self._store = source._store
        self._topics = source._topics
        self._index = IndexBuilder()
        self._followers: dict[int, list[tuple[int, Follower]]] = {}  # by step channel

    def run(
        self,
        numbers: Sequence[int] | None,
        attachments: Mapping[str, tuple[str, bytes]],
        benchmark_id: str | None,
        followers: Sequence[Follower] = (),
    ) -> None:
        container, source = self._container, self._source
        metadata = {key: value for key, value in source.metadata.items() if key != "journal"}
        if benchmark_id is not None:
            metadata["benchmark_id"] = benchmark_id
        metadata["next_episode"] = str(self._contents.next_episode)
        metadata["rewritten"] = uuid.uuid4().hex
        container.start(f"tupli-mcap {version('tupli-mcap')}")
        container.add_metadata(RECORDING_METADATA, metadata)
        now = time.time_ns()
        kept = {name: info for name, info in source.attachments.items() if name not in attachments}
        same = numbers is None and benchmark_id in (None, source.benchmark_id) and self._new_frames is None
        if not (same and stays_signed(source.attachments, attachments)):
            kept.pop(SIGNATURE_NAME, None)
        for name, info in kept.items():
            container.add_attachment(name, info.media_type, source.read_attachment(name), now)
        for name, (media_type, data) in attachments.items():
            container.add_attachment(name, media_type, data, now)
        self._define(followers)
        rows = source.index
        if numbers is not None:
            rows = rows[np.isin(rows["episode"], np.asarray(list(numbers), dtype=np.int64))]
        self._cameras = self._camera_channels() if source.num_envs else {}
        container.define_channels()
        if source.num_envs:
            self._steps(rows)
        container.add_attachment(INDEX_NAME, INDEX_MEDIA_TYPE, self._index.encode(container.chunk_rows), now)
        container.finish()

    def _define(self, followers: Sequence[Follower]) -> None:
        """The source's channels, and those of the followers after them."""
        container, contents = self._container, self._contents
        own = {i: c for i, c in contents.channels.items() if _FOLLOWS not in c.metadata}
        if sorted(own) != list(range(1, len(own) + 1)):  # somebody else's channels are in between
            own = dict(contents.channels)
        used = {channel.schema_id for channel in own.values()}
        schemas = {i: schema for i, schema in contents.schemas.items() if i in used}
        whole = sorted(schemas) == list(range(1, len(schemas) + 1))
        container.schemas = schemas if whole else dict(contents.schemas)
        container.channels = own
        container.codecs = image_codecs(self._source.layout, own) if self._source._step_channels else {}
        taken = {channel.topic for channel in own.values()} & {follower.topic for follower in followers}
        if taken:
            raise RecordingError(
                f"{self._source.name} has channels of its own named {', '.join(sorted(taken))}"
            )
        container.counts = dict.fromkeys(own, 0)
        known: dict[str, int] = {}
        for follower in followers:
            if follower.schema not in known:
                known[follower.schema] = container.add_schema(follower.schema, follower.text)
            about = {_FOLLOWS: follower.follows}
            number = container.add_channel(follower.topic, known[follower.schema], about)
            self._followers.setdefault(self._topics[follower.follows], []).append((number, follower))

    def _add_chunk(self, rows: Rows) -> None:
        self._container.add_chunk(rows)
        for number, follower in self._followers.get(rows.channel, []):
            self._container.add_chunk(follower.make(number, rows))

    def _steps(self, rows: Any) -> None:
        layout = self._source.layout
        firsts = np.zeros(len(rows), dtype=np.int64)
        for env, channel in enumerate(self._source._step_channels):
            mine = np.flatnonzero(rows["env"] == env)
            mine = mine[np.argsort(rows["first_row"][mine], kind="stable")]
            lengths = rows["length"][mine].astype(np.int64)
            firsts[mine] = np.cumsum(lengths) - lengths
            spans = [(int(rows["first_row"][i]), int(rows["length"][i])) for i in mine]
            dtype = layout.step_message.dtype if layout.constant else None
            self._copy(channel, spans, dtype)
            topic = self._contents.channels[channel].topic.removesuffix("/step")
            for leaf in layout.images:
                self._copy(
                    self._topics[f"{topic}/image/{leaf.name}"], spans, layout.image_messages[leaf.name].dtype
                )
        self._events(rows, firsts)
        self._frames(rows)
        if "/info" in self._topics:
            self._infos({int(number) for number in rows["episode"]})

    def _copy(self, channel: int, spans: Sequence[tuple[int, int]], dtype: np.dtype[Any] | None) -> None:
        """Rows `spans` of a channel, renumbered, in chunks of the usual size."""
        if dtype is None:
            self._write(channel, (m for first, count in spans for m in self._messages(channel, first, count)))
            return
        batch: list[Any] = []
        size = written = 0
        for first, count in _merged(spans):
            for span in self._store.spans(channel, first, count):
                part = self._store.rows(span.chunk, dtype, keep=False)[span.begin : span.end]
                batch.append(part)
                size += part.nbytes
                if size >= _CHUNK:
                    written += self._put(channel, batch, written)
                    batch, size = [], 0
        self._put(channel, batch, written)

    def _put(self, channel: int, batch: list[Any], first: int) -> int:
        if not batch:
            return 0
        data = bytearray().join(
            part.tobytes() for part in batch
        )  # concatenating arrays would drop their padding
        rows = np.frombuffer(data, batch[0].dtype)
        rows["#sequence"] = first + np.arange(len(rows))
        self._add_chunk(even_rows(channel, first, data, rows))
        return len(rows)

    def _messages(self, channel: int, first: int, count: int) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of messages of a channel."""
        for span in self._store.spans(channel, first, count):
            data = memoryview(self._store.load(span.chunk))
            for start, end in self._store.messages(span.chunk)[span.begin : span.end]:
                yield int.from_bytes(data[start + 15 : start + 23], "little"), bytes(data[start + BODY : end])

    def _write(self, channel: int, messages: Iterator[tuple[int, bytes]]) -> None:
        batch = bytearray()
        for sequence, (log_time, body) in enumerate(messages):
            batch += record(channel, sequence, log_time, body)
            if len(batch) >= _CHUNK:
                self._emit(group_records(memoryview(bytes(batch))))
                batch.clear()
        self._emit(group_records(memoryview(bytes(batch))))

    def _emit(self, groups: list[Rows]) -> None:
        for rows in groups:
            self._add_chunk(rows)

    def _events(self, rows: Any, firsts: Any) -> None:
        starts: list[tuple[int, bytes]] = []
        ends: list[tuple[int, bytes]] = []
        finals: list[tuple[int, bytes]] = []
        # ends keep their order, which is not that of the episodes in a vector environment
        end_places = _places(rows["end_row"])
        final_places = _places(rows["final_row"][rows["final_row"] >= 0])
        positions = {int(number): i for i, number in enumerate(self._source.index["episode"])}
        for row, first in zip(rows, firsts, strict=True):
            last = int(row["start_row"])
            resets = len(self._source.resets_before(positions[int(row["episode"])]))
            for start_time, body in self._messages(self._topics["/episode_start"], last - resets, resets + 1):
                start = EpisodeStart.decode(memoryview(body))._replace(first_row=int(first))
                starts.append((start_time, start.encode()))
            ((end_time, body),) = self._messages(self._topics["/episode_end"], int(row["end_row"]), 1)
            end = EpisodeEnd.decode(memoryview(body))._replace(first_row=int(first))
            final = -1
            if row["final_row"] >= 0:
                final = final_places[len(finals)]
                finals += self._messages(self._topics["/final_state"], int(row["final_row"]), 1)
            seed = int(row["seed"]) if row["has_seed"] else None
            self._index.add(
                EpisodeRow(
                    int(first),
                    end.length,
                    end.episode_return,
                    int(row["start_time"]),
                    int(row["end_time"]),
                    seed,
                    len(starts) - 1,
                    end_places[len(ends)],
                    final,
                    end.episode,
                    end.env,
                    end.end,
                ),
                end.metadata,
            )
            ends.append((end_time, end.encode()))
        ends = _in_order(ends, end_places)
        finals = _in_order(finals, final_places)
        for topic, messages in (("/episode_start", starts), ("/episode_end", ends), ("/final_state", finals)):
            self._write(self._topics[topic], iter(_in_time(messages)))

    def _camera_channels(self) -> dict[str, list[tuple[int, int]]]:
        """By camera, then by sub-environment, the ids of its channels; those of a new camera are added."""
        source, cameras = self._source, self._source._cameras
        envs = range(source.num_envs)
        found = {name: [cameras.channels(name, env) for env in envs] for name in cameras.names}
        new = self._new_frames
        if new is not None and new.camera not in found:
            vector = source.num_envs if source.is_vector else None
            where = (self._container, source.name, source.layout, vector, None, (new.camera,))
            found[new.camera] = register_channels(*where, image_format(self._contents.channels)).cameras
        return found

    def _frames(self, rows: Any) -> None:
        """The frames of episodes that stay: pictures, and what they show row by row."""
        for camera, channels in self._cameras.items():
            for env, (pictures, pairs) in enumerate(channels):
                mine = rows[rows["env"] == env]
                mine = mine[np.argsort(mine["first_row"], kind="stable")]
                for channel in (pictures, pairs):
                    found = (
                        self._frames_of(camera, episode, channel, channel == pictures) for episode in mine
                    )
                    self._write(channel, itertools.chain.from_iterable(found))

    def _frames_of(self, camera: str, row: Any, channel: int, pictures: bool) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of the messages of an episode's frames."""
        number = int(row["episode"])
        new = self._new_frames
        drawn = new.of(number) if new is not None and new.camera == camera else None
        if drawn is not None:
            for step, frame in drawn:
                time_ns = self._held[channel] = max(frame.time_ns, self._held.get(channel, 0))
                held = frame._replace(time_ns=time_ns)
                yield time_ns, encode_frame(camera, held) if pictures else encode_pair(number, step)
        elif camera in self._source.cameras:
            places = self._source._cameras.rows(camera, int(row["env"]), number, int(row["length"]))[0]
            for place in places.tolist():
                yield from self._messages(channel, place, 1)

    def _infos(self, numbers: set[int]) -> None:
        channel = self._topics["/info"]
        everything = self._messages(channel, 0, self._store.count(channel))
        self._write(channel, (m for m in everything if int.from_bytes(m[1][:4], "little") in numbers))


def _places(rows: Any) -> list[int]:
    """Where each of some rows comes once the others are gone."""
    places = np.empty(len(rows), np.int64)
    places[np.argsort(rows, kind="stable")] = np.arange(len(rows))
    found: list[int] = places.tolist()
    return found


def _in_order(messages: list[tuple[int, bytes]], places: Sequence[int]) -> list[tuple[int, bytes]]:
    return [messages[i] for i in np.argsort(places, kind="stable").tolist()]


def _in_time(messages: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """Times that never decrease (episodes of several sub-environments end out of order)."""
    latest, kept = 0, []
    for log_time, body in messages:
        latest = max(latest, log_time)
        kept.append((latest, body))
    return kept


def _merged(spans: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for first, count in spans:
        if merged and merged[-1][0] + merged[-1][1] == first:
            merged[-1] = (merged[-1][0], merged[-1][1] + count)
        else:
            merged.append((first, count))
    return merged
