"""Weights: drawing from them and changing them takes logarithmic time."""

from __future__ import annotations

import numpy as np

from tupli_mcap.arrays import Array

__all__ = ["SumTree"]


class SumTree:
    """Weights in a binary tree of sums: node i is the sum of 2i and 2i + 1, the leaves are the weights.

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
