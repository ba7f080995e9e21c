"""Draws item numbers without end, in batches: seeded, and resumable from a saved state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.order import check_state, checked_seed, seeded
from tupli_mcap.dataset.items.steps import Numbered, SamplingError, checked_count, checked_numbers
from tupli_mcap.schema import BaseFilter, F

Weights = Array | Sequence[float] | F | BaseFilter
_DRAWS = 0  # the stream of random numbers; an `Order` has another


class Sampler:
    """Draws batches of item numbers without end, with replacement; a seed always gives the same batch i.

    Args:
        batch_size: numbers in a batch.
        by: "steps" draws from all items with equal chances; "episodes" first draws an episode that has items, then
            one of its items, so that long episodes weigh no more than short ones.
        weights: one for each item, or with `by="episodes"` one for each episode of the dataset; chances are
            proportional to them. `update` changes them in logarithmic time. An expression, such as
            `F("metadata.score")` or `F("metadata.score") > 3`, is the weight of an episode; with `by="steps"`, of each
            of its items.
        seed: an integer from 0; None takes a random one.

    Raises:
        SamplingError: an argument is invalid, or weights are negative, NaN, infinite, all zero or too few.
    """

    def __init__(
        self,
        items: Numbered,
        batch_size: int,
        *,
        by: Literal["steps", "episodes"] = "steps",
        weights: Weights | None = None,
        seed: int | None = None,
    ) -> None:
        if by not in ("steps", "episodes"):
            raise SamplingError(f"expected by to be 'steps' or 'episodes', found {by!r:.80}")
        self.items_identity = items.identity
        self.batch_size = checked_count(batch_size, 1, "a batch size")
        self.by = by
        self.seed = checked_seed(seed)
        self.batch = 0  # the next one
        self._unused: list[Array] = []
        self._n = len(items)
        self._counts = items.counts() if by == "episodes" else None
        self._firsts = None if self._counts is None else np.cumsum(self._counts) - self._counts
        self._what = "item" if self._counts is None else "episode"
        self._episodes = None if self._counts is None else np.flatnonzero(self._counts)
        if isinstance(weights, F | BaseFilter):
            weights = items.episode_values(weights)
            weights = weights if by == "episodes" else np.repeat(weights, items.counts())
        self._tree = None
        if weights is not None:
            self._tree = _SumTree(
                self._checked(weights, self._n if self._counts is None else len(self._counts))
            )

    def _checked(self, weights: Any, n: int) -> Array:
        try:
            checked = np.asarray(weights)
        except (TypeError, ValueError) as err:  # lists of different lengths
            raise SamplingError(
                f"expected {n} weights, one for each {self._what}, found {weights!r:.80}"
            ) from err
        if checked.shape != (n,) or checked.dtype.kind not in "biuf":
            raise SamplingError(
                f"expected {n} weights, one for each {self._what}, found {checked.dtype} of shape {checked.shape}"
            )
        checked = checked.astype(np.float64)
        usable = _usable(checked, n)
        if not usable.all():
            i = int(np.argmin(usable))
            raise SamplingError(
                f"expected weights from 0 on, found {checked[i]} for {self._what} {i}; their sum must be finite, too"
            )
        if self._counts is not None and len(checked) == len(self._counts):
            # an episode without items cannot be drawn
            checked = np.where(self._counts > 0, checked, 0.0)
        if not checked.any():
            raise SamplingError(
                f"expected a weight above 0, found none for any {self._what} that can be drawn"
            )
        return checked

    def update(self, places: Array | Sequence[int], weights: Array | Sequence[float] | float) -> None:
        """Sets the weights of some items (of some episodes with `by="episodes"`), from the next batch on.

        Args:
            places: the numbers of these items or episodes, integers (n,).
            weights: one for each, numbers (n,), or one number for all.

        Raises:
            SamplingError: the sampler has no weights, a place does not exist, or a weight is invalid.
        """
        if self._tree is None:
            raise SamplingError(
                "expected a sampler with weights, found one without; give weights=... when it is made"
            )
        n = len(self._tree.weights)
        places = checked_numbers(places, f"{self._what}s from 0 to {n - 1}")
        if len(places) and (places.min() < 0 or places.max() >= n):
            raise SamplingError(
                f"expected {self._what}s from 0 to {n - 1}, found {places.min()} to {places.max()}"
            )
        try:
            given = np.broadcast_to(np.asarray(weights, np.float64), places.shape)
        except (TypeError, ValueError) as err:
            raise SamplingError(
                f"expected a weight, or {len(places)} of them, one for each {self._what}, found {weights!r:.80}"
            ) from err
        if not _usable(given, n).all():
            raise SamplingError(
                f"expected weights from 0 on, of a finite sum, found {given.min()} to {given.max()}"
            )
        if self._counts is not None:
            given = np.where(self._counts[places] > 0, given, 0.0)
        self._tree.update(places, given)

    @property
    def weights(self) -> Array | None:
        """A copy of the current weights (float64); None if all are equal."""
        return None if self._tree is None else self._tree.weights.copy()

    def draw(self, number: int) -> Array:
        """Batch `number` of this seed, drawn with the current weights: int64 (batch_size,)."""
        random = seeded(self.seed, _DRAWS, checked_count(number, 0, "the number of a batch"))
        if self._tree is not None:
            if not self._tree.total > 0:
                raise SamplingError(f"expected a weight above 0, found 0 for every {self._what}")
            places = self._tree.find(random.random(self.batch_size) * self._tree.total)
        elif self._episodes is not None:
            places = self._episodes[random.integers(0, len(self._episodes), self.batch_size)]
        else:
            return random.integers(0, self._n, self.batch_size)
        if self._counts is None or self._firsts is None:
            return places
        return self._firsts[places] + random.integers(0, self._counts[places])

    def __iter__(self) -> Iterator[Array]:
        return self

    def __next__(self) -> Array:
        if self._unused:
            return self._unused.pop(0)
        self.batch += 1
        return self.draw(self.batch - 1)

    def give_back(self, batches: Sequence[Array]) -> None:
        """Takes back batches that were drawn and not used: they come first again."""
        self._unused = [*batches, *self._unused]

    def state_dict(self, unused: Sequence[Array] | None = None) -> dict[str, Any]:
        """The position; weights are in it as bytes (float64), which `torch.load` also takes."""
        return {
            "kind": f"{type(self).__name__} by {self.by}",
            "items": self.items_identity,
            "batch_size": self.batch_size,
            "seed": self.seed,
            "batch": self.batch,
            "unused": [batch.tolist() for batch in (*(unused or ()), *self._unused)],
            "weights": None if self._tree is None else self._tree.weights.tobytes(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes on from a state. SamplingError if it is the state of something else, or of other items."""
        check_state(state, self.state_dict())
        seed, batch = checked_seed(state["seed"]), checked_count(state["batch"], 0, "a batch")
        unused = self._checked_unused(state["unused"])
        weights = state["weights"]
        if (self._tree is None) != (weights is None):
            raise SamplingError(
                f"expected the state of a sampler {'without' if self._tree is None else 'with'} weights, as this one is"
            )
        if self._tree is not None:
            if not isinstance(weights, bytes) or len(weights) % 8:
                raise SamplingError(f"expected weights as bytes in a state, found {weights!r:.80}")
            self._tree = _SumTree(self._checked(np.frombuffer(weights), len(self._tree.weights)))
        self.seed, self.batch, self._unused = seed, batch, unused

    def _checked_unused(self, batches: Any) -> list[Array]:
        if not isinstance(batches, list):
            raise SamplingError(f"expected a list of unused batches in a state, found {batches!r:.80}")
        unused = [checked_numbers(batch, "unused numbers of items") for batch in batches]
        if any(len(batch) and not 0 <= batch.min() <= batch.max() < self._n for batch in unused):
            raise SamplingError(f"expected unused numbers of items from 0 to {self._n - 1}, found others")
        return unused


