"""The frames of a damaged recording that are kept: their step is kept, and both picture and row were found."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from mcap.records import Channel

from tupli_mcap.messages.frames import (
    CAMERA_NAME,
    CAMERA_SCHEMA,
    FRAME_LAYOUT,
    FRAME_NAME,
    FRAME_SCHEMA,
    camera_names,
    encode_pair,
)
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.recover.episodes import NewPlaces, PlannedEpisode
from tupli_mcap.recording.recover.evidence import Evidence, PackedStore
from tupli_mcap.recording.recover.step_runs import intersection


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
