"""MountainCar against a wind that is an artifact, as in PyTupli's tutorial."""

from __future__ import annotations

import io
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv

from tupli_mcap.arrays import Array
from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.schema import ArtifactMetadata
from tupli_mcap.storage import TupliStorage


class WindyCar(MountainCarEnv):
    """MountainCar against a wind, whose strengths (m/s) come from a table."""

    def __init__(self, wind: Array | str) -> None:
        super().__init__()
        self.data = wind
        self.blow = 0

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminal, timeout, info = super().step(action)
        assert isinstance(self.data, np.ndarray)
        self.blow += 1
        observation[1] -= 1e-4 * self.data[self.blow % len(self.data)]
        return observation, reward, terminal, timeout, info


class WindyWrapper(TupliEnvWrapper):
    """Keeps the wind as an artifact, as PyTupli's tutorial does."""

    def _serialize(self, env: gym.Env[Any, Any]) -> tuple[gym.Env[Any, Any], list[str]]:
        text = io.StringIO()
        np.savetxt(text, env.unwrapped.data)  # type: ignore[attr-defined]
        item = self.storage.store_artifact(text.getvalue().encode(), ArtifactMetadata(name="wind"))
        env.unwrapped.data = item.id  # type: ignore[attr-defined]
        return env, [item.id]

    @classmethod
    def _deserialize(cls, env: gym.Env[Any, Any], storage: TupliStorage) -> gym.Env[Any, Any]:
        data = storage.load_artifact(env.unwrapped.data)  # type: ignore[attr-defined]
        env.unwrapped.data = np.loadtxt(io.BytesIO(data))  # type: ignore[attr-defined]
        return env


def windy(rows: int = 50) -> gym.Env[Any, Any]:
    return gym.wrappers.TimeLimit(WindyCar(np.sin(np.arange(rows) / 7.0)), 30)
