"""What values are like, element by element: the same in one piece and in many."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from tupli_mcap.spaces.leaves import Leaf, NameRegistry, flatten_space
from tupli_mcap.spaces.statistics import ElementStatistics, columns_of, element_bounds


def leaf_of(space: gym.Space[Any]) -> Leaf:
    (leaf,) = flatten_space(space, "state", NameRegistry())
    return leaf


def statistics_of(space: gym.Space[Any], values: Any, pieces: int) -> ElementStatistics:
    found = ElementStatistics(leaf_of(space), values.dtype)
    for part in np.array_split(values, pieces):
        found.add(columns_of(part))
    return found


@pytest.mark.parametrize("pieces", [1, 3, 50])
@pytest.mark.parametrize("shape", [(3,), (2, 70)])  # of many elements, columns are not copied
def test_floats(pieces: int, shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    values = 1e3 + rng.normal(size=(40, *shape)).astype(np.float32)
    values[3, 0], values[7, 0], values[:, 1] = np.nan, np.inf, -np.inf
    found = statistics_of(spaces.Box(-np.inf, np.inf, shape, np.float32), values, pieces)
    flat = values.reshape(40, -1).astype(np.float64)
    finite = np.where(np.isfinite(flat), flat, np.nan)
    some = found.finite > 0
    assert found.seen == 40
    np.testing.assert_array_equal(found.nan, np.isnan(flat).sum(axis=0))
    np.testing.assert_array_equal(found.infinite, np.isinf(flat).sum(axis=0))
    np.testing.assert_array_equal(some, np.isfinite(flat).any(axis=0))
    np.testing.assert_allclose(found.mean[some], np.nanmean(finite[:, some], axis=0))
    np.testing.assert_allclose(found.std[some], np.nanstd(finite[:, some], axis=0), rtol=1e-6)
    np.testing.assert_array_equal(found.least[some], np.nanmin(finite[:, some], axis=0))
    np.testing.assert_array_equal(found.most[some], np.nanmax(finite[:, some], axis=0))
    assert np.isnan(found.mean[~some]).all()
    assert np.isnan(found.std[~some]).all()


@pytest.mark.parametrize("pieces", [1, 4])
def test_choices(pieces: int) -> None:
    values = np.array([[0, 5], [2, 7], [2, 5], [9, 6]])  # 9 is none of them
    found = statistics_of(spaces.MultiDiscrete([3, 4], start=[0, 5]), values, pieces)
    assert [counts.tolist() for counts in found.choices] == [[1, 0, 2], [2, 1, 1, 0]]
    assert found.low.tolist() == [0, 5]
    assert found.high.tolist() == [2, 8]
    assert found.most.tolist() == [9, 7]


def test_choices_as_far_from_the_space_as_can_be() -> None:
    ends = np.iinfo(np.int64)
    found = statistics_of(spaces.Discrete(4, start=-5), np.array([-5, ends.max, -2, ends.min]), 1)
    assert [counts.tolist() for counts in found.choices] == [[1, 0, 0, 1]]


def test_chosen_elements() -> None:
    space = spaces.Box(np.arange(6.0), np.arange(6.0) + 1, dtype=np.float64)
    found = ElementStatistics(leaf_of(space), np.dtype(np.float64), np.array([1, 4]))
    found.add(columns_of(np.array([[1.5, 4.5]])))
    assert found.low.tolist() == [1, 4]
    assert found.mean.tolist() == [1.5, 4.5]


def test_bounds_beyond_int64() -> None:
    space = spaces.Discrete(2**63 - 1, start=2**62)
    low, high = element_bounds(leaf_of(space))
    assert (int(low[0]), int(high[0])) == (2**62, 2**63 - 1)
    assert ElementStatistics(leaf_of(space), np.dtype(np.int64)).choices == []
