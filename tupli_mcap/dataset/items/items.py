"""The base of windows, transitions and delta windows: items by number, each of which starts at a step; and batches of
them, which may be read ahead."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, Literal, Self, TypeVar, overload

import numpy as np

from tupli_mcap.arrays import Array, arrays_at
from tupli_mcap.dataset.items.draws import Sampler, Weights
from tupli_mcap.dataset.items.order import Numbers, Order, Shuffle
from tupli_mcap.dataset.items.steps import SamplingError, Steps, checked_count, checked_numbers
from tupli_mcap.recording.columns.fields import ColumnDict, Parts
from tupli_mcap.schema import BaseFilter, F

T = TypeVar("T", bound="Parts")
_MANY = 1 << 20  # items that are processed together


class Samples(Sequence[dict[str, Any]]):
    """A batch that was read together: `batch` has its columns; as a sequence, it gives the single samples as views."""

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
        return ColumnDict(
            {
                name: column[i] if isinstance(column, np.ndarray) else arrays_at(column, i)
                for name, column in self.batch.items()
            }
        )


class Items(ABC, Generic[T]):
    """Items by number, each of which belongs to one step of an episode.

    An index gives one item; a slice or an array of numbers gives a batch, which is read together. Negative numbers
    count from the end.

    `parameters` tell these items apart from others of the same steps.
    """

    def __init__(self, steps: Steps, parameters: Sequence[object]) -> None:
        if not hasattr(steps, "breaks"):
            raise SamplingError(f"expected steps, such as dataset.steps, found {steps!r:.80}")
        self.source = steps
        self._values_of: Callable[[F | BaseFilter], Array] | None = None
        told = " ".join(map(repr, (type(self).__name__, *parameters)))
        self.identity = hashlib.sha256(f"{steps.identity} {told}".encode()).hexdigest()
        if not len(steps):
            raise SamplingError("expected at least one step, found an empty dataset; use another filter")
        self._episode_ends = np.cumsum(steps.episode_lengths)

    def _episodes(self, steps: Array) -> Array:
        """The places of the steps' episodes in the dataset."""
        return self._episode_ends.searchsorted(steps, side="right")

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def steps_of(self, items: Array) -> Array:
        """The number of the step that each of some items (int64) belongs to."""

    @abstractmethod
    def counts(self) -> Array:
        """The number of items of each episode (int64); items are in the order of episodes."""

    @abstractmethod
    def _one(self, item: int) -> T: ...

    @abstractmethod
    def _batch(self, items: Array) -> T: ...

    def __getitem__(self, index: int | np.integer[Any] | slice | Sequence[int] | Array) -> T:
        n = len(self)
        if isinstance(index, int | np.integer) and not isinstance(index, bool):
            if not -n <= index < n:
                raise IndexError(f"expected a number from 0 to {n - 1}, found {index}")
            return self._one(int(index) % n)
        if isinstance(index, slice):
            return self._batch(np.arange(*index.indices(n)))
        chosen = checked_numbers(index, f"numbers from 0 to {n - 1}")
        if len(chosen) and (chosen.min() < -n or chosen.max() >= n):
            wrong = chosen[(chosen < -n) | (chosen >= n)][0]
            raise IndexError(f"expected numbers from 0 to {n - 1}, found {wrong}")
        return self._batch(np.where(chosen < 0, chosen + n, chosen))

    def __iter__(self) -> Iterator[T]:
        return map(self._one, range(len(self)))

    def __getitems__(self, indices: Sequence[int]) -> Samples:
        """The items of a batch for a PyTorch `DataLoader`: they are read together, and are dicts, which its own
        collate function understands."""
        return Samples(self[np.asarray(indices)].asdict(), len(indices))

    # ---- in batches

    def sampler(
        self,
        batch_size: int,
        *,
        by: Literal["steps", "episodes"] = "steps",
        weights: Weights | None = None,
        seed: int | None = None,
    ) -> Sampler:
        """A `Sampler` of these items: draws batches of their numbers without end."""
        return Sampler(self, batch_size, by=by, weights=weights, seed=seed)

    def order(
        self,
        batch_size: int,
        *,
        shuffle: Shuffle | Literal[False] = False,
        seed: int | None = None,
        drop_last: bool = False,
    ) -> Order:
        """An `Order` of these items: each number once an epoch, in batches."""
        return Order(self, batch_size, shuffle=shuffle, seed=seed, drop_last=drop_last)

    def batches(self, numbers: Numbers | int, *, read_ahead: int = 0) -> Batches[T]:
        """The items that an order or a sampler gives, read in batches; a number stands for `order(number)`.

        See `Batches`, also for reading ahead.
        """
        if isinstance(numbers, int | np.integer):
            numbers = self.order(numbers)
        return Batches(self, numbers, read_ahead=read_ahead)

    def episode_values(self, expression: F | BaseFilter) -> Array:
        """The value of an expression over `EpisodeHeader` for each episode (float64).

        Raises:
            SamplingError: the items are of no dataset, so their episodes are unknown; or a value is no number.
        """
        if self._values_of is None:
            raise SamplingError(
                f"expected one weight for each episode, found {expression!r:.80}, whose values are only known to "
                "windows and transitions of a dataset"
            )
        return self._values_of(expression)

    def limit(self, cache_bytes: int, threads: int) -> None:
        """As `Steps.limit`, of the steps that are read."""
        self.source.limit(cache_bytes, threads)

    def of_episodes(self, values_of: Callable[[F | BaseFilter], Array]) -> Self:
        """Gives these items a function for the values of expressions over their episodes; returns them."""
        self._values_of = values_of
        return self

    def __getstate__(self) -> dict[str, Any]:
        # a copy in another process reads items and needs no list of episodes
        return {**self.__dict__, "_values_of": None}

    def block_runs(self) -> tuple[Array, Array, Array]:
        """Runs of items in one block of the storage: the first item, the length and the block of each, int64."""
        starts, blocks = [], []
        for first in range(0, len(self), _MANY):
            items = np.arange(first, min(first + _MANY, len(self)))
            block_of = self.source.blocks(self.steps_of(items))
            cuts = np.flatnonzero(np.diff(block_of, prepend=-1))
            starts.append(items[cuts])
            blocks.append(block_of[cuts])
        begin = np.concatenate(starts)
        return begin, np.diff(begin, append=len(self)), np.concatenate(blocks)


