"""Writes a repaired recording: the episodes of the plan, with rows and steps renumbered without gaps."""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from mcap.records import Channel

from tupli_mcap.arrays import Array
from tupli_mcap.mcap.container import Container, library
from tupli_mcap.messages.frames import (
    CAMERA_NAME,
    CAMERA_SCHEMA,
    FRAME_LAYOUT,
    FRAME_NAME,
    FRAME_SCHEMA,
    camera_names,
    encode_pair,
)
from tupli_mcap.messages.images.codecs import image_codecs, png_leaves, uses_codecs
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.channels import Channels, register_channels
from tupli_mcap.recording.edit.assemble import Assembler
from tupli_mcap.recording.index import EpisodeRow
from tupli_mcap.recording.recover.episodes import NewPlaces, Plan, PlannedEpisode, final_state
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore, RecordedChannels
from tupli_mcap.recording.recover.step_runs import intersection

RECOVERED = "recovered"  # key of the episode metadata that says which steps of which old episode these are
_METADATA = {
    "uuid": re.compile("[0-9a-f]{32}"),
    "format_version": re.compile("[12]"),
    "library": re.compile(".*", re.DOTALL),
    "created_ns": re.compile("[0-9]{1,20}", re.ASCII),
    "benchmark_id": re.compile(".*", re.DOTALL),
}
_COPY = 1 << 20


