"""The recorded frames of an episode; each is decoded on access."""

from __future__ import annotations

import bisect
import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, overload

import numpy as np
from mcap.records import Channel, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError, plural
from tupli_mcap.messages.frames import (
    CAMERA_NAME,
    CAMERA_SCHEMA,
    FRAME_LAYOUT,
    FRAME_NAME,
    FRAME_SCHEMA,
    EncodedFrame,
    decode_frame,
)
from tupli_mcap.messages.images.pictures import Picture, decode_picture
from tupli_mcap.messages.topics import Topics, camera_names
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.contents import Contents

_SHAPES = ((CAMERA_NAME, CAMERA_SCHEMA), (FRAME_NAME, FRAME_SCHEMA))

_MADE_BY = "record with frames=True, or tupli-mcap render makes them"


class _Table(NamedTuple):
    """The episodes and steps that the rows of a camera show: `rows` is sorted by episode, then by row."""

    episodes: Array
    steps: Array
    times: Array
    rows: Array


class Cameras:
    """The cameras of a recording. Frames are read on access. Raises FormatError if a camera's channel is missing or has
    another schema."""

    def __init__(self, contents: Contents, store: ChunkStore, vector: bool, num_envs: int, name: str) -> None:
        self._store = store
        self.where = name
        topics = {channel.topic: channel for channel in contents.channels.values()}
        self.names = camera_names(topics)
        self._channels: dict[tuple[str, int], tuple[int, int]] = {}
        self._tables: dict[tuple[str, int], _Table] = {}
        for camera in self.names:
            for env in range(num_envs):
                place = Topics.of(env if vector else None)
                self._channels[camera, env] = camera_channels(camera, place, topics, contents.schemas, name)

    def channels(self, camera: str, env: int) -> tuple[int, int]:
        """The ids of `/camera/<name>` and `/frame/<name>` of a sub-environment; raises RecordingError if there is no
        such camera."""
        if (camera, env) not in self._channels:
            known = ", ".join(self.names) or "none: `tupli-mcap render` makes frames of a recording"
            raise RecordingError(
                f"{self.where}: expected one of its cameras, found {camera!r:.60}; it has {known}"
            )
        return self._channels[camera, env]

    def rows(self, camera: str, env: int, episode: int, length: int) -> tuple[Array, Array, Array]:
        """(rows, steps, log_times) of an episode's frames; frames of steps that are missing are left out."""
        table = self._table(camera, env)
        # numpy's search would copy the numbers of all frames first
        kept = slice(*(bisect.bisect_left(table.episodes, number) for number in (episode, episode + 1)))
        here = table.steps[kept] <= length
        return table.rows[kept][here], table.steps[kept][here], table.times[kept][here]

    def frame(self, camera: str, env: int, row: int) -> EncodedFrame:
        """One frame, not decoded."""
        channel, _ = self.channels(camera, env)
        (body,) = self._store.bodies(channel, row, 1)
        frame, frame_id = decode_frame(body)
        if frame_id != camera:
            raise FormatError(f"{self.where}: expected a frame of camera {camera!r}, found {frame_id!r:.60}")
        return frame

    def _table(self, camera: str, env: int) -> _Table:
        if (camera, env) not in self._tables:
            pictures, pairs = self.channels(camera, env)
            # a live writer may have moved one of them to the file, and not yet the other
            count = min(self._store.count(pictures), self._store.count(pairs))
            self._store.fetch(span.chunk for span in self._store.spans(pairs, 0, count))
            parts = [
                self._store.rows(span.chunk, FRAME_LAYOUT.dtype, keep=False)[span.begin : span.end]
                for span in self._store.spans(pairs, 0, count)
            ]
            found = np.concatenate(parts) if parts else np.empty(0, FRAME_LAYOUT.dtype)
            rows = np.argsort(found["episode"], kind="stable")
            columns = [found[name].astype(np.int64)[rows] for name in ("episode", "step", "#log_time")]
            self._tables[camera, env] = _Table(columns[0], columns[1], columns[2], rows)
        return self._tables[camera, env]


