"""Recordings of many small chunks, and damage to records of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from environments import Sampler, roll
from gymnasium import spaces
from mcap.writer import Writer

from tupli_mcap import (
    RecordEpisodes,
    Recording,
)
from tupli_mcap.mcap.source import PathSource
from tupli_mcap.mcap.walk import Damage, Found, Walk

BOX = spaces.Box(-1.0, 1.0, (6,), np.float64)


def places(path: Path) -> list[Found]:
    source = PathSource(path)
    try:
        found = [item for item in Walk(source) if not isinstance(item, Damage)]
    finally:
        source.close()
    return found


def chunks(path: Path, topic: str) -> list[Found]:
    """The chunks of a topic, in their order."""
    with Recording(path) as recording:
        channel = recording._topics[topic]
        table = recording._contents.table
        offsets = set(table["offset"][table["channel"] == channel].tolist())
    return [item for item in places(path) if item.offset in offsets]


def flip(path: Path, *positions: int) -> None:
    data = bytearray(path.read_bytes())
    for position in positions:
        data[position] ^= 0x10
    path.write_bytes(data)


def hit(path: Path, found: Found) -> None:
    """Damages a record in its middle."""
    flip(path, found.offset + found.length // 2)


def record(path: Path, steps: int = 300, length: int = 40, **options: Any) -> Path:
    with RecordEpisodes(
        Sampler(BOX, spaces.Discrete(3), length=length), path, chunk_size=4096, **options
    ) as env:
        roll(env, steps)
    return path


def foreign(path: Path, messages: int = 600, **options: Any) -> Path:
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 2000, **options})
        writer.start("ros2", "somebody")
        schema = writer.register_schema("A", "jsonschema", b"{}")
        ids = [writer.register_channel(topic, "json", schema, {"k": topic}) for topic in ("/a", "/b")]
        writer.add_attachment(1, 2, "att", "text/plain", b"hi" * 50)
        for i in range(messages):
            writer.add_message(ids[i % 3 == 0], i * 10, b'{"i": %d}' % i, i * 10 + 1, i)
        writer.add_metadata("meta", {"a": "b"})
        writer.finish()
    return path