class RepairWriter:
    """Writes one repaired recording."""

    def __init__(self, container: Container, evidence: Evidence) -> None:
        self._container = container
        self._target = Assembler(container)
        self._evidence = evidence
        self._now = time.time_ns()
        self.metadata_lost: list[str] = []

    def begin(self, next_episode: int | None) -> None:
        """Writes magic, header, metadata and the good attachments; no later episode gets a number that was lost."""
        container, evidence = self._container, self._evidence
        metadata = self._metadata_of_recording()
        if next_episode is not None:
            metadata["next_episode"] = str(next_episode)
        self._target.begin(metadata, {}, self._now)
        for attachment in evidence.attachments.values():
            offset = container.position
            for at in range(attachment.offset, attachment.offset + attachment.length, _COPY):
                container.write(
                    evidence.source.read(at, min(_COPY, attachment.offset + attachment.length - at))
                )
            moved = type(attachment)(**{**attachment.__dict__, "offset": offset})
            container.attachment_indexes.append(moved)

    def _metadata_of_recording(self) -> dict[str, str]:
        """The recording's metadata, with new values for lost or damaged parts."""
        old = dict(self._evidence.metadata or {})
        for key in ("journal", "replaced"):
            old.pop(key, None)
        made = {
            "uuid": uuid.uuid4().hex,
            "format_version": "2" if uses_codecs(self._evidence.channels) else "1",
            "library": library(),
            "created_ns": str(self._now),
            "benchmark_id": "",
        }
        kept = {key: old[key] for key in made if key in old and _METADATA[key].fullmatch(old[key])}
        self.metadata_lost = [key for key in made if key not in kept]
        others = {key: value for key, value in old.items() if key not in made}
        # Rows get other numbers: the journal of the damaged file must not merge into this one.
        return {**others, **made, **kept, "rewritten": uuid.uuid4().hex}

    def steps(self, layout: StepLayout, old: RecordedChannels, plan: Plan, store: PackedStore) -> None:
        """Writes every message of the episodes that are kept."""
        channels = self._evidence.channels
        vector = Topics.of_step(channels[old.steps[0]].topic).is_vector
        info = None
        if old.info is not None:
            schema = self._evidence.schemas.get(channels[old.info].schema_id)
            info = None if schema is None else (schema.data.decode(), channels[old.info].metadata)
        cameras = OldCameras.of(self._evidence, len(old.steps), vector)
        envs = len(old.steps) if vector else None
        store.codecs = image_codecs(layout, channels)
        new = register_channels(
            self._container,
            "the repaired recording",
            layout,
            envs,
            info,
            cameras.names,
            png_leaves(channels),
        )
        self._container.define_channels()
        rows: dict[int, int] = {}  # first row of each episode in the new file
        dtype = layout.step_message.dtype if layout.constant else None
        by_env: dict[int, list[PlannedEpisode]] = {}
        for episode in plan.episodes:
            by_env.setdefault(episode.run.env, []).append(episode)
        for env, channel in enumerate(old.steps):
            episodes = by_env.get(env, [])
            at = 0
            for episode in episodes:
                rows[episode.number] = at
                at += episode.run.steps
            self._copy(store, channel, new.steps[env], episodes, dtype, patch=True)
            for leaf, ids in zip(layout.images, new.images, strict=True):
                image = old.images[leaf.name][env]
                if image is not None:
                    image_type = layout.image_messages[leaf.name].dtype
                    self._copy(store, image, ids[env], episodes, image_type, patch=False)
        self._events(store, old, new, plan, rows)
        if old.info is not None and new.info is not None:
            self._target.add_messages(new.info, self._infos(store, old.info, plan))
        topics = {channel.topic: channel.id for channel in self._container.channels.values()}
        for name, pairs in zip(cameras.names, cameras.ids, strict=True):
            for env, pair in enumerate(pairs):
                place = Topics.of(env if vector else None)
                new_pair = topics[place.camera(name)], topics[place.frame(name)]
                self._frames(store, pair, new_pair, by_env.get(env, []))

    def _frames(
        self, store: PackedStore, old: tuple[int, int], new: tuple[int, int], episodes: list[PlannedEpisode]
    ) -> None:
        """Writes the frames of one camera; they keep their times."""
        frames = partial(kept_frames, self._evidence, store, old, episodes)
        self._target.add_messages(new[0], ((frame.time_ns, frame.picture) for frame in frames()))
        self._target.add_messages(new[1], ((frame.time_ns, frame.pair) for frame in frames()))

    def finish(self) -> None:
        """Writes the index, the summary and the footer."""
        self._target.finish(self._now)

    # ---- rows

    def _copy(
        self,
        store: PackedStore,
        old: int,
        new: int,
        episodes: list[PlannedEpisode],
        dtype: np.dtype[Any] | None,
        *,
        patch: bool,
    ) -> None:
        """Copies the rows of `episodes`; with `patch` they get the episodes' numbers, and steps from 0."""
        if dtype is None:
            self._target.add_messages(new, self._variable(store, old, episodes))
        else:
            self._target.add_rows(new, self._constant(store, old, episodes, dtype, patch=patch))

    def _constant(
        self,
        store: PackedStore,
        channel: int,
        episodes: Iterable[PlannedEpisode],
        dtype: np.dtype[Any],
        *,
        patch: bool,
    ) -> Iterator[Array]:
        for episode in episodes:
            run = episode.run
            for span in store.spans(channel, store.packed(channel, run.row), run.steps):
                rows: Array = store.rows(span.chunk, dtype, keep=True)[span.begin : span.end]
                if patch and not (episode.head and episode.number == run.episode):
                    rows = np.frombuffer(bytearray(rows.tobytes()), dtype)
                    rows["episode"] = episode.number
                    rows["step"] -= run.step
                yield rows

    def _variable(
        self, store: PackedStore, channel: int, episodes: Iterable[PlannedEpisode]
    ) -> Iterator[tuple[int, bytes]]:
        for episode in episodes:
            run = episode.run
            step = 0
            for span in store.spans(channel, store.packed(channel, run.row), run.steps):
                for log_time, body in store.messages_of(span):
                    numbers = episode.number.to_bytes(4, "little") + step.to_bytes(4, "little")
                    yield log_time, numbers + bytes(body[8:])
                    step += 1

    # ---- episodes

    def _events(
        self,
        store: PackedStore,
        old: RecordedChannels,
        new: Channels,
        plan: Plan,
        rows: dict[int, int],
    ) -> None:
        starts = sorted(plan.episodes, key=lambda e: (e.start.time, e.number))
        ends = sorted(plan.episodes, key=lambda e: (e.end.time, e.number))
        counts = itertools.accumulate(len(e.resets) + 1 for e in starts)
        start_rows = {e.number: count - 1 for e, count in zip(starts, counts, strict=True)}
        end_rows = {e.number: i for i, e in enumerate(ends)}
        with_final = [e for e in ends if e.final is not None]
        final_rows = {e.number: i for i, e in enumerate(with_final)}
        last = {e.run.episode: e.number for e in plan.episodes}
        moved = {}
        for episode in plan.episodes:
            first = rows[episode.number]
            text = self._metadata(episode, last[episode.run.episode] == episode.number)
            end = episode.end.end._replace(first_row=first, metadata=text)
            moved[episode.number] = end
            row = EpisodeRow(
                first, end.length, end.episode_return, episode.start.time, episode.end.time,
                episode.start.start.seed_number,
                start_rows[end.episode], end_rows[end.episode], final_rows.get(end.episode, -1),
                end.episode, end.env, end.end,
            )  # fmt: skip
            self._target.index.add(row, text)
        messages = (
            (time, start._replace(first_row=rows[e.number]).encode())
            for e in starts
            for time, start, _ in (*e.resets, e.start)
        )
        self._target.add_messages(new.start, messages)
        self._target.add_messages(new.end, ((e.end.time, moved[e.number].encode()) for e in ends))
        self._target.add_messages(
            new.final_state, ((e.end.time, self._final(e, store, old)) for e in with_final)
        )

    def _metadata(self, episode: PlannedEpisode, last: bool) -> str:
        """The metadata of the old episode if its end was found, and for a part of it the key `recovered`."""
        text = episode.end.end.metadata
        if episode.whole:
            return text
        try:
            parsed = json.loads(text)
        except ValueError:
            parsed = {}
        metadata: dict[str, Any] = parsed if isinstance(parsed, dict) else {}
        origin: dict[str, Any] = {
            "episode": episode.run.episode,
            "first_step": episode.run.step,
            "length": episode.length,
        }
        if RECOVERED in metadata:
            origin[RECOVERED] = metadata[RECOVERED]
        if last and episode.orphan not in ("", "{}"):
            with contextlib.suppress(ValueError):
                origin["metadata"] = json.loads(episode.orphan)
        return json.dumps({**metadata, RECOVERED: origin})

    def _final(self, episode: PlannedEpisode, store: PackedStore, old: RecordedChannels) -> bytes:
        if old.final is None or episode.final is None or episode.final < 0:
            return final_state(self._evidence, episode)
        numbers = (episode.number, episode.run.env)
        body = store.message(old.final, episode.final)
        return b"".join(n.to_bytes(4, "little") for n in numbers) + body[8:]

    def _infos(self, store: PackedStore, channel: int, plan: Plan) -> Iterator[tuple[int, bytes]]:
        """The infos of steps that are kept, with the new numbers of these."""
        pieces = NewPlaces(plan.episodes)
        for _, log_time, body in store.all_messages(channel):
            number, step = int.from_bytes(body[:4], "little"), int.from_bytes(body[4:8], "little")
            place = pieces.find(number, step)
            if place is not None:
                yield log_time, b"".join(n.to_bytes(4, "little") for n in place) + bytes(body[8:])


