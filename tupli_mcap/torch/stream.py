"""An iterable dataset: batches in a shuffled order that reads each chunk once, over workers and ranks."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch.utils.data import IterableDataset, get_worker_info

from tupli_mcap.dataset.items import Items, SamplingError
from tupli_mcap.dataset.items.shuffle import Blocks, ShuffledBatches, mixing
from tupli_mcap.dataset.items.steps import checked_count
from tupli_mcap.torch.items import WORKER_CACHE_BYTES, ReadItems, check_state


class StreamDataset(IterableDataset[dict[str, Any]]):
    """Whole batches of windows, transitions or episodes, as dicts of tensors (see `tensors`).

        DataLoader(StreamDataset(dataset.windows(32), 256, seed=0), batch_size=None, num_workers=2, collate_fn=collate)

    With a shuffle, chunks are read in a random order, and the items of many chunks at a time are mixed: each chunk is
    read about once an epoch. (`MapDataset` with `shuffle=True` is the exact shuffle.) Every item comes once an epoch,
    in one of the ranks and one of the workers. `state_dict` is the position in the epoch: the next batch. torchdata's
    `StatefulDataLoader` saves and loads it, with the same number of workers; without workers, call it yourself.

    The same seed, epoch and number of workers give the same order. Without a shuffle, the number of workers does not
    matter; nor does it if `streams` is given and a multiple of it. Otherwise each worker reads different chunks.

    Args:
        items: `dataset.windows(...)`, `dataset.transitions(...)`, `Episodes(dataset.steps)`, ...
        batch_size: items of a batch; the last one of an epoch may have fewer.
        seed: decides the order together with `set_epoch`; without `set_epoch` each epoch has the same order, as in
            PyTorch's DistributedSampler. None draws a new order each time from PyTorch's random numbers
            (`torch.manual_seed`), and is for one rank only.
        drop_last: only full batches, and the same number in every rank: training that averages gradients needs this.
        rank, ranks: which of how many parts of the items; by default that of `torch.distributed`, if initialised.
        streams: number of parts of the order; by default the number of workers.
        worker_cache_bytes: budget of each worker for decoded chunks; chunks of half as many bytes are mixed.

    Raises:
        SamplingError: an argument is invalid.
    """

    def __init__(
        self,
        items: Items[Any],
        batch_size: int,
        *,
        shuffle: bool = True,
        seed: int | None = None,
        drop_last: bool = False,
        rank: int | None = None,
        ranks: int | None = None,
        streams: int | None = None,
        worker_cache_bytes: int = WORKER_CACHE_BYTES,
    ) -> None:
        self._reader = ReadItems(items, worker_cache_bytes)
        self._size = checked_count(batch_size, 1, "a batch size")
        self._drop_last, self._seed = drop_last, seed
        self._rank, self._ranks = _place(rank, ranks)
        self._streams = None if streams is None else checked_count(streams, 1, "a number of streams")
        if seed is not None:
            checked_count(seed, 0, "a seed", (1 << 128) - 1)
        elif shuffle and self._ranks > 1:
            raise SamplingError("expected a seed, which all ranks share, found None with several ranks")
        self._mix = 1
        self._blocks: Blocks | None = None
        if shuffle:
            self._mix, self._blocks = mixing(items, worker_cache_bytes)
        self._epoch = torch.zeros((), dtype=torch.int64)
        self._epoch.share_memory_()  # type: ignore[no-untyped-call]  # workers that persist see it change
        self._drawn: tuple[int, int] | None = None  # a worker's seed, and its number of passes
        self._loaded: dict[str, Any] | None = None
        self._state = self._state_of(None, 0)
        if not len(self) and not drop_last:
            raise SamplingError(
                f"expected at least one item for each of {self._ranks} ranks, found {len(items)}; take fewer ranks"
            )
        if not len(self):
            raise SamplingError(
                f"expected at least {self._size * self._ranks} items for one full batch in each rank, found "
                f"{len(items)}; take drop_last=False"
            )

    def set_epoch(self, epoch: int) -> None:
        """Sets the number of the epoch that begins with the next iteration; each epoch has another order.

        Raises:
            SamplingError: it is no integer from 0.
        """
        self._epoch.fill_(checked_count(epoch, 0, "a number of an epoch"))

    def __len__(self) -> int:
        """Batches of an epoch in this rank."""
        return len(self._batches(None, 1))

    def __iter__(self) -> Iterator[dict[str, Any]]:
        info = get_worker_info()
        worker, workers = (0, 1) if info is None else (info.id, info.num_workers)
        key = self._key(None if info is None else info.seed - info.id)
        state, self._loaded = self._loaded, None
        done = 0
        if state is not None:
            if state["workers"] != workers:
                raise SamplingError(
                    f"expected a state dict of a run with {workers} workers (1 stands for none), "
                    f"found {state['workers']!r:.80}"
                )
            key, done = state["key"] or key, state["batches"]  # no key: saved before the first iteration
        self._state = self._state_of(key, done)
        return self._read(key, done, worker, workers)

    def _read(self, key: list[int] | None, done: int, worker: int, workers: int) -> Iterator[dict[str, Any]]:
        batches = self._batches(key, workers)
        mine = len(range(worker, len(batches), workers))
        if done > mine:
            raise SamplingError(
                f"expected a state dict after at most {mine} batches of a worker, found {done}"
            )
        for number in range(worker + done * workers, len(batches), workers):
            batch = self._reader.read(batches[number])
            done += 1
            self._state = self._state_of(key, done)
            yield batch

    def _batches(self, key: list[int] | None, workers: int) -> ShuffledBatches:
        streams = self._streams or workers
        if streams % workers:
            raise SamplingError(
                f"expected a number of workers that divides streams={streams}, found {workers} workers"
            )
        return ShuffledBatches(
            self._blocks, len(self._reader.items), self._size, key, self._mix,
            drop_last=self._drop_last, rank=self._rank, ranks=self._ranks, streams=streams,
        )  # fmt: skip

    def _key(self, worker_seed: int | None) -> list[int] | None:
        """The seed of this epoch's order."""
        if self._blocks is None:
            return None
        if self._seed is not None:
            return [self._seed, int(self._epoch)]
        if worker_seed is None:
            return [int(torch.empty((), dtype=torch.int64).random_())]
        before = self._drawn
        passes = before[1] + 1 if before is not None and before[0] == worker_seed else 0
        self._drawn = worker_seed, passes  # the seed stays the same in workers that persist
        return [worker_seed, passes]

    # ---- the state of an epoch

    def state_dict(self) -> dict[str, Any]:
        """The position in the epoch in this process, for `load_state_dict`."""
        return dict(self._state)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Makes the next iteration go on from a state, in the order of that epoch.

        Raises:
            SamplingError: the state is of another dataset, of other options, or of recordings whose chunks have
                changed. If the number of workers differs, the iteration raises it.
        """
        check_state(state_dict, self._reader.items.identity, self._options())
        if not {"workers", "key", "batches"} <= state_dict.keys():
            raise SamplingError(
                f"expected workers, key and batches in a state dict, found {[*state_dict]!r:.80}"
            )
        checked_count(state_dict["batches"], 0, "a state dict with a number of batches")
        key = state_dict["key"]
        if key is not None and not (isinstance(key, list) and key):
            raise SamplingError(f"expected a list of numbers as the key of a state dict, found {key!r:.80}")
        for part in key or ():
            checked_count(part, 0, "a state dict with a key of numbers", (1 << 128) - 1)
        self._loaded = self._state = dict(state_dict)

    def _options(self) -> dict[str, Any]:
        """The options that the order of an epoch depends on, besides items, workers and key."""
        return {
            "batch_size": self._size,
            "shuffle": self._blocks is not None,
            "drop_last": self._drop_last,
            "rank": self._rank,
            "ranks": self._ranks,
            "streams": self._streams,
            "mix": self._mix,
            "chunks": None if self._blocks is None else self._blocks.digest,
        }

    def _state_of(self, key: list[int] | None, done: int) -> dict[str, Any]:
        info = get_worker_info()
        told = {"workers": 1 if info is None else info.num_workers, "key": key, "batches": done}
        return {"items": self._reader.items.identity, **self._options(), **told}


def _place(rank: int | None, ranks: int | None) -> tuple[int, int]:
    if (rank is None) != (ranks is None):
        raise SamplingError(
            f"expected rank and ranks, or neither of them, found rank={rank!r}, ranks={ranks!r}"
        )
    if rank is None or ranks is None:
        distributed = torch.distributed
        if not (distributed.is_available() and distributed.is_initialized()):
            return 0, 1
        rank, ranks = distributed.get_rank(), distributed.get_world_size()
    if not 0 <= checked_count(rank, 0, "a rank") < checked_count(ranks, 1, "a number of ranks"):
        raise SamplingError(f"expected a rank from 0 to {ranks - 1}, found {rank}")
    return rank, ranks
