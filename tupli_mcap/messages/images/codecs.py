"""Codecs of images in chunks; in the journal and in memory, images are rows of constant size.

A codec works on whole chunks: the writer encodes a chunk before it is compressed, `ChunkStore` decodes it before it
returns rows. The channel's metadata name the codec.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from mcap.records import Channel

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import Rows
from tupli_mcap.messages.images.png import PngCodec
from tupli_mcap.messages.images.stack import StackCodec
from tupli_mcap.messages.layout import ImageLayout
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import parse
from tupli_mcap.spaces.leaves import Leaf

CODEC = "codec"  # key of the metadata of an image channel


class ImageCodec(Protocol):
    """Encodes and decodes the chunks of one image channel. Thread-safe."""

    def encode(self, rows: Rows) -> Rows:
        """Encodes the rows of a chunk; rows that are encoded already (a killed writer's) stay as they are."""
        ...

    def decode(self, data: Any, count: int, where: str) -> Any:
        """The `count` rows of constant size of a chunk; raises FormatError if `data` does not hold them."""
        ...


def image_codecs(layout: StepLayout, channels: Mapping[int, Channel]) -> dict[int, ImageCodec]:
    """The codecs of the channels that have one, by channel id.

    Raises:
        FormatError: a channel names a codec that this version does not know.
    """
    codecs: dict[int, ImageCodec] = {}
    leaves = {leaf.name: leaf for leaf in layout.images}
    for number, channel in channels.items():
        leaf = leaves.get(channel.metadata.get("leaf", ""))
        if leaf is None:
            continue
        topic = parse(channel.topic)
        if topic is None or topic.kind != "image":
            continue
        codec = _codec(channel, leaf, layout.image_messages[leaf.name])
        if codec is not None:
            codecs[number] = codec
    return codecs


def _codec(channel: Channel, leaf: Leaf, layout: ImageLayout) -> ImageCodec | None:
    """The codec that a channel names; None if its images are stored as they are."""
    name = channel.metadata.get(CODEC)
    if name is None:
        return StackCodec(leaf, layout) if leaf.kind == "stack" else None
    if name == "png":
        return PngCodec(leaf, layout)
    raise FormatError(
        f"{channel.topic}: expected the codec 'png' or none, found {name!r:.40}; update tupli-mcap"
    )


def png_leaves(channels: Mapping[int, Channel]) -> frozenset[str]:
    """The names of the leaves whose images are PNG in a recording with these channels."""
    return frozenset(
        channel.metadata.get("leaf", "")
        for channel in channels.values()
        if channel.metadata.get(CODEC) == "png"
    )


def uses_codecs(channels: Mapping[int, Channel]) -> bool:
    """True if a recording with these channels has format version 2."""
    return any("stacks" in channel.metadata or CODEC in channel.metadata for channel in channels.values())
