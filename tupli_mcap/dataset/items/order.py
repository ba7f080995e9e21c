"""Gives every item's number once an epoch, in batches: in order or shuffled, seeded, resumable from a saved state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.recorded import CACHE_BYTES
from tupli_mcap.dataset.items.shuffle import Blocks, ShuffledBatches, mixing
from tupli_mcap.dataset.items.steps import Numbered, SamplingError, checked_count

Shuffle = Literal["exact", "blocks"]
_EPOCHS = 1  # the stream of random numbers; a `Sampler` has another
_SHUFFLES = (False, "exact", "blocks")


class Numbers(Protocol):
    """Batches of item numbers (int64), one after the other.

    `items_identity` identifies the items; `give_back` takes back the last batches if they were not used.
    """

    items_identity: str

    def __iter__(self) -> Iterator[Array]: ...

    def give_back(self, batches: Sequence[Array]) -> None:
        """Takes back batches that were drawn and not used: they come first again."""
        ...

    def state_dict(self, unused: Sequence[Array] | None = None) -> dict[str, Any]:
        """The position, as plain numbers, strings, bytes and lists. `unused` are the last batches, to give again; it
        is None unless somebody draws batches early."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from a state. SamplingError if it is the state of something else, or of other items."""
        ...


class Order:
    """Gives every item's number once an epoch, in batches; iterating again begins the next epoch.

    Args:
        batch_size: numbers in a batch; the last one may have fewer.
        shuffle: False keeps their order. "exact" makes all orders equally likely. "blocks" takes chunks in a
            random order, and mixes the items of as many as half the cache holds: each is read about once an epoch.
        seed: an integer from 0; None takes a random one. Each epoch has another order.
        drop_last: leave out a last batch that is not full.

    Raises:
        SamplingError: an argument is invalid.
    """

    def __init__(
        self,
        items: Numbered,
        batch_size: int,
        *,
        shuffle: Shuffle | Literal[False] = False,
        seed: int | None = None,
        drop_last: bool = False,
    ) -> None:
        if shuffle not in _SHUFFLES:
            raise SamplingError(
                f"expected shuffle to be one of {', '.join(map(repr, _SHUFFLES))}, found {shuffle!r:.80}"
            )
        self.items_identity = items.identity
        self.batch_size = checked_count(batch_size, 1, "a batch size")
        self.shuffle, self.drop_last = shuffle, drop_last
        self.seed = checked_seed(seed)
        self.epoch, self.batch = 0, 0  # the next batch
        self._resumed = True
        self._n = len(items)
        self._mix = 0
        self._blocks: Blocks | None = None
        if shuffle == "blocks":
            self._mix, self._blocks = mixing(items, getattr(items.source, "cache_bytes", CACHE_BYTES))
        if not len(self):
            raise SamplingError(
                f"expected at least {batch_size} items for one full batch, found {self._n}; take drop_last=False"
            )

    def __len__(self) -> int:
        """Batches in an epoch."""
        return self._n // self.batch_size if self.drop_last else -(-self._n // self.batch_size)

    def __iter__(self) -> Iterator[Array]:
        if not self._resumed and self.batch:
            self.epoch, self.batch = self.epoch + 1, 0
        self._resumed = False
        return self._rest()

    def _rest(self) -> Iterator[Array]:
        epoch, batches = self.epoch, self._batches(self.epoch)
        for number in range(len(self)):
            batch = next(batches)
            if number < self.batch:
                continue  # before the state that was loaded
            self.batch = number + 1
            yield batch
            if self.epoch != epoch:
                return  # another iteration has begun the next epoch
        self.epoch, self.batch = epoch + 1, 0

    def _batches(self, epoch: int) -> Iterator[Array]:
        if self._blocks is not None:
            key = [self.seed, epoch]
            return iter(ShuffledBatches(self._blocks, self._n, self.batch_size, key, self._mix))
        random = seeded(self.seed, _EPOCHS, epoch)
        order = np.arange(self._n) if self.shuffle is False else random.permutation(self._n)
        return (order[first : first + self.batch_size] for first in range(0, self._n, self.batch_size))

    def give_back(self, batches: Sequence[Array]) -> None:
        """Takes back batches that were drawn and not used: they come first again."""
        state = self.state_dict(batches)
        self.epoch, self.batch = state["epoch"], state["batch"]

    def state_dict(self, unused: Sequence[Array] | None = None) -> dict[str, Any]:
        """The position, as plain numbers and strings. `unused` are the last batches, to give again."""
        epoch, batch = self.epoch, self.batch
        if unused is not None and not batch:  # the last batches of an epoch, even if all of them were used
            epoch, batch = epoch - 1, len(self)
        return {
            "kind": f"{type(self).__name__}, shuffle={self.shuffle}",
            "items": self.items_identity,
            "batch_size": self.batch_size,
            "mix": self._mix,
            "blocks": None if self._blocks is None else self._blocks.digest,
            "seed": self.seed,
            "epoch": epoch,
            "batch": batch - len(unused or ()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from a state. SamplingError if it is the state of something else, or of other items."""
        check_state(state, self.state_dict())
        seed, epoch = checked_seed(state["seed"]), checked_count(state["epoch"], 0, "an epoch")
        self.batch = checked_count(state["batch"], 0, "a batch", len(self))
        self.seed, self.epoch, self._resumed = seed, epoch, True


def seeded(seed: int, stream: int, number: int) -> np.random.Generator:
    """A random generator for one number of a stream; each has another."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, stream, number]))


def checked_seed(seed: object) -> int:
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
    return checked_count(seed, 0, "a seed", (1 << 128) - 1)


def check_state(state: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """Raises SamplingError unless a state is of the same kind, and of the same items."""
    if not isinstance(state, Mapping) or not {"kind", "items"} <= state.keys():
        raise SamplingError(f"expected a state that state_dict() gave, found {state!r:.80}")
    if state["items"] != own["items"]:
        raise SamplingError(
            "expected the state of these items, found that of others: the dataset, its filters or the windows were "
            "changed; begin anew, or use what the state was saved with"
        )
    if state.get("blocks") != own.get("blocks") and state["kind"] == own["kind"]:
        raise SamplingError(
            "expected the state of a shuffle of these blocks, found that of others: the recordings were written "
            "anew, loaded or saved as columns; read them in the same way, or take shuffle='exact'"
        )
    for key in ("kind", "batch_size", "mix"):
        if state.get(key) != own.get(key):
            raise SamplingError(f"expected a state with {key} {own.get(key)!r}, found {state.get(key)!r:.80}")
    if not own.keys() <= state.keys():
        raise SamplingError(f"expected {', '.join(own)} in a state, found {', '.join(map(str, state))}")
