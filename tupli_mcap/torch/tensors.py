"""Columns as tensors, and batches of them.

A tensor has the recorded dtype, float16, bool and all integers too, and shares the memory of its array. PyTorch
computes little with uint16, uint32 and uint64: convert those with `.to(torch.int64)` (uint64 from 2**63 on does not
fit). Values that differ in size (texts, graphs) stay a list.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch.utils.data import default_collate

from tupli_mcap.dataset.items import Samples

__all__ = ["collate", "tensors"]


def tensors(column: Any) -> Any:
    """The column with a tensor in place of each array and number, nested in the same way; lists stay lists."""
    if isinstance(column, np.ndarray):
        return torch.from_numpy(column)
    if isinstance(column, Mapping):
        return {key: tensors(part) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(tensors(part) for part in column)
    return torch.from_numpy(np.asarray(column)) if isinstance(column, np.generic) else column


def collate(samples: Any) -> Any:
    """The `collate_fn` for a DataLoader: a batch that was read together is passed on without a copy.

    Anything else is collated by PyTorch's own function.
    """
    if isinstance(samples, Samples):
        return tensors(samples.batch)
    return samples if isinstance(samples, dict) else default_collate(samples)
