"""What datasets for PyTorch are made of: anything that gives one item for a number, and a batch for several."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch.utils.data import get_worker_info

from tupli_mcap.sampling import SamplingError, Steps
from tupli_mcap.torch.tensors import tensors

__all__ = ["WORKER_CACHE_BYTES", "Items", "ReadItems", "check_state", "identity_of"]

WORKER_CACHE_BYTES = 64 << 20
Array = np.ndarray[Any, Any]


class Item(Protocol):
    """Columns of one item, or of several."""

    def asdict(self) -> dict[str, Any]: ...


class Items(Protocol):
    """`dataset.windows(...)` and its kin, by number: an array of numbers gives a batch, read together."""

    @property
    def source(self) -> Steps: ...

    def __len__(self) -> int: ...

    def __getitem__(self, index: Any) -> Item: ...

    def first_steps(self, numbers: Array) -> Array:
        """The first step of each of some items; nothing is read."""
        ...


@runtime_checkable
class Caching(Protocol):
    """Steps that keep what they have read."""

    def limit(self, cache_bytes: int, threads: int) -> None: ...


class ReadItems:
    """Reads items as tensors; in a DataLoader's worker within a budget (bytes) of its own, and with one thread."""

    def __init__(self, items: Items, worker_cache_bytes: int) -> None:
        self.items = items
        self._worker_cache_bytes = worker_cache_bytes
        self._limited_in = 0  # the worker process that keeps to the budget

    def read(self, index: Any) -> dict[str, Any]:
        """The columns of an item (an integer), or of several (an array of them), by name."""
        if get_worker_info() is not None and self._limited_in != os.getpid():
            self._limited_in = os.getpid()
            if isinstance(self.items.source, Caching):
                self.items.source.limit(self._worker_cache_bytes, 1)
        found: dict[str, Any] = tensors(self.items[index].asdict())
        return found


def identity_of(items: Items) -> str:
    """A digest of which items these are: the same steps, cut in the same way."""
    options = {name: value for name, value in vars(items).items() if name[0] != "_" and name != "source"}
    told = json.dumps([type(items).__name__, options, len(items), items.source.identity], default=repr)
    return hashlib.sha256(told.encode()).hexdigest()


def check_state(state: Any, identity: str, expected: Mapping[str, Any]) -> None:
    """Sees to it that a state dict is one of these items, with the same options.

    Raises:
        SamplingError: it is another's.
    """
    if not isinstance(state, Mapping) or not {"items", *expected} <= set(state):
        raise SamplingError(
            f"expected the state dict of such a dataset, with {', '.join(['items', *expected])}, found {state!r:.80}"
        )
    if state["items"] != identity:
        raise SamplingError(
            "expected a state dict of the same items, found one of another dataset: the episodes, the filters, or "
            "how items are cut out of them differ; resume with what the state was saved from"
        )
    for name, value in expected.items():
        if state[name] != value:
            raise SamplingError(f"expected a state dict with {name}={value!r}, found {state[name]!r:.80}")