class StepItems(Items[T]):
    """Items by the number of a step: each step has one."""

    def __len__(self) -> int:
        return len(self.source)

    def steps_of(self, items: Array) -> Array:
        return items

    def counts(self) -> Array:
        return self.source.episode_lengths


class Batches(Generic[T]):
    """The items whose numbers an `Order` or a `Sampler` gives, one batch after the other.

    Args:
        read_ahead: number of batches that a thread reads while the caller uses the one before; this pays if chunks
            are decompressed or files are slow. A sampler draws these early: weights that change meanwhile apply to
            later batches.

    Raises:
        SamplingError: the numbers are those of other items.
    """

    def __init__(self, items: Items[T], numbers: Numbers, *, read_ahead: int = 0) -> None:
        if not hasattr(numbers, "items_identity"):
            raise SamplingError(f"expected an Order, a Sampler or a batch size, found {numbers!r:.80}")
        if numbers.items_identity != items.identity:
            raise SamplingError("expected numbers of the same items, found those of others")
        self.items = items
        self.numbers = numbers
        self.read_ahead = checked_count(read_ahead, 0, "a number of batches to read ahead")
        self._drawn: deque[tuple[Array, Future[T] | None]] | None = None  # in an iteration, what comes next

    def __len__(self) -> int:
        """Batches in an epoch of an `Order`.

        Raises:
            SamplingError: a `Sampler` has no end.
        """
        if not isinstance(self.numbers, Sized):
            raise SamplingError("expected an Order, which has epochs, found a Sampler, which has no end")
        return len(self.numbers)

    def __iter__(self) -> Iterator[T]:
        source = iter(self.numbers)
        drawn = self._drawn = deque()
        pool = ThreadPoolExecutor(1) if self.read_ahead else None
        try:
            while True:
                while len(drawn) <= self.read_ahead and (numbers := next(source, None)) is not None:
                    drawn.append(
                        (numbers, None if pool is None else pool.submit(self.items.__getitem__, numbers))
                    )
                if not drawn:
                    if drawn is self._drawn:
                        self._drawn = None
                    return
                numbers, future = drawn[0]
                batch = self.items[numbers] if future is None else future.result()
                drawn.popleft()
                yield batch
        finally:
            if drawn is self._drawn:
                self.numbers.give_back([numbers for numbers, _ in drawn])
                self._drawn = None
            if pool is not None:
                pool.shutdown(cancel_futures=True)

    def state_dict(self) -> dict[str, Any]:
        """The position of the iteration: the next batch is the first one that was not returned.

        Behind the last batch of an epoch, nothing is left of that epoch; once it has ended, the next one follows.
        """
        return self.numbers.state_dict(
            None if self._drawn is None else [numbers for numbers, _ in self._drawn]
        )

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Makes the next iteration go on from a state.

        Raises:
            SamplingError: it is the state of something else, or of other items.
        """
        self.numbers.load_state_dict(state)
        self._drawn = None
