"""Statistics of a stream of unknown length in bounded memory: a sample, the extremes, runs of equal values."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tupli_mcap.recording.blocks import Array

__all__ = ["Extremes", "Run", "Sample", "runs_of_true"]

Locate = Callable[[int], tuple[int, int]]
Run = tuple[int, int]


class Sample:
    """Every `stride`-th of the values seen; the stride doubles when there are `capacity` of them. Deterministic."""

    def __init__(self, capacity: int = 1 << 16) -> None:
        self._capacity = capacity
        self._stride = 1
        self._next = 0  # index, in the next block, of the next value to keep
        self._kept: list[Array] = []
        self._size = 0
        self.seen = 0

    def put(self, values: Array) -> None:
        kept = values[self._next :: self._stride]
        self._next = (self._next - len(values)) % self._stride
        self.seen += len(values)
        self._kept.append(kept.copy())
        self._size += len(kept)
        while self._size > self._capacity:
            whole = np.concatenate(self._kept)
            # What comes next continues the pattern of the values that stay.
            if len(whole) % 2:
                self._next += self._stride
            self._kept = [whole[::2].copy()]
            self._size = len(self._kept[0])
            self._stride *= 2

    @property
    def values(self) -> Array:
        return np.concatenate(self._kept) if self._kept else np.empty(0)


class Extremes:
    """The `k` largest of the values seen, each with its place; equal ones: the first."""

    def __init__(self, k: int = 64) -> None:
        self._k = k
        self._found: list[tuple[float, tuple[int, int]]] = []
        self._least = -np.inf

    def put(self, values: Array, locate: Locate) -> None:
        candidates = np.flatnonzero(values > self._least) if self._found else np.arange(len(values))
        if len(candidates) > self._k:
            order = np.argsort(-values[candidates], kind="stable")
            candidates = candidates[order[: self._k]]
        if not len(candidates):
            return
        self._found += [(float(values[i]), locate(int(i))) for i in candidates]
        self._found.sort(key=lambda item: (-item[0], item[1]))
        del self._found[self._k :]
        if len(self._found) == self._k:
            self._least = self._found[-1][0]

    @property
    def largest(self) -> list[tuple[float, tuple[int, int]]]:
        """(value, (episode, step)), largest first."""
        return self._found


def runs_of_true(flags: Array) -> tuple[Array, Array]:
    """First index and length of every run of True."""
    edges = np.flatnonzero(np.diff(flags, prepend=False, append=False))
    return edges[::2], edges[1::2] - edges[::2]
