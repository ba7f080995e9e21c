#!/usr/bin/env python
"""What random access costs, against memory-mapped `.npy` files: `python tools/bench_sampling.py [--steps 1000000]`.

CartPole-like steps in episodes of 200. The sides take turns, a round of some batches each, and the processor's time
counts, so that other work on the machine matters less; the arrays of both are compared first. With Minari installed,
single windows are compared with it, too.
"""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from benchmarks import peers
from benchmarks.workloads import SEED, Workload, noise4

from tupli_mcap import RecordEpisodes, Recording, TupliDataset
from tupli_mcap.sampling import MemorySteps, Windows

NAMES = ("states", "actions", "rewards", "terminals", "timeouts")
EPISODE = 200
WINDOW = 32
BATCH = 256
Array = np.ndarray[Any, Any]


class Table(gym.Env[Any, Any]):
    """States out of a table, episodes of 200 steps; actions of two kinds."""

    observation_space = gym.spaces.Box(-10, 10, (4,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self) -> None:
        self._table, self._i = noise4(), 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._t = 0
        return self._table[self._i % len(self._table)], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._t, self._i = self._t + 1, self._i + 1
        return self._table[self._i % len(self._table)], 1.0, self._t == EPISODE, False, {}


def record(directory: Path, steps: int) -> Path:
    path = directory / "steps.mcap"
    actions = np.random.default_rng(SEED).integers(0, 2, 1009).tolist()
    with RecordEpisodes(Table(), path) as env:
        Workload("table", Table, actions).rollout(env, steps // EPISODE)
    return path


def mapped_npy(directory: Path, path: Path) -> dict[str, Array]:
    """The columns as a user would keep them: a file each, mapped into memory."""
    with Recording(path) as recording:
        columns = recording.read()
    found = {}
    for name in NAMES:
        np.save(directory / f"{name}.npy", getattr(columns, name))
        found[name] = np.load(directory / f"{name}.npy", mmap_mode="r")
    return found


def epoch_sides(
    path: Path, columns: Mapping[str, Array], directory: Path
) -> dict[str, Callable[[Array], Any]]:
    """What gives a batch of windows, by the numbers of windows."""
    recorded = TupliDataset.from_files(path).windows(WINDOW)
    materialized = TupliDataset.from_files(path)
    materialized.materialize(directory / "columns")
    loaded = Windows(MemorySteps(TupliDataset.from_files(path)._query.read(NAMES), recorded.source), WINDOW)
    per_episode = EPISODE - WINDOW + 1
    ahead = np.arange(WINDOW)

    def npy(items: Array) -> dict[str, Array]:
        starts = items // per_episode * EPISODE + items % per_episode
        rows = starts[:, None] + ahead
        return {name: column[rows] for name, column in columns.items()}

    return {
        ".npy, mapped": npy,
        "recording, warm": recorded.__getitem__,
        "materialized": materialized.windows(WINDOW).__getitem__,
        "in memory": loaded.__getitem__,
    }


def epochs(sides: dict[str, Callable[[Array], Any]], count: int, rounds: int) -> None:
    """A shuffled epoch of windows in batches."""
    items = np.arange(0, count, max(1, count // 5000))
    expected = sides[".npy, mapped"](items)
    for name, side in sides.items():
        found = side(items)
        same = found if isinstance(found, dict) else found.asdict()
        assert all(np.array_equal(same[key], expected[key]) for key in NAMES), name
    random = np.random.default_rng(SEED)
    times: dict[str, list[float]] = {name: [] for name in sides}
    for _ in range(rounds):
        order = random.permutation(count)[: 60 * BATCH].reshape(-1, BATCH)
        for name, side in sides.items():
            start = time.process_time()
            for batch in order:
                side(batch)
            times[name].append((time.process_time() - start) / len(order) * 1e6)
    base = times[".npy, mapped"]
    print(f"A batch of {BATCH} windows of {WINDOW} steps, five columns (must reach 0.7 of .npy):")
    for name, values in times.items():
        speed = statistics.median(a / b for a, b in zip(base, values, strict=True))
        print(
            f"  {name:18} {min(values):8.0f} us at best, {statistics.median(values):8.0f} median, {speed:5.2f} x .npy"
        )


def single(path: Path, rounds: int, steps: int) -> None:
    """One window at a random place: warm, and cold with the recording just opened."""
    warm = TupliDataset.from_files(path).windows(WINDOW)
    warm[np.arange(0, len(warm), 100)]
    random = np.random.default_rng(SEED)
    values: dict[str, list[float]] = {"recording, warm": [], "recording, cold": [], "Minari, HDF5": []}
    with tempfile.TemporaryDirectory() as home:
        dataset = minari_dataset(Path(home), steps)
        for _ in range(rounds):
            chosen = random.integers(0, len(warm), 200).tolist()
            values["recording, warm"] += [timed(warm, i) for i in chosen]
            for i in chosen[:10]:  # opening is not counted: Minari's dataset is open, too
                values["recording, cold"].append(timed(TupliDataset.from_files(path).windows(WINDOW), i))
            if dataset is not None:
                values["Minari, HDF5"] += [timed(dataset, i) for i in chosen[:50]]
    print(f"One window of {WINDOW} steps (warm must reach 1/10 of Minari, cold 1):")
    theirs = statistics.median(values["Minari, HDF5"]) if dataset is not None else None
    for name, found in values.items():
        if found:
            median = statistics.median(found)
            ratio = "" if theirs is None else f", {median / theirs:6.3f} of Minari"
            print(f"  {name:18} {median:8.0f} us median{ratio}")


class MinariWindows:
    """Windows of a Minari dataset."""

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset

    def __getitem__(self, i: int) -> Any:
        episode, start = self._dataset[i % len(self._dataset)], i % (EPISODE - WINDOW)
        rows = slice(start, start + WINDOW)
        return (
            episode.observations[rows], episode.actions[rows], episode.rewards[rows],
            episode.terminations[rows], episode.truncations[rows],
        )  # fmt: skip


def timed(items: Any, i: int) -> float:
    start = time.process_time()
    items[i]
    return (time.process_time() - start) * 1e6


def minari_dataset(home: Path, steps: int) -> Any:
    if peers.missing(peers.MINARI_NEEDS["hdf5"]):
        print("Minari is not installed: pip install -e '.[bench]'")
        return None
    workload = Workload("table", Table, [0, 1])
    return MinariWindows(peers.record_minari(workload, home, "hdf5", max(10, steps // EPISODE // 20))[3])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    directory = Path(tempfile.mkdtemp(prefix="sampling"))
    try:
        path = record(directory, options.steps)
        columns = mapped_npy(directory, path)
        sides = epoch_sides(path, columns, directory)
        epochs(sides, options.steps // EPISODE * (EPISODE - WINDOW + 1), options.rounds)
        single(path, options.rounds, options.steps)
    finally:
        shutil.rmtree(directory)


if __name__ == "__main__":
    main()
