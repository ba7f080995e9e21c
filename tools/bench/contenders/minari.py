"""Minari in its three formats: `DataCollector`, then `create_dataset`."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import CannotError, Contender, Session, joined
from tools.bench.data import Array, flat
from tools.bench.measure import Stopwatch
from tools.bench.workloads import Workload

ID = "bench-v0"


def _leaves(episode: Any) -> dict[str, Any]:
    states = episode.observations
    if isinstance(states, dict):
        states = {key: np.asarray(leaf)[:-1] for key, leaf in states.items()}
    else:
        states = states[:-1]
    return flat(states) | {
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminals": episode.terminations,
        "timeouts": episode.truncations,
    }


class _Session(Session):
    def __init__(self, dataset: Any) -> None:
        super().__init__()
        self._dataset = dataset

    def episode(self, number: int) -> dict[str, Any]:
        return _leaves(self._dataset[number])


class MinariHdf5(Contender):
    """HDF5, Minari's default."""

    fmt = "hdf5"
    note = "recording is the rollout with `DataCollector` and `create_dataset`; images without its lossy default, JPEG"

    def _collector(self, work: Workload, path: Path) -> Any:
        import minari

        path.mkdir(exist_ok=True)
        os.environ["MINARI_DATASETS_PATH"] = str(path)
        warnings.simplefilter("ignore")
        return lambda env: minari.DataCollector(env, data_format=self.fmt, jpeg_encoding=False)

    def record(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        make, env, rollout, rest = self._collector(work, path), work.make(), Stopwatch(), Stopwatch()
        with rollout:
            recorder = make(env)
            steps = work.rollout(recorder, episodes)
        with rest:
            recorder.create_dataset(dataset_id=ID)
            recorder.close()
        self.finishing = rest.seconds / steps
        return rollout.seconds + rest.seconds, steps

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        make, env, watch = self._collector(work, path), work.make(), Stopwatch()
        with watch:
            dataset = self._dataset(path)
            recorder = make(env)
            steps = work.rollout(recorder, episodes)
            recorder.add_to_dataset(dataset)
            recorder.close()
        return watch.seconds, steps

    def _dataset(self, path: Path) -> Any:
        import minari

        os.environ["MINARI_DATASETS_PATH"] = str(path)
        warnings.simplefilter("ignore")
        return minari.load_dataset(ID)

    def listing(self, path: Path) -> Array:
        dataset = self._dataset(path)
        told = dataset.storage.get_episode_metadata(dataset.episode_indices)
        return np.array([int(each["total_steps"]) for each in told])

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        parts = [_leaves(episode) for episode in self._dataset(path).iterate_episodes()]
        return joined(parts), np.array([len(part["rewards"]) for part in parts])

    def field(self, path: Path) -> Array:
        raise CannotError("reads whole episodes")

    def open(self, path: Path) -> Session:
        return _Session(self._dataset(path))

    def select(self, path: Path, least: float) -> dict[str, Any]:
        dataset = self._dataset(path)
        chosen = dataset.filter_episodes(lambda episode: episode.rewards.sum() >= least)
        return joined([_leaves(episode) for episode in chosen.iterate_episodes()])


class MinariArrow(MinariHdf5):
    """Arrow."""

    fmt = "arrow"


class MinariParquet(MinariHdf5):
    """Parquet."""

    fmt = "parquet"
