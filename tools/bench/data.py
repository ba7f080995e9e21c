"""What every contender records and must give back: steps as columns, one leaf of the spaces each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tools.bench.measure import check

Array = NDArray[Any]


@dataclass(frozen=True)
class Data:
    """Whole episodes.

    Attributes:
        leaves: "states" (or "states.<key>" of a Dict), "actions", "rewards", "terminals", "timeouts"; a row a step.
        lengths: steps of each episode (int64).
        finals: the state after the last step of each episode, by leaf; empty where nobody asked.
    """

    leaves: dict[str, Array]
    lengths: Array
    finals: dict[str, Array] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """Number of rows."""
        return int(self.lengths.sum())

    @property
    def starts(self) -> Array:
        """The first row of each episode."""
        return np.cumsum(self.lengths) - self.lengths

    @property
    def returns(self) -> Array:
        """The sum of the rewards of each episode."""
        return np.add.reduceat(self.leaves["rewards"].astype(np.float64), self.starts)

    def head(self, episodes: int) -> Data:
        """The first episodes."""
        return self.take(range(min(episodes, len(self.lengths))))

    def take(self, episodes: Any) -> Data:
        """Some episodes, in that order."""
        chosen = np.asarray(episodes, np.int64)
        lengths = self.lengths[chosen]
        if len(chosen) and (chosen == np.arange(len(chosen))).all():
            rows: Any = slice(0, int(lengths.sum()))
        else:
            rows = np.concatenate(
                [np.arange(s, s + n) for s, n in zip(self.starts[chosen], lengths, strict=True)]
            )
        return Data(
            {name: leaf[rows] for name, leaf in self.leaves.items()},
            lengths,
            {name: leaf[chosen] for name, leaf in self.finals.items()},
        )

    def twice(self, episodes: int) -> Data:
        """Itself, and its first episodes again: what is there after appending."""
        more = self.head(episodes)
        leaves = {name: np.concatenate([leaf, more.leaves[name]]) for name, leaf in self.leaves.items()}
        return Data(leaves, np.concatenate([self.lengths, more.lengths]))

    def rows(self, episode: int, start: int = 0, length: int | None = None) -> dict[str, Array]:
        """The leaves of (a part of) an episode."""
        first = int(self.starts[episode]) + start
        last = first + (int(self.lengths[episode]) if length is None else length)
        return {name: leaf[first:last] for name, leaf in self.leaves.items()}

    def episodes_for(self, steps: float) -> int:
        """How many whole episodes make up at least `steps` steps (all where there are fewer)."""
        ends = np.cumsum(self.lengths)
        return min(int(np.searchsorted(ends, steps)) + 1, len(ends))

    def best(self, share: float = 0.01) -> tuple[float, Array]:
        """A return that about `share` of the episodes reach, between two of them, and which episodes do."""
        distinct = np.unique(self.returns)
        at = max(1, int(len(distinct) * (1 - share)))
        if len(distinct) < 2:
            return float(distinct[0]) - 0.5, np.arange(len(self.lengths))
        limit = (
            float((distinct[at - 1] + distinct[at]) / 2) if at < len(distinct) else float(distinct[-1]) - 1e-3
        )
        return limit, np.flatnonzero(self.returns >= limit)

    def save(self, path: Path) -> None:
        """Writes it for other processes."""
        final = {f"final:{name}": leaf for name, leaf in self.finals.items()}
        np.savez(path, lengths=self.lengths, **self.leaves, **final)

    @classmethod
    def load(cls, path: Path) -> Data:
        """Reads what `save` wrote."""
        with np.load(path) as file:
            leaves = {name: file[name] for name in file.files}
        finals = {
            name.removeprefix("final:"): leaves.pop(name)
            for name in list(leaves)
            if name.startswith("final:")
        }
        return cls(leaves, leaves.pop("lengths"), finals)


def flat(states: Any) -> dict[str, Any]:
    """The leaves of states, as an array or a (nested) dict of them."""
    if isinstance(states, Mapping):
        return {f"states.{key}": leaf for key, leaf in states.items()}
    return {"states": states}


def check_same(found: Mapping[str, Any], wanted: Mapping[str, Array], only: Any = None) -> bool:
    """Compares leaf by leaf.

    Returns:
        Whether a number came back in a narrower type than it had (equal after the same rounding).

    Raises:
        WrongResultError: a leaf is missing or differs.
    """
    narrowed = False
    for name in only or wanted:
        check(name in found, f"no {name}")
        have, want = np.asarray(found[name]), wanted[name]
        if want.dtype.kind == "U":
            have = have.astype(want.dtype)
        have = have.reshape(want.shape) if have.size == want.size else have
        check(have.shape == want.shape, f"{name} of shape {have.shape}, not {want.shape}")
        if not np.array_equal(have, want):
            check(have.dtype.itemsize < want.dtype.itemsize, f"other {name}")
            check(np.array_equal(have, want.astype(have.dtype)), f"other {name}")
            narrowed = True
    return narrowed
