"""PyTupli: `TupliEnvWrapper` into a `FileStorage`."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import CannotError, Contender
from tools.bench.data import Array, Data
from tools.bench.measure import Stopwatch
from tools.bench.workloads import STEPS, Workload


def _returns() -> Any:
    """A callback that keeps the return with each episode, which is what its filters need."""
    from pytupli.benchmark import EpisodeMetadataCallback

    class Returns(EpisodeMetadataCallback):  # type: ignore[misc]
        def __init__(self) -> None:
            self.reset()

        def reset(self) -> None:
            self.total = 0.0

        def __call__(self, tuple: Any) -> dict[str, Any]:
            self.total += tuple.reward
            return {"return_": self.total}

    return Returns()


class PyTupli(Contender):
    """Its states are those after the action: the one of a reset is lost. Episodes come back in no order."""

    note = "its states are those after the action, checked as such; episodes come back in no particular order"

    def record(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        return self._rollout(work, path, episodes)

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        return self._rollout(work, path, episodes)

    def _rollout(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        from pytupli.benchmark import TupliEnvWrapper

        if work.table == "mission":
            raise CannotError("only arrays as observations")
        warnings.simplefilter("ignore")
        storage = self._storage(path)
        found = storage.list_benchmarks()
        if found:
            benchmark = found[0].id
        else:
            first = TupliEnvWrapper(work.make(), storage=storage)
            first.store(name="bench")
            benchmark = first.id
        env, watch = work.make(), Stopwatch()
        with watch:
            recorder = TupliEnvWrapper(
                env, storage=storage, benchmark_id=benchmark, metadata_callback=_returns()
            )
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def _storage(self, path: Path) -> Any:
        from pytupli.storage import FileStorage

        logging.getLogger("pytupli").setLevel(logging.ERROR)
        return FileStorage(str(path))

    def listing(self, path: Path) -> Array:
        return np.array([header.n_tuples for header in self._storage(path).list_episodes()])

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        return self._tensors(path, None), None

    def _tensors(self, path: Path, chosen: Any) -> dict[str, Any]:
        from pytupli.dataset import TupliDataset

        dataset = TupliDataset(self._storage(path))
        if chosen is not None:
            dataset = dataset.with_episode_filter(chosen)
        dataset.load()
        return dict(zip(("states", *STEPS), dataset.convert_to_tensors(), strict=True))

    def select(self, path: Path, least: float) -> dict[str, Any]:
        from pytupli.schema import FilterGEQ

        return self._tensors(path, FilterGEQ(key="metadata.return_", value=least))

    def field(self, path: Path) -> Array:
        raise CannotError("reads whole episodes")

    def open(self, path: Path) -> Any:
        raise CannotError("loads all episodes that match a filter; there is no access to one of them")

    def wanted(self, data: Data) -> Data:
        leaves = dict(data.leaves)
        after = np.empty_like(leaves["states"])
        after[:-1] = leaves["states"][1:]
        after[data.starts + data.lengths - 1] = data.finals["states"]
        return Data({**leaves, "states": after}, data.lengths)
