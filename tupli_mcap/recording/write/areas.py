"""Which channels and which journal areas a layout needs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from tupli_mcap.errors import RecordingError
from tupli_mcap.journal.file import Area, LogArea, RowArea
from tupli_mcap.journal.rows import rows_per_half
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.episodes import END_NAME, END_SCHEMA, START_NAME, START_SCHEMA
from tupli_mcap.messages.frames import (
    CAMERA_NAME,
    CAMERA_SCHEMA,
    FRAME_NAME,
    FRAME_SCHEMA,
    CameraTopics,
)
from tupli_mcap.messages.images.codecs import CODEC, image_codecs
from tupli_mcap.messages.layout import IMAGE_NAME, IMAGE_SCHEMA
from tupli_mcap.messages.step import FINAL_STATE_SCHEMA, STEP_SCHEMA, StepLayout
from tupli_mcap.recording.write.single_rows import CHUNKS_PER_HALF

__all__ = ["FRAMES_AREA", "Channels", "plan_areas", "register_channels"]

_HALF = 8 << 20  # bytes of images in half a journal
FRAMES_AREA = "frames/"  # and the sub-environment: no leaf of a state has such a name


class Channels(NamedTuple):
    """MCAP channel ids."""

    steps: list[int]
    images: list[list[int]]  # by image leaf, then by sub-environment
    final_state: int
    start: int
    end: int
    info: int | None
    cameras: list[tuple[int, int]]  # of one camera, by sub-environment: `/camera/<name>` and `/frame/<name>`


def register_channels(
    container: Container,
    name: str,
    layout: StepLayout,
    sub_environments: int | None,
    info: tuple[str, Mapping[str, str]] | None,
    cameras: Sequence[str] = (),
    png: Collection[str] = (),
) -> Channels:
    """Adds the channels a layout needs, or finds them in a recording that is appended to.

    `sub_environments` is None for a single environment; `info` is the schema and the metadata of `/info`.
    `cameras` are names; the ids of the last one's channels are returned. `png` are the image leaves that are stored as
    PNG, by name.

    Raises:
        RecordingError: a channel of that topic has another schema.
    """
    known = {channel.topic: channel.id for channel in container.channels.values()}
    schemas = {schema.name: schema.id for schema in container.schemas.values()}

    def channel(topic: str, schema: str, text: str, metadata: Mapping[str, str]) -> int:
        if topic in known:
            old = container.schemas[container.channels[known[topic]].schema_id]
            if old.data != text.encode():
                raise RecordingError(
                    f"{name} records {topic} with other fields; choose the same, or another file"
                )
            return known[topic]
        if schema not in schemas:
            schemas[schema] = container.add_schema(schema, text)
        return container.add_channel(topic, schemas[schema], metadata)

    description = layout.to_metadata()
    tops = [""] if sub_environments is None else [f"/env_{i}" for i in range(sub_environments)]
    steps = [
        channel(f"{top}/step", STEP_SCHEMA, layout.step_schema, {**description, "env": str(i)})
        for i, top in enumerate(tops)
    ]
    images = [
        [
            channel(
                f"{top}/image/{leaf.name}",
                *((CAMERA_NAME, CAMERA_SCHEMA) if leaf.name in png else (IMAGE_NAME, IMAGE_SCHEMA)),
                {"env": str(i), "leaf": leaf.name, **({CODEC: "png"} if leaf.name in png else {})},
            )
            for i, top in enumerate(tops)
        ]
        for leaf in layout.images
    ]
    others = (
        channel("/final_state", FINAL_STATE_SCHEMA, layout.final_schema, description),
        channel("/episode_start", START_NAME, START_SCHEMA, {}),
        channel("/episode_end", END_NAME, END_SCHEMA, {}),
        None if info is None else channel("/info", "tupli_mcap/msg/Info", info[0], info[1]),
    )
    pairs: list[tuple[int, int]] = []
    for name in cameras:
        pairs = []
        for i in range(len(tops)):
            topics = CameraTopics.of(name, None if sub_environments is None else i)
            about = {"env": str(i), "camera": name}
            pairs.append(
                (
                    channel(topics.camera, CAMERA_NAME, CAMERA_SCHEMA, {}),
                    channel(topics.frame, FRAME_NAME, FRAME_SCHEMA, about),
                )
            )
    container.codecs = image_codecs(layout, container.channels)
    return Channels(steps, images, *others, pairs)


def plan_areas(
    layout: StepLayout,
    n: int,
    size: int,
    step_capacity: int,
    *,
    vector: bool,
    infos: bool,
    frames: bool = False,
) -> list[Area]:
    """The areas of a journal for `n` sub-environments (of a `vector` environment) and chunks of `size` bytes.

    `step_capacity` is the least room (bytes) for steps of variable size.
    """
    if n > 1:  # one chunk a sub-environment: smaller ones, but never below 64 KiB
        size = max(64 * 1024, size // n)
    areas: list[Area] = []
    if not layout.constant:
        areas += [LogArea(f"steps/{i}", max(size, step_capacity), 2) for i in range(n)]
    else:
        row = layout.step_message.record_size
        chunks = 1 if vector else CHUNKS_PER_HALF
        areas.append(RowArea("steps", row, chunks * rows_per_half(row, size), n))
    for leaf in layout.images:
        row = layout.image_messages[leaf.name].dtype.itemsize
        # of a stack, most rows store one frame
        stored = row // leaf.stored_shape[0] if leaf.kind == "stack" else row
        # some images a chunk: what is done once a chunk takes as long for few of them as for many; of many
        # sub-environments fewer, for the room that their journals take
        some, within = (32, 3 << 20) if n == 1 else (16, 2 << 20)
        rows = rows_per_half(stored, max(size, min(some * stored, within)))
        rows = max(1, min(rows, _HALF // row))
        areas += [RowArea(f"{leaf.name}/{i}", row, rows) for i in range(n)]
    areas.append(LogArea("events", 512 * 1024))
    if infos:
        areas.append(LogArea("info", size))
    if frames:  # pictures are large: a few a chunk
        areas += [LogArea(f"{FRAMES_AREA}{i}", 4 * size) for i in range(n)]
    return areas
