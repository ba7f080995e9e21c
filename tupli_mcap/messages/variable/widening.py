"""Finds the numbers inside a value of variable size that need a wider dtype than their space declares.

A path starts after the value itself: `[]` is an item of a Sequence, `['a']` an entry of a Dict, `[1]` one of
a Tuple or an option of a OneOf; `.nodes`, `.edges` and `.edge_links` are parts of a Graph.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import DType
from tupli_mcap.spaces.exact import decide_dtype
from tupli_mcap.spaces.leaves import CONSTANT, Leaf

EDGE_LINKS = np.dtype(np.int32)  # of Gymnasium's samples; a Graph space declares none


def variable_dtypes(space: gym.Space[Any], values: Sequence[Any], path: str) -> dict[str, str]:
    """Return path and dtype name of the leaves that `values` (a recording's first) need wider than declared.

    Each such leaf gets a warning, in which `path` names the value. Values of another structure are ignored here and
    refused when they are stored. Raises StepError if a leaf has values of a dtype no message can hold.
    """
    declared: dict[str, DType] = {}
    found: dict[str, list[Any]] = {}
    for value in values:
        for where, dtype, number in _numbers(space, value, ""):
            declared[where] = dtype
            found.setdefault(where, []).append(number)
    dtypes = {}
    for where, dtype in declared.items():
        leaf = Leaf((), path + where, "", space, "array", dtype, ())
        wide = decide_dtype(leaf, found[where])
        if wide != dtype:
            dtypes[where] = wide.name
    return dtypes


Numbers = Iterator[tuple[str, DType, Any]]


def _numbers(space: gym.Space[Any], value: Any, path: str) -> Numbers:
    """Every array or scalar in one value of a space, with its path and its declared dtype."""
    if type(space) in CONSTANT:
        yield path, np.dtype(space.dtype), value
    elif type(space) is spaces.Dict or type(space) is spaces.Tuple:
        for key, sub, item in _entries(space, value):
            yield from _numbers(sub, item, f"{path}[{key!r}]")
    elif type(space) is spaces.Sequence:
        many = _stacked if space.stack else _items
        yield from many(space.feature_space, value, f"{path}[]")
    elif type(space) is spaces.OneOf:
        if isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], int | np.integer):
            index, chosen = value
            if 0 <= index < len(space.spaces):
                yield from _numbers(space.spaces[index], chosen, f"{path}[{index}]")
    elif type(space) is spaces.Graph and isinstance(value, spaces.GraphInstance):
        yield from _stacked(space.node_space, value.nodes, f"{path}.nodes")
        if space.edge_space is not None and value.edges is not None:
            yield from _stacked(space.edge_space, value.edges, f"{path}.edges")
        if value.edge_links is not None:
            yield f"{path}.edge_links", EDGE_LINKS, value.edge_links


def _items(space: gym.Space[Any], value: Any, path: str) -> Numbers:
    for item in value if isinstance(value, tuple) else ():
        yield from _numbers(space, item, path)


def _stacked(space: gym.Space[Any], value: Any, path: str) -> Numbers:
    if type(space) in CONSTANT:
        yield path, np.dtype(space.dtype), value
    elif type(space) is spaces.Dict or type(space) is spaces.Tuple:
        for key, sub, item in _entries(space, value):
            yield from _stacked(sub, item, f"{path}[{key!r}]")
    else:
        yield from _items(space, value, path)


def _entries(space: Any, value: Any) -> Iterator[tuple[Any, gym.Space[Any], Any]]:
    if type(space) is spaces.Dict:
        if isinstance(value, dict):
            yield from ((key, sub, value[key]) for key, sub in space.spaces.items() if key in value)
    elif isinstance(value, tuple):
        yield from ((i, sub, item) for i, (sub, item) in enumerate(zip(space.spaces, value, strict=False)))
