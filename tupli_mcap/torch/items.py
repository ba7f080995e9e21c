"""Items (windows, transitions, episodes) as tensors, and the state dicts of datasets of them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from torch.utils.data import get_worker_info

from tupli_mcap.dataset.items import Items, SamplingError
from tupli_mcap.dataset.items.steps import checked_count
from tupli_mcap.torch.packed import packed
from tupli_mcap.torch.tensors import tensors

WORKER_CACHE_BYTES = 64 << 20


class ReadItems:
    """Reads items as tensors; in a DataLoader's worker within a budget (bytes) of its own, and with one thread."""

    def __init__(self, items: Items[Any], worker_cache_bytes: int) -> None:
        if not isinstance(items, Items):
            raise SamplingError(f"expected items such as dataset.windows(32), found {items!r:.80}")
        self.items = items
        self._worker_cache_bytes = checked_count(worker_cache_bytes, 0, "a budget of workers in bytes")
        self._limited_in = 0  # the worker process that keeps to the budget

    def read(self, index: Any) -> dict[str, Any]:
        """The columns of an item (an integer), or of several (an array of them), by name."""
        if get_worker_info() is None:
            found: dict[str, Any] = tensors(self.items[index].asdict())
            return found
        if self._limited_in != os.getpid():
            self._limited_in = os.getpid()
            self.items.source.limit(self._worker_cache_bytes, 1)
        return packed(self.items[index].asdict())


def check_state(state: Any, identity: str, expected: Mapping[str, Any]) -> None:
    """Checks that a state dict is of these items, with the same options.

    Raises:
        SamplingError: it is of other items, or of other options.
    """
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
