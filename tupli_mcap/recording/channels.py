"""The channels that a layout needs, and their ids."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

from tupli_mcap.errors import RecordingError
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.episodes import END_NAME, END_SCHEMA, START_NAME, START_SCHEMA
from tupli_mcap.messages.frames import CAMERA_NAME, CAMERA_SCHEMA, FRAME_NAME, FRAME_SCHEMA
from tupli_mcap.messages.images.codecs import CODEC, image_codecs
from tupli_mcap.messages.layout import IMAGE_NAME, IMAGE_SCHEMA
from tupli_mcap.messages.step import FINAL_STATE_SCHEMA, STEP_SCHEMA, StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics


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
    cameras: Sequence[str],
    png: Collection[str],
) -> Channels:
    """Adds the channels a layout needs to a file, or finds them in a recording that is appended to.

    `name` is that of the recording, `sub_environments` is None for a single environment, `info` has schema and metadata
    of `/info`; `png` names the image leaves that are stored as PNG. The returned ids of cameras are those of the last
    one. Raises RecordingError if a channel with one of the topics has another schema.
    """
    channel, description = _Registrar(container, name).channel, layout.to_metadata()
    environments = [Topics.of(i) for i in ([None] if sub_environments is None else range(sub_environments))]
    steps = [
        channel(topics.step, STEP_SCHEMA, layout.step_schema, {**description, "env": str(i)})
        for i, topics in enumerate(environments)
    ]
    images = []
    for leaf in layout.images:
        schema = (CAMERA_NAME, CAMERA_SCHEMA) if leaf.name in png else (IMAGE_NAME, IMAGE_SCHEMA)
        about = {"leaf": leaf.name, **({CODEC: "png"} if leaf.name in png else {})}
        images.append(
            [
                channel(topics.image(leaf.name), *schema, {"env": str(i), **about})
                for i, topics in enumerate(environments)
            ]
        )
    others = (
        channel(FINAL_STATE, FINAL_STATE_SCHEMA, layout.final_schema, description),
        channel(EPISODE_START, START_NAME, START_SCHEMA, {}),
        channel(EPISODE_END, END_NAME, END_SCHEMA, {}),
        None if info is None else channel(INFO, "tupli_mcap/msg/Info", info[0], info[1]),
    )
    pairs: list[tuple[int, int]] = []
    for camera in cameras:
        pairs = [
            (
                channel(topics.camera(camera), CAMERA_NAME, CAMERA_SCHEMA, {}),
                channel(topics.frame(camera), FRAME_NAME, FRAME_SCHEMA, {"env": str(i), "camera": camera}),
            )
            for i, topics in enumerate(environments)
        ]
    container.codecs = image_codecs(layout, container.channels)
    return Channels(steps, images, *others, pairs)


class _Registrar:
    """Adds channels to the container of the recording `name`, or finds those that are there."""

    def __init__(self, container: Container, name: str) -> None:
        self._container, self._name = container, name
        self._known = {channel.topic: channel for channel in container.channels.values()}
        self._schemas = {schema.name: schema.id for schema in container.schemas.values()}

    def channel(self, topic: str, schema: str, text: str, metadata: Mapping[str, str]) -> int:
        """The id of a topic's channel; RecordingError if it has another schema."""
        container, schemas, known = self._container, self._schemas, self._known.get(topic)
        if known is not None:
            if container.schemas[known.schema_id].data != text.encode():
                raise RecordingError(
                    f"{self._name} records {topic} with other fields; choose the same, or another file"
                )
            return known.id
        if schema not in schemas:
            schemas[schema] = container.add_schema(schema, text)
        return container.add_channel(topic, schemas[schema], metadata)
