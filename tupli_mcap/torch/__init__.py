"""Datasets for PyTorch's DataLoader over windows, transitions and episodes; `torch` in here is PyTorch itself.

mapped, stream         items by number, for any sampler; batches in a shuffled order
items, packed          columns as tensors; a batch from a worker to the loader
episodes               whole episodes as items
rl, d3rlpy             for TorchRL; for d3rlpy"""

from __future__ import annotations

from tupli_mcap.errors import missing_extra

try:
    import torch  # noqa: F401
except ImportError as err:
    raise missing_extra("tupli_mcap.torch needs PyTorch", "torch") from err

from tupli_mcap.torch.episodes import Episodes
from tupli_mcap.torch.items import WORKER_CACHE_BYTES, collate, tensors
from tupli_mcap.torch.mapped import MapDataset
from tupli_mcap.torch.stream import StreamDataset

__all__ = ["WORKER_CACHE_BYTES", "Episodes", "MapDataset", "StreamDataset", "collate", "tensors"]