# ---- frames: kept where the step is kept, and both picture and row were found


class KeptFrame(NamedTuple):
    """A picture's message and its renumbered `/frame` row; `time_ns` is the time of both."""

    time_ns: int
    picture: bytes
    pair: bytes


class OldCameras(NamedTuple):
    """The cameras; `ids[i]` are the ids of `/camera` and `/frame` of camera `names[i]`, by sub-environment."""

    names: tuple[str, ...]
    ids: tuple[tuple[tuple[int, int], ...], ...]

    @classmethod
    def of(cls, evidence: Evidence, num_envs: int, vector: bool) -> OldCameras:
        """The cameras whose channels are all known and have the right schemas."""
        topics = {channel.topic: channel for channel in evidence.channels.values()}
        cameras: dict[str, tuple[tuple[int, int], ...]] = {}
        for name in camera_names({topic: channel.id for topic, channel in topics.items()}):
            places = [Topics.of(env if vector else None) for env in range(num_envs)]
            known = [(topics.get(place.camera(name)), topics.get(place.frame(name))) for place in places]
            ids = tuple((a.id, b.id) for a, b in known if a is not None and b is not None)
            if len(ids) == num_envs and all(_fits(evidence, *pair) for pair in known):
                cameras[name] = ids
        return cls(tuple(cameras), tuple(cameras.values()))


def _fits(evidence: Evidence, camera: Channel | None, frame: Channel | None) -> bool:
    wanted = ((camera, CAMERA_NAME, CAMERA_SCHEMA), (frame, FRAME_NAME, FRAME_SCHEMA))
    schemas = [(evidence.schemas.get(c.schema_id), name, text) for c, name, text in wanted if c is not None]
    return all(s is not None and (s.name, s.data) == (name, text.encode()) for s, name, text in schemas)


def kept_frames(
    evidence: Evidence, store: PackedStore, ids: tuple[int, int], episodes: Sequence[PlannedEpisode]
) -> Iterator[KeptFrame]:
    """The frames of a sub-environment's episodes, with the new numbers of these."""
    camera, frame = ids
    pieces = NewPlaces(episodes)
    for first, stop in intersection(evidence.ranges(camera), evidence.ranges(frame)):
        for span in store.spans(frame, store.packed(frame, first), stop - first):
            rows = store.rows(span.chunk, FRAME_LAYOUT.dtype)[span.begin : span.end]
            numbers = rows["#sequence"].tolist()
            values = zip(
                numbers, rows["episode"].tolist(), rows["step"].tolist(), rows["#log_time"], strict=True
            )
            for row, number, step, time_ns in values:
                place = pieces.find(number, step, state=True)
                if place is not None:
                    picture = store.message(camera, store.packed(camera, row))
                    yield KeptFrame(int(time_ns), picture, encode_pair(*place))


def frames_lost(evidence: Evidence, cameras: OldCameras) -> int:
    """The number of frames that are known to have been recorded and are not whole."""
    lost = 0
    for pair in (pair for ids in cameras.ids for pair in ids):
        whole = intersection(*(evidence.ranges(channel) for channel in pair))
        stops = [ranges[-1][1] for ranges in map(evidence.ranges, pair) if ranges]
        if evidence.tail.index is not None:
            table = evidence.tail.index.chunks
            stops += [int(table["rows"][table["channel"] == channel].sum()) for channel in pair]
        lost += max(stops, default=0) - sum(b - a for a, b in whole)
    return lost
