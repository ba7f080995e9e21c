"""Writes a repaired recording: the episodes of the plan, with rows and steps renumbered without gaps."""

from __future__ import annotations

import contextlib
import json
import re
import time
import uuid
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial, reduce
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.frames import FRAME_LAYOUT, encode_pair
from tupli_mcap.messages.images.codecs import image_codecs, png_leaves, uses_codecs
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.layout import NUMBERS, renumbered
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics, camera_names
from tupli_mcap.recording.channels import register_channels
from tupli_mcap.recording.contents import first_metadata
from tupli_mcap.recording.edit.assemble import Assembler, CopiedEpisode, writable
from tupli_mcap.recording.frames import camera_channels
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
        self.infos_lost = self.frames_lost = 0

    def begin(self, next_episode: int | None) -> None:
        """Writes magic, header, metadata, also those of other programs, and the good attachments; no later episode gets
        a number that was lost."""
        container, evidence = self._container, self._evidence
        metadata = self._metadata_of_recording()
        if next_episode is not None:
            metadata["next_episode"] = str(next_episode)
        self._target.begin(metadata, {}, self._now)
        self._target.copy_metadata(evidence.source, evidence.metadata_indexes)
        for attachment in evidence.attachments.values():
            offset = container.position
            for at in range(attachment.offset, attachment.offset + attachment.length, _COPY):
                container.write(
                    evidence.source.read(at, min(_COPY, attachment.offset + attachment.length - at))
                )
            container.attachment_indexes.append(replace(attachment, offset=offset))

    def _metadata_of_recording(self) -> dict[str, str]:
        """The recording's metadata, with new values for lost or damaged parts."""
        old = dict(self._evidence.metadata or {})
        for key in ("journal", "replaced"):
            old.pop(key, None)
        version = "2" if uses_codecs(self._evidence.channels) else "1"
        made = first_metadata(uuid.uuid4().hex, version, "", self._now)
        kept = {key: old[key] for key in made if key in old and _METADATA[key].fullmatch(old[key])}
        self.metadata_lost = [key for key in made if key not in kept]
        others = {key: value for key, value in old.items() if key not in made}
        # Rows get other numbers: the journal of the damaged file must not merge into this one.
        return {**others, **made, **kept, "rewritten": uuid.uuid4().hex}

    def steps(self, layout: StepLayout, old: RecordedChannels, plan: Plan, store: PackedStore) -> None:
        """Writes every message of the episodes that are kept."""
        channels = self._evidence.channels
        vector = Topics.of_step(channels[old.steps[0]].topic).is_vector
        info = self._infos_channel(old.info)
        places = [Topics.of(env if vector else None) for env in range(len(old.steps))]
        cameras = _cameras(self._evidence, places)
        store.codecs = image_codecs(layout, channels)
        envs = len(places) if vector else None
        new = register_channels(
            self._container, "the repaired recording", layout, envs, info, list(cameras), png_leaves(channels)
        )
        self._container.define_channels()
        rows: dict[int, int] = {}  # first row of each episode in the new file
        dtype = layout.step_message.dtype if layout.constant else None
        by_env: list[list[PlannedEpisode]] = [[] for _ in places]
        for episode in plan.episodes:
            by_env[episode.run.env].append(episode)
        for env, episodes in enumerate(by_env):
            at = 0
            for episode in episodes:
                rows[episode.number] = at
                at += episode.run.steps
            self._copy(store, old.steps[env], new.steps[env], episodes, dtype)
            for leaf, ids in zip(layout.images, new.images, strict=True):
                image = old.images[leaf.name][env]
                if image is not None:
                    self._copy(store, image, ids[env], episodes, layout.image_messages[leaf.name].dtype)
        self._episodes(store, old, plan, rows)
        if old.info is not None and new.info is not None:
            self._target.add_messages(new.info, self._infos(store, old.info, plan))
        topics = {channel.topic: channel.id for channel in self._container.channels.values()}
        for name, pairs in cameras.items():
            for pair, place, episodes in zip(pairs, places, by_env, strict=True):
                self.frames_lost += rows_lost(self._evidence, pair)
                new_pair = topics[place.camera(name)], topics[place.frame(name)]
                self._frames(store, pair, new_pair, episodes)

    def _infos_channel(self, channel: int | None) -> tuple[str, dict[str, str]] | None:
        """The schema and metadata of the channel of infos; None if there is none, or its metadata are damaged."""
        if channel is None:
            return None
        self.infos_lost = rows_lost(self._evidence, [channel])
        try:
            return InfoCodec.from_metadata(self._evidence.channels[channel].metadata).schema()
        except FormatError:
            self.infos_lost += sum(piece.rows for piece in self._evidence.pieces.get(channel, ()))
            return None

    def _frames(
        self, store: PackedStore, old: tuple[int, int], new: tuple[int, int], episodes: list[PlannedEpisode]
    ) -> None:
        """Writes the frames of one camera; they keep their times."""
        frames = partial(_kept_frames, self._evidence, store, old, episodes)
        pictures = ((time, store.message(old[0], store.packed(old[0], row))) for time, row, _ in frames())
        self._target.add_messages(new[0], pictures)
        self._target.add_messages(new[1], ((time, encode_pair(*place)) for time, _, place in frames()))

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
    ) -> None:
        """Copies the rows of `episodes`; steps get the episodes' numbers, and numbers from 0."""
        if dtype is None:
            self._target.add_messages(new, self._variable(store, old, episodes))
        else:
            self._target.add_rows(new, self._constant(store, old, episodes, dtype))

    def _constant(
        self, store: PackedStore, channel: int, episodes: Iterable[PlannedEpisode], dtype: np.dtype[Any]
    ) -> Iterator[Array]:
        numbered = "episode" in (dtype.names or ())
        for episode in episodes:
            run = episode.run
            for span in store.spans(channel, store.packed(channel, run.row), run.steps):
                rows: Array = store.rows(span.chunk, dtype, keep=True)[span.begin : span.end]
                if numbered and not (episode.head and episode.number == run.episode):
                    rows = writable(rows)
                    rows["episode"] = episode.number
                    rows["step"] -= run.step
                yield rows

    def _variable(
        self, store: PackedStore, channel: int, episodes: Iterable[PlannedEpisode]
    ) -> Iterator[tuple[int, bytes]]:
        for episode in episodes:
            run = episode.run
            messages = store.messages(channel, store.packed(channel, run.row), run.steps)
            for step, (log_time, body) in enumerate(messages):
                yield log_time, renumbered(body, episode.number, step)

    # ---- episodes

    def _episodes(self, store: PackedStore, old: RecordedChannels, plan: Plan, rows: dict[int, int]) -> None:
        """Writes starts, ends and final states; `rows` are the first ones of the new episodes."""
        last = {e.run.episode: e.number for e in plan.episodes}
        times = {row: time_ns for row, time_ns, _ in store.all_messages(old.final)}  # of final states
        episodes = []
        for e in sorted(plan.episodes, key=lambda e: (e.start.time, e.number)):
            first = rows[e.number]
            starts = [(time, start._replace(first_row=first)) for time, start, _ in (*e.resets, e.start)]
            text = self._metadata(e, last[e.run.episode] == e.number)
            end = e.end.end._replace(first_row=first, metadata=text)
            final = None
            if e.final is not None:
                final = times.get(e.final, e.end.time), partial(self._final, e, store, old)
            row = e.number if e.end.row is None else e.end.row
            episodes.append(CopiedEpisode(starts, (e.end.time, end), row, final))
        self._target.add_episodes(episodes)

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
        return renumbered(store.message(old.final, episode.final), episode.number, episode.run.env)

    def _infos(self, store: PackedStore, channel: int, plan: Plan) -> Iterator[tuple[int, bytes]]:
        """The infos of steps that are kept, with the new numbers of these."""
        pieces = NewPlaces(plan.episodes)
        for _, log_time, body in store.all_messages(channel):
            place = pieces.find(*NUMBERS.unpack_from(body))
            if place is not None:
                yield log_time, renumbered(body, *place)


