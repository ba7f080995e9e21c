"""Recordings of several spaces, to take steps of by number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from environments import Sampler
from gymnasium import spaces

from tupli_mcap import RecordEpisodes

SPACES: dict[str, gym.Space[Any]] = {
    "box": spaces.Box(-1, 1, (3,)),
    "nested": spaces.Dict(
        {"b": spaces.Tuple((spaces.Discrete(5), spaces.Box(0, 5, (2, 0)))), "a": spaces.Box(-1, 1, ())}
    ),
    "image": spaces.Dict({"eye": spaces.Box(0, 255, (4, 5, 3), np.uint8), "speed": spaces.Box(0, 1, (2,))}),
    "text": spaces.Dict(
        {"word": spaces.Text(8), "number": spaces.Box(0, 1, (2,)), "bag": spaces.Sequence(spaces.Discrete(4))}
    ),
}


def record(path: Path, space: gym.Space[Any], steps: int, length: int = 7, seed: int = 0) -> Path:
    """`steps` steps of episodes of `length`; the last one is interrupted if there are some left."""
    env = Sampler(space, spaces.Discrete(4), length)
    env.action_space.seed(seed)
    with RecordEpisodes(env, path, chunk_size=4096) as recorder:
        over = True
        for i in range(steps):
            if over:
                recorder.reset(seed=seed + i)
            over = any(recorder.step(recorder.action_space.sample())[2:4])
    return path


def at(column: Any, row: int) -> Any:
    """One row of a column."""
    if isinstance(column, dict):
        return {key: at(part, row) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(at(part, row) for part in column)
    return column[row]
