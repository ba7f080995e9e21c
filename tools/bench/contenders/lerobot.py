"""LeRobotDataset v3: frames are added, an episode at a time is saved; windows are its `delta_timestamps`."""

from __future__ import annotations

import importlib.machinery
import logging
import os
import sys
import types
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.contenders.base import CannotError, Contender, Session
from tools.bench.data import Array
from tools.bench.measure import Stopwatch
from tools.bench.workloads import Workload

FPS = 50
KEYS = {"states": "observation.state", "actions": "action", "rewards": "next.reward"}
KEYS |= {"terminals": "next.terminal", "timeouts": "next.timeout"}


def _library() -> Any:
    """`LeRobotDataset`, for vectors: a stand-in takes the place of torchvision, which only images and videos need."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    os.environ["HF_DATASETS_DISABLE_PROGRESS_BARS"] = "1"
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    if "torchvision" not in sys.modules:
        parts = ("", ".transforms", ".transforms.v2", ".transforms.v2.functional")
        names = [f"torchvision{part}" for part in parts]
        modules = [_Anything(name) for name in names]
        sys.modules.update(zip(names, modules, strict=True))
    import datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    datasets.disable_progress_bars()
    return LeRobotDataset


class _Anything(types.ModuleType):
    """A module in which every name is a class."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__: list[str] = []
        self.__spec__ = importlib.machinery.ModuleSpec(name, None)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        made = type(name, (), {"__init__": lambda self, *_, **__: None})
        setattr(self, name, made)
        return made


class _Adding(gym.Wrapper[Any, Any, Any, Any]):
    def __init__(self, env: gym.Env[Any, Any], dataset: Any) -> None:
        super().__init__(env)
        self._dataset = dataset
        shape = env.action_space.shape
        self._action = (lambda action: action) if shape else (lambda action: np.array([action], np.int64))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        return self._state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        frame = {
            "observation.state": self._state,
            "action": self._action(action),
            "next.reward": np.array([result[1]], np.float64),
            "next.terminal": np.array([result[2]]),
            "next.timeout": np.array([result[3]]),
            "task": "bench",
        }
        self._dataset.add_frame(frame)
        self._state = result[0]
        if result[2] or result[3]:
            self._dataset.save_episode()
        return result

    def close(self) -> None:
        self._dataset.finalize()
        super().close()


class _Session(Session):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._whole = _library()("bench", root=path)
        episodes = self._whole.meta.episodes
        self._starts = np.array(episodes["dataset_from_index"])
        self.lengths = np.array(episodes["length"])
        self._windows: dict[int, Any] = {}

    def episode(self, number: int) -> dict[str, Any]:
        first = int(self._starts[number])
        return _arrays(self._whole.hf_dataset[first : first + int(self.lengths[number])])  # type: ignore[index]

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        if length not in self._windows:
            deltas = {key: [i / FPS for i in range(length)] for key in KEYS.values()}
            self._windows[length] = _library()("bench", root=self._path, delta_timestamps=deltas)
        found = self._windows[length][int(self._starts[number]) + start]
        return {name: found[key].numpy() for name, key in KEYS.items()}


def _arrays(found: Any) -> dict[str, Any]:
    import torch

    return {name: torch.stack(list(found[key])).numpy() for name, key in KEYS.items()}


def _column(column: Any) -> Array:
    """An Arrow column as an array: the quickest way out of its tables."""
    made: Array
    if hasattr(column.type, "value_type"):
        made = column.combine_chunks().flatten().to_numpy(zero_copy_only=False)
        return made.reshape(len(column), -1)
    made = column.to_numpy()
    return made


class LeRobot(Contender):
    """`create`, `add_frame`, `save_episode`, `finalize`."""

    note = (
        "0.4.4 beside a newer PyTorch than it pins (its pins do not install with this one); without torchvision, "
        "of which the registry has no build for that PyTorch, so vectors only"
    )

    def wrap(self, env: gym.Env[Any, Any], work: Workload, path: Path) -> gym.Env[Any, Any]:
        space: Any = env.observation_space
        if isinstance(space, gym.spaces.Dict) or len(space.shape) != 1:
            raise CannotError("vectors only here: torchvision does not install")
        shape = env.action_space.shape or (1,)
        kinds = {
            "observation.state": (space.dtype.name, space.shape),
            "action": (env.action_space.dtype.name, shape),  # type: ignore[union-attr]
            "next.reward": ("float64", (1,)),
            "next.terminal": ("bool", (1,)),
            "next.timeout": ("bool", (1,)),
        }
        features = {
            key: {"dtype": kind, "shape": shape, "names": None} for key, (kind, shape) in kinds.items()
        }
        made = _library().create("bench", FPS, features, root=path, use_videos=False)
        return _Adding(env, made)

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        library, env, watch = _library(), work.make(), Stopwatch()
        with watch:
            recorder = _Adding(env, library("bench", root=path))
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def listing(self, path: Path) -> Array:
        return np.array(_library()("bench", root=path).meta.episodes["length"])

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        dataset = _library()("bench", root=path)
        table = dataset.hf_dataset.with_format("arrow")[:]
        return {name: _column(table[key]) for name, key in KEYS.items()}, np.array(
            dataset.meta.episodes["length"]
        )

    def field(self, path: Path) -> Array:
        return _column(_library()("bench", root=path).hf_dataset.with_format("arrow")[:]["action"])

    def open(self, path: Path) -> Session:
        return _Session(path)
