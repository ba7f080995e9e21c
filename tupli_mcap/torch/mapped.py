"""A map-style dataset: items by number, for any sampler; and a DataLoader of it in one call."""

from __future__ import annotations

import operator
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from torch import Generator
from torch.utils.data import DataLoader, Dataset

from tupli_mcap.dataset.items import Items, Samples, SamplingError
from tupli_mcap.dataset.items.steps import checked_count
from tupli_mcap.errors import did_you_mean
from tupli_mcap.torch.items import WORKER_CACHE_BYTES, ReadItems, check_state, collate

# The further arguments of windows (True) and of transitions.
_OF_ITEMS: Final = {True: ("stride", "pad", "history"), False: ("n_step", "discount")}
_OF_LOADER: Final = ("length", "batch_size", "shuffle", "num_workers", "fields", "seed", "drop_last")


class MapDataset(Dataset[dict[str, Any]]):
    """Windows, transitions or episodes by number, as dicts of tensors (see `tensors`).

        DataLoader(MapDataset(dataset.windows(32)), batch_size=256, shuffle=True, collate_fn=collate)

    A batch is read at once, and `collate` hands it on as it is. PyTorch's own collate function works too, and
    copies. Any sampler works, `DistributedSampler` too; which items it draws does not depend on the workers. Safe
    with fork, spawn and forkserver: each worker opens the files itself.

    Args:
        items: `dataset.windows(...)`, `dataset.transitions(...)`, `Episodes(dataset.steps)`, ...
        worker_cache_bytes: what each worker of a DataLoader keeps decoded.
    """

    def __init__(self, items: Items[Any], *, worker_cache_bytes: int = WORKER_CACHE_BYTES) -> None:
        self._reader = ReadItems(items, worker_cache_bytes)

    def __len__(self) -> int:
        return len(self._reader.items)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self._reader.read(operator.index(index))

    def __getitems__(self, indices: Sequence[int]) -> Samples:
        """The items of a batch, read together."""
        return Samples(self._reader.read(np.asarray(indices)), len(indices))

    def state_dict(self) -> dict[str, Any]:
        """Identifies the items. The position in an epoch is in the state of the sampler."""
        return {"items": self._reader.items.identity}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that the state is one of the same items; SamplingError if not."""
        check_state(state_dict, self._reader.items.identity, {})


def check_arguments(names: Iterable[str], *, of_windows: bool) -> None:
    """Checks what `Dataset.loader` passes on to `windows`, or else to `transitions`.
    TypeError if it takes no such argument."""
    for name in names:
        if name in _OF_ITEMS[of_windows]:
            continue
        hint = did_you_mean(name, (*_OF_LOADER, *_OF_ITEMS[of_windows]))
        if name in _OF_ITEMS[not of_windows]:
            hint = (
                ": it is of single transitions; leave out the length" if of_windows else ": it needs a length"
            )
        raise TypeError(f"loader() got an unexpected argument {name!r}{hint}")


def loader(
    items: Items[Any],
    *,
    batch_size: int,
    shuffle: bool,
    num_workers: int,
    seed: int | None,
    drop_last: bool,
    remote: bool,
) -> DataLoader[Any]:
    """See `Dataset.loader`."""
    checked_count(num_workers, 0, "a number of workers")
    generator = None
    if seed is not None:
        generator = Generator().manual_seed(checked_count(seed, 0, "a seed", (1 << 64) - 1))
    size = checked_count(batch_size, 1, "a batch size")
    if drop_last and len(items) < size:
        raise SamplingError(
            f"expected at least {size} items for one full batch, found {len(items)}; take drop_last=False"
        )
    return DataLoader(
        MapDataset(items),
        size,
        shuffle,
        num_workers=num_workers,
        collate_fn=collate,
        generator=generator,
        drop_last=drop_last,
        persistent_workers=num_workers > 0,
        # what fetches from a server runs in threads, which a fork does not have
        multiprocessing_context="spawn" if remote and num_workers else None,
    )
