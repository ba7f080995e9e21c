"""Items (windows, transitions, episodes) as tensors, batches of them, and the state dicts of datasets of them.

A tensor has the recorded dtype, float16, bool and all integers too, and shares the memory of its array. PyTorch
computes little with uint16, uint32 and uint64: convert those with `.to(torch.int64)` (uint64 from 2**63 on does not
fit). Values that differ in size (texts, graphs) stay a list.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch.utils.data import default_collate, get_worker_info

from tupli_mcap.arrays import map_arrays
from tupli_mcap.dataset.items import Items, Samples, SamplingError
from tupli_mcap.dataset.items.steps import checked_count
from tupli_mcap.recording.columns.fields import ColumnDict
from tupli_mcap.torch.packed import packed

WORKER_CACHE_BYTES = 64 << 20


class ReadItems:
    """Reads items as tensors; in a DataLoader's worker within a budget (bytes) of its own, and with one thread."""

    def __init__(self, items: Items[Any], worker_cache_bytes: int) -> None:
        if not isinstance(items, Items):
            raise SamplingError(f"expected items such as dataset.windows(32), found {items!r:.80}")
        self.items = items
        self._worker_cache_bytes = checked_count(worker_cache_bytes, 0, "a budget of workers in bytes")
        self._limited_in = 0  # the worker process that keeps to the budget

    def read(self, index: Any) -> ColumnDict:
        """The columns of an item (an integer), or of several (an array of them), by name."""
        if get_worker_info() is None:
            return ColumnDict(tensors(self.items[index].asdict()))
        if self._limited_in != os.getpid():
            self._limited_in = os.getpid()
            self.items.limit(self._worker_cache_bytes, 1)
        return packed(self.items[index].asdict())


def check_state(state: Any, identity: str, expected: Mapping[str, Any]) -> None:
    """Checks that a state dict is of these items, with the same options.
    SamplingError if it is of other items, or of other options."""
    if not isinstance(state, Mapping) or not {"items", *expected} <= set(state):
        raise SamplingError(
            f"expected a state dict with the keys {', '.join(['items', *expected])}, found {state!r:.80}"
        )
    if state["items"] != identity:
        raise SamplingError(
            "expected a state dict of the same items, found one of other episodes, filters or options of items; "
            "resume with the dataset that the state was saved from"
        )
    for name, value in expected.items():
        if state[name] != value:
            raise SamplingError(f"expected a state dict with {name}={value!r}, found {state[name]!r:.80}")


def tensors(column: Any) -> Any:
    """The column with a tensor in place of each array and number, nested in the same way; lists stay lists."""
    return map_arrays(column, _tensor)


def _tensor(value: Any) -> Any:
    return torch.from_numpy(np.asarray(value)) if isinstance(value, np.ndarray | np.generic) else value


def collate(samples: Any) -> Any:
    """The `collate_fn` for a DataLoader: a batch that was read together is passed on without a copy.

    Anything else is collated by PyTorch's own function.
    """
    if isinstance(samples, Samples):
        return ColumnDict(tensors(samples.batch))
    return samples if isinstance(samples, dict) else default_collate(samples)