def camera_channels(
    camera: str, place: Topics, topics: Mapping[str, Channel], schemas: Mapping[int, Schema], where: str
) -> tuple[int, int]:
    """The ids of the two channels of a camera. FormatError if one of them is missing, or has another schema."""
    found = []
    for topic, (name, text) in zip((place.camera(camera), place.frame(camera)), _SHAPES, strict=True):
        channel = topics.get(topic)
        if channel is None:
            raise FormatError(f"{where}: expected a channel {topic}, found none")
        schema = schemas.get(channel.schema_id)
        if schema is None or (schema.name, schema.data) != (name, text.encode()):
            raise FormatError(f"{where}: the schema of {topic} is not {name}")
        found.append(channel.id)
    return found[0], found[1]


class Frames(Sequence[Picture]):
    """The frames of one episode, in order; each access to `frames[i]` decodes it from the file.

    Attributes:
        camera: its name.
        steps: int64; a frame shows the state after this many steps of the episode (0: after the reset).
        times: int64; when each frame was rendered (ns).
    """

    def __init__(
        self, cameras: Cameras, camera: str, env: int, rows: Array, steps: Array, times: Array
    ) -> None:
        self._cameras = cameras
        self._env = env
        self._rows = rows
        self.camera = camera
        self.steps = steps
        self.times = times

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int | np.integer[Any]) -> Picture: ...
    @overload
    def __getitem__(self, i: slice) -> Frames: ...
    def __getitem__(self, i: int | np.integer[Any] | slice) -> Picture | Frames:
        """The picture: uint8 (height, width, 3); the frames of a slice.

        Raises:
            IndexError: there is no such frame.
            MissingExtraError: Pillow is not installed; `encoded` does not need it.
            FormatError: the bytes are no picture.
        """
        if isinstance(i, slice):
            parts = (self._rows[i], self.steps[i], self.times[i])
            return Frames(self._cameras, self.camera, self._env, *parts)
        data = self.encoded(i).data
        return decode_picture(data, f"{self._cameras.where}: frame of step {self.steps[i]}")

    def encoded(self, i: int | np.integer[Any]) -> EncodedFrame:
        """The bytes of a frame (`data`) in its format (`form`: "png" or "jpeg"); IndexError if there is none."""
        try:
            number = operator.index(i)
        except TypeError as err:
            raise RecordingError(f"expected a frame's number or a slice, found {i!r:.80}") from err
        if not len(self):
            raise IndexError(f"the episode has no frames: {_MADE_BY}")
        if not -len(self) <= number < len(self):
            raise IndexError(f"expected a frame from 0 to {len(self) - 1}, found {i}")
        return self._cameras.frame(self.camera, self._env, int(self._rows[number]))

    def of_step(self, step: int) -> Picture:
        """The frame of the state after `step` steps; raises RecordingError if it was not recorded."""
        found = np.flatnonzero(self.steps == step)
        if not len(found):
            told = ", ".join(map(str, self.steps[:8].tolist())) + (", ..." if len(self) > 8 else "")
            has = f"it has {told}" if told else f"it has none: {_MADE_BY}"
            raise RecordingError(f"{self._cameras.where}: the episode has no frame of step {step}; {has}")
        return self[int(found[0])]

    def __repr__(self) -> str:
        return f"<{plural(len(self), 'frame')} of camera {self.camera!r}>"


def gathered(parts: Iterable[tuple[Frames, Array, Array]], total: int) -> Array:
    """The frames of some steps as one column: uint8 (total, height, width, 3).

    `parts` are, for each episode, its frames, the wanted steps as in `of_step`, and their places in the column. Raises
    RecordingError if a frame was not recorded, or frames differ in size.
    """
    column: Array = np.empty((0, 0, 0, 3), np.uint8)
    for frames, steps, places in parts:
        for step in np.unique(steps).tolist():
            picture = frames.of_step(step)
            if not len(column):
                column = np.empty((total, *picture.shape), np.uint8)
            if picture.shape != column.shape[1:]:
                sizes = f"{column.shape[1:3]} and {picture.shape[:2]}"
                raise RecordingError(
                    f"expected frames of one size, found {sizes}; choose episodes by a filter"
                )
            column[places[steps == step]] = picture
    return column
