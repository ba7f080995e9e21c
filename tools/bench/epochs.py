"""A shuffled epoch of windows in PyTorch's DataLoader: each contender's own way where it has one, else one by one."""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders import CannotError, Contender
from tools.bench.contenders.base import LOADED
from tools.bench.data import Array, Data
from tools.bench.measure import check
from tools.bench.workloads import SEED, Workload

BATCH = 256
MOST = 20_000  # windows of an epoch


def places_of(data: Data, length: int, stride: int) -> Array:
    """Every `stride`-th window of each episode, as (episode, start)."""
    counts = np.maximum(0, (data.lengths - length) // stride + 1)
    episodes = np.repeat(np.arange(len(counts)), counts)
    starts = (np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)) * stride
    return np.stack([episodes, starts], axis=1)


class OneByOne:
    """A map-style dataset over a session, which every process opens itself."""

    def __init__(
        self, contender: Contender, path: Path, places: Array, length: int, *, batches: bool
    ) -> None:
        self._contender, self._path, self._places, self._length = contender, path, places, length
        self._session: Any = None
        if batches:
            self.__getitems__ = self._batch  # the DataLoader looks for it

    def __len__(self) -> int:
        return len(self._places)

    def _open(self) -> Any:
        if self._session is None:
            self._session = self._contender.open(self._path)
        return self._session

    def __getitem__(self, index: int) -> dict[str, Any]:
        episode, start = self._places[index].tolist()
        found = self._open().window(episode, start, self._length)
        return _numbers(found)

    def _batch(self, indices: Sequence[int]) -> dict[str, Any]:
        import torch

        found = self._open().windows(self._places[list(indices)], self._length)
        return {name: torch.from_numpy(leaf) for name, leaf in _numbers(found).items()}


def _numbers(found: Any) -> dict[str, Any]:
    """What a loader gives: PyTorch knows no texts, so who has no way of its own leaves them out."""
    return {
        name: leaf for name, leaf in found.items() if name.startswith(LOADED) and leaf.dtype.kind not in "OU"
    }


def _as_it_is(batch: Any) -> Any:
    return batch


def epoch(
    contender: Contender, work: Workload, path: Path, data: Data, workers: int, count: int
) -> tuple[float, int]:
    """Seconds of going once through (at most `count` of) the windows in a random order, and how many there were.

    Making the DataLoader and its workers, and opening the files, is part of it.
    """
    import torch
    from torch.utils.data import DataLoader, SubsetRandomSampler

    torch.set_num_threads(1)
    if not hasattr(contender, "loader_parts"):
        contender.open(path).episode(0)  # or it has none
    stride = max(1, work.window // 4)
    places = places_of(data, work.window, stride)
    count = min(count, len(places))
    chosen = np.random.default_rng(SEED).permutation(len(places))[:count]
    want = _sums(data, places[chosen], work.window)
    mapped = in_batches(contender)
    gc.collect()
    began = time.perf_counter()
    collate: Any = None
    if hasattr(contender, "loader_parts"):
        dataset, collate = contender.loader_parts(path, work.window, stride)
        check(len(dataset) == len(places), f"{len(dataset)} windows, not {len(places)}")
    else:
        dataset = OneByOne(contender, path, places, work.window, batches=mapped)
        collate = _as_it_is if mapped else None
    loader = DataLoader(
        dataset,
        batch_size=BATCH,
        sampler=SubsetRandomSampler(chosen.tolist()),
        collate_fn=collate,
        num_workers=workers,
        multiprocessing_context="fork" if workers else None,
    )
    kept = [(batch["rewards"], batch["actions"]) for batch in loader]
    seconds = time.perf_counter() - began
    check(sum(len(rewards) for rewards, _ in kept) == count, "another number of windows")
    got = [
        np.sort(
            np.concatenate(
                [np.asarray(part[i], np.float64).reshape(len(part[i]), -1).sum(1) for part in kept]
            )
        )
        for i in (0, 1)
    ]
    for found, wanted in zip(got, want, strict=True):
        check(np.allclose(found, wanted, rtol=1e-4, atol=1e-4), "other windows")
    return seconds, count


def _sums(data: Data, places: Array, length: int) -> list[Array]:
    """The sums over rewards and over actions of each window, sorted: the same in any order of the windows."""
    rows = (data.starts[places[:, 0]] + places[:, 1])[:, None] + np.arange(length)
    return [
        np.sort(data.leaves[name][rows].astype(np.float64).reshape(len(rows), -1).sum(1))
        for name in ("rewards", "actions")
    ]


def in_batches(contender: Contender) -> bool:
    """Whether its loader reads a batch at once; what one window takes then says nothing of an epoch."""
    return hasattr(contender, "loader_parts") or getattr(contender, "batches", False)


def speed_of_window(seconds: float, budget: float) -> int:
    """How many windows fit into `budget` seconds, where they are read one by one."""
    if not seconds:
        raise CannotError("no windows")
    return int(min(MOST, max(32, budget / seconds)))