def _usable(weights: Array, n: int) -> Array:
    """A mask of the weights that are usable: not negative, and so small that the sum of n of them is finite."""
    return (weights >= 0) & (weights <= np.finfo(np.float64).max / n)


class _SumTree:
    """Weights in a binary tree of sums: node i is the sum of 2i and 2i + 1, the leaves are the weights.

    Drawing from them and changing them takes logarithmic time.

    Args:
        weights: at least one, none negative, NaN or infinite; copied.
    """

    def __init__(self, weights: Array) -> None:
        self._n = len(weights)
        self._size = 1 << max(0, self._n - 1).bit_length()
        self._nodes = np.zeros(2 * self._size)
        self._nodes[self._size : self._size + self._n] = weights
        level = self._size
        while level > 1:
            children = self._nodes[level : 2 * level]
            self._nodes[level // 2 : level] = children[0::2] + children[1::2]
            level //= 2

    @property
    def total(self) -> float:
        return float(self._nodes[1])

    @property
    def weights(self) -> Array:
        """A view of the weights (float64)."""
        return self._nodes[self._size : self._size + self._n]

    def update(self, places: Array, weights: Array) -> None:
        """Sets some weights; if a place occurs several times, the last one counts."""
        self._nodes[self._size + places] = weights
        nodes = np.unique(self._size + places) >> 1
        while len(nodes) and nodes[0] > 0:
            nodes = nodes[np.concatenate([[True], nodes[1:] != nodes[:-1]])]  # ascending still
            self._nodes[nodes] = self._nodes[2 * nodes] + self._nodes[2 * nodes + 1]
            nodes = nodes >> 1

    def find(self, points: Array) -> Array:
        """The places where the running sum of the weights passes each of some points from 0 to `total`.

        It never returns a place with weight 0, even after rounding.
        """
        nodes = np.ones(len(points), np.int64)
        left_over = points.astype(np.float64)
        while nodes[:1].any() and nodes[0] < self._size:
            left = self._nodes[2 * nodes]
            right = (left_over >= left) & (self._nodes[2 * nodes + 1] > 0)
            left_over = np.where(right, left_over - left, left_over)
            nodes = 2 * nodes + right
        return nodes - self._size
