"""d3rlpy: a replay buffer that is filled step by step and dumped; loading it reads everything."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.contenders.base import CannotError, Contender, Session, joined
from tools.bench.data import Array
from tools.bench.workloads import Workload


class _Filling(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any], path: Path) -> None:
        from d3rlpy.dataset import create_infinite_replay_buffer

        super().__init__(env)
        logging.getLogger("d3rlpy").setLevel(logging.ERROR)
        self._buffer = create_infinite_replay_buffer(env=env)
        self._path = path

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        return self._state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        self._buffer.append(self._state, action, float(result[1]))
        self._state = result[0]
        if result[2] or result[3]:
            self._buffer.clip_episode(result[2])
        return result

    def close(self) -> None:
        with self._path.open("w+b") as file:
            self._buffer.dump(file)
        super().close()


def _leaves(episode: Any, actions: np.dtype[Any] | None = None) -> dict[str, Any]:
    ends = np.zeros(episode.size(), bool)
    ends[-1] = True
    return {
        "states": episode.observations,
        "actions": episode.actions,
        "rewards": episode.rewards[:, 0],
        "terminals": ends & bool(episode.terminated),
        "timeouts": ends & (not episode.terminated),
    }


class _Session(Session):
    def __init__(self, episodes: Any) -> None:
        super().__init__()
        self._episodes = episodes

    def episode(self, number: int) -> dict[str, Any]:
        return _leaves(self._episodes[number])

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        rows = slice(start, start + length)
        return {name: np.array(leaf[rows]) for name, leaf in self.episode(number).items()}


class D3rlpy(Contender):
    """`ReplayBuffer.append`, `dump` and `load`."""

    note = "everything is in memory until it is dumped, and again when it is loaded; keeps no final state"

    def wrap(self, env: gym.Env[Any, Any], work: Workload, path: Path) -> gym.Env[Any, Any]:
        if isinstance(env.observation_space, gym.spaces.Dict):
            raise CannotError("no Dict observations")
        return _Filling(env, path)

    def _episodes(self, path: Path) -> Any:
        from d3rlpy.dataset import Episode
        from d3rlpy.dataset.io import load

        with path.open("rb") as file:
            return load(Episode, file)

    def listing(self, path: Path) -> Array:
        return np.array([episode.size() for episode in self._episodes(path)])

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        episodes = self._episodes(path)
        return joined([_leaves(episode) for episode in episodes]), np.array([e.size() for e in episodes])

    def field(self, path: Path) -> Array:
        raise CannotError("reads everything")

    def open(self, path: Path) -> Session:
        return _Session(self._episodes(path))
