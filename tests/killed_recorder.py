"""A recording child that reports every finished step, to be killed at any moment."""

from __future__ import annotations

import pickle
import sys
from typing import Any

import numpy as np
from environments import Sampler
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import RecordEpisodes
from tupli_mcap.vector import RecordEpisodes as RecordVector

KINDS: dict[str, Any] = {
    "box": spaces.Box(-1, 1, (4,), np.float32),
    "text": spaces.Dict({"note": spaces.Text(30), "x": spaces.Discrete(5)}),
    "image": spaces.Dict({"camera": spaces.Box(0, 255, (8, 8, 3), np.uint8), "x": spaces.Box(-1, 1, (1,))}),
    "large": spaces.Dict({"x": spaces.Discrete(5), "y": spaces.Box(-1, 1, (600,))}),
    "frames": spaces.Box(0, 255, (80, 80, 3), np.uint8),
    "vector": spaces.Box(-1, 1, (4,), np.float32),
    "info": spaces.Box(-1, 1, (4,), np.float32),
}


def send(value: object) -> None:
    data = pickle.dumps(value)
    sys.stdout.buffer.write(len(data).to_bytes(4, "little") + data)
    sys.stdout.buffer.flush()


def main(kind: str, path: str, mode: str, chunk_size: int) -> None:
    space, actions = KINDS[kind], spaces.Discrete(9)
    env: Any
    if kind == "vector":
        envs = SyncVectorEnv([lambda i=i: Sampler(space, actions, length=5 + i) for i in range(3)])
        env = RecordVector(envs, path, mode=mode, chunk_size=chunk_size)  # type: ignore[arg-type]
    else:
        info = kind == "info"
        env = RecordEpisodes(
            Sampler(space, actions), path, mode=mode, chunk_size=chunk_size, record_info=info
        )  # type: ignore[arg-type]
    env.reset(seed=1)
    send("ready")
    while True:
        action = env.action_space.sample()
        state, _, terminal, timeout, _ = env.step(action)
        send((action, state, terminal, timeout))
        if kind != "vector" and (terminal or timeout):
            env.reset()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
