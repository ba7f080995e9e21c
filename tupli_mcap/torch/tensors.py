"""Columns as tensors, and batches of them.

A tensor has the dtype that was recorded, and shares the memory of the array it is made of: float16, bool and all
integers stay what they are. PyTorch computes little with uint16, uint32 and uint64: convert those where they are used,
with `.to(torch.int64)` (uint64 from 2**63 on does not fit). What differs in size (texts, graphs) stays a list.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np
import torch
from torch.utils.data import default_collate


def tensors(column: Any) -> Any:
    """The column with a tensor in place of each array and number, nested as it is; lists stay as they are."""
    if isinstance(column, np.ndarray):
        return torch.from_numpy(column)
    if isinstance(column, Mapping):
        return {key: tensors(part) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(tensors(part) for part in column)
    return torch.from_numpy(np.asarray(column)) if isinstance(column, np.generic) else column


class Samples(Sequence[dict[str, Any]]):
    """A batch that has been read at once: `batch` (columns of `len` samples), and the samples one by one, as views."""

    def __init__(self, batch: dict[str, Any], size: int) -> None:
        self.batch = batch
        self._size = size

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, i: int) -> dict[str, Any]: ...
    @overload
    def __getitem__(self, i: slice) -> list[dict[str, Any]]: ...
    def __getitem__(self, i: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(self._size))]
        if not -self._size <= i < self._size:
            raise IndexError(f"expected a sample from 0 to {self._size - 1}, found {i}")
        return {name: _sample(column, i) for name, column in self.batch.items()}

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[i] for i in range(self._size))


def collate(samples: Any) -> Any:
    """The `collate_fn` for a DataLoader: what was read as one batch goes on as it is, without being copied.

    Anything else is collated as PyTorch does it.
    """
    if isinstance(samples, Samples):
        return samples.batch
    return samples if isinstance(samples, dict) else default_collate(samples)


def _sample(column: Any, i: int) -> Any:
    if isinstance(column, Mapping):
        return {key: _sample(part, i) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(_sample(part, i) for part in column)
    return column[i]
