"""A large storage: many recordings of many short episodes, made by copying one under new UUIDs."""

from __future__ import annotations

import io
import uuid
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tools.bench.measure import check

__all__ = ["add", "fill", "template"]


def template(path: Path, episodes: int) -> bytes:
    """The bytes of a recording of one-step episodes whose metadata have `score` 0, 1, 2, …"""
    import gymnasium as gym

    from tupli_mcap import EpisodeData, write_recording

    state, cartpole = np.zeros((1, 4), np.float32), gym.make("CartPole-v1")

    def each() -> Iterator[EpisodeData]:
        for score in range(episodes):
            yield EpisodeData(
                state, [score % 2], [1.0], [True], [False], state[0],
                metadata={"score": score, "is_expert": score % 10 == 0},
            )  # fmt: skip

    spaces = {"observation_space": cartpole.observation_space, "action_space": cartpole.action_space}
    write_recording(path, each(), **spaces, benchmark_id="0" * 64)
    return path.read_bytes()


def add(path: Path, data: bytes) -> None:
    """A copy of the template, as a recording of its own."""
    from tupli_mcap import Recording
    from tupli_mcap.mcap.records import with_crc

    with Recording(io.BytesIO(data)) as recording:
        metadata = dict(recording.metadata)
    old, new = dict(metadata), {**metadata, "uuid": uuid.uuid4().hex}
    for before, after in zip(with_crc(old).values(), with_crc(new).values(), strict=True):
        data = data.replace(before.encode(), after.encode())  # at the end it stands again
    path.write_bytes(data)


def fill(root: Path, data: bytes, recordings: int, first: int = 0) -> None:
    """Puts recordings below a storage's root."""
    for number in range(first, first + recordings):
        directory = root / "recordings" / f"{number % 10}"
        directory.mkdir(parents=True, exist_ok=True)
        add(directory / f"r{number:05}.mcap", data)
    check(len(list(root.glob("recordings/**/*.mcap"))) >= recordings, "recordings are missing")
