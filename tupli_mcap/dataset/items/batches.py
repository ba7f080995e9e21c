"""Reads batches of items in an order, also ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sized
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.order import Numbers
from tupli_mcap.dataset.items.steps import SamplingError, checked_count

if TYPE_CHECKING:
    from tupli_mcap.dataset.items.items import Items
    from tupli_mcap.recording.columns.fields import Parts

__all__ = ["Batches"]

T = TypeVar("T", bound="Parts")


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
        self._drawn: deque[tuple[Array, Future[T] | None]] = deque()

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
                    return
                numbers, future = drawn[0]
                batch = self.items[numbers] if future is None else future.result()
                drawn.popleft()
                yield batch
        finally:
            if drawn and drawn is self._drawn:
                self.numbers.give_back([numbers for numbers, _ in drawn])
                drawn.clear()
            if pool is not None:
                pool.shutdown(cancel_futures=True)

    def state_dict(self) -> dict[str, Any]:
        """The position of the iteration: the next batch is the first one that was not returned."""
        return self.numbers.state_dict([numbers for numbers, _ in self._drawn])

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Makes the next iteration go on from a state.

        Raises:
            SamplingError: it is the state of something else, or of other items.
        """
        self.numbers.load_state_dict(state)
        self._drawn = deque()