# ---- frames: kept where the step is kept, and both picture and row were found


def _cameras(evidence: Evidence, places: Sequence[Topics]) -> dict[str, list[tuple[int, int]]]:
    """The ids of `/camera` and `/frame` by sub-environment, of cameras whose channels are all known and have the right
    schemas."""
    topics = {channel.topic: channel for channel in evidence.channels.values()}
    found = {}
    for name in camera_names(topics):
        with contextlib.suppress(FormatError):
            found[name] = [camera_channels(name, place, topics, evidence.schemas, "") for place in places]
    return found


def _kept_frames(
    evidence: Evidence, store: PackedStore, ids: tuple[int, int], episodes: Sequence[PlannedEpisode]
) -> Iterator[tuple[int, int, tuple[int, int]]]:
    """(log_time, row, new episode and step) of the frames of a sub-environment's episodes."""
    camera, frame = ids
    pieces = NewPlaces(episodes)
    for first, stop in intersection(evidence.ranges(camera), evidence.ranges(frame)):
        for span in store.spans(frame, store.packed(frame, first), stop - first):
            rows = store.rows(span.chunk, FRAME_LAYOUT.dtype)[span.begin : span.end]
            names = ("#log_time", "#sequence", "episode", "step")
            for time_ns, row, number, step in zip(*(rows[name].tolist() for name in names), strict=True):
                place = pieces.find(number, step, state=True)
                if place is not None:
                    yield time_ns, row, place


def rows_lost(evidence: Evidence, ids: Sequence[int]) -> int:
    """The number of rows that are known to have been recorded, and were not found in every one of these channels."""
    whole = reduce(intersection, map(evidence.ranges, ids))
    counts = [evidence.stop(channel) for channel in ids]
    if evidence.file_end.index is not None:
        table = evidence.file_end.index.chunks
        counts += [int(table["rows"][table["channel"] == channel].sum()) for channel in ids]
    return max(counts) - sum(b - a for a, b in whole)
