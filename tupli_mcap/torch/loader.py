"""A DataLoader of windows or transitions in one call."""

from __future__ import annotations

from typing import Any

from torch import Generator
from torch.utils.data import DataLoader

from tupli_mcap.dataset.items import Items
from tupli_mcap.torch.mapped import MapDataset
from tupli_mcap.torch.tensors import collate


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
    generator = None if seed is None else Generator().manual_seed(seed)
    return DataLoader(
        MapDataset(items),
        batch_size,
        shuffle,
        num_workers=num_workers,
        collate_fn=collate,
        generator=generator,
        drop_last=drop_last,
        persistent_workers=num_workers > 0,
        # what fetches from a server runs in threads, which a fork does not have
        multiprocessing_context="spawn" if remote and num_workers else None,
    )
