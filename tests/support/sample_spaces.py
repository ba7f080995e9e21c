"""Spaces of every kind, dtype and nesting, in the manner of Gymnasium's own list of testing spaces."""

from __future__ import annotations

from inspect import signature
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces import (
    Box,
    Dict,
    Discrete,
    Graph,
    MultiBinary,
    MultiDiscrete,
    OneOf,
    Sequence,
    Text,
    Tuple,
)

AnySpace = gym.Space[Any]

_INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)
# Gymnasium 1.0 has no dtype of a Discrete yet.
_DISCRETE_DTYPES = _INTEGERS if "dtype" in signature(Discrete).parameters else ()
_FLOATS = (np.float16, np.float32, np.float64)


def _nested_graphs() -> list[AnySpace]:
    try:
        return [
            Graph(Dict({"a": Discrete(2), "t": Text(2)}), Tuple((Box(0, 1, (2,)), Discrete(3)))),
            Graph(Text(3), Text(2)),
        ]
    except AssertionError:  # the Graphs of Gymnasium 1.0 are of Box and Discrete only
        return []


NESTED_GRAPHS = _nested_graphs()

BOXES: list[AnySpace] = [
    *(Box(0, 100, (3,), dtype) for dtype in (*_INTEGERS, *_FLOATS)),
    *(Box(-5, 5, (), dtype) for dtype in (np.int8, np.int64, *_FLOATS)),
    *(Box(0, 5, (2, 0), dtype) for dtype in (np.uint8, np.float16, np.float64)),
    Box(0, 1, (2, 2), np.bool_),
    Box(0, 1, (), np.bool_),
    Box(-1.0, 1.0),
    Box(np.array([0.0, -10.0], np.float32), np.array([10.0, 10.0], np.float32)),
    Box(np.array([-10.0, -np.inf, 0.1]), np.array([np.inf, 10.0, 0.1]), dtype=np.float64),
    Box(-np.inf, np.inf, (1, 2, 3), np.float16),
    Box(0, 255, (4, 4, 3), np.uint8),
    Box(-np.inf, np.inf, (2,), np.int32),
]

FUNDAMENTAL_SPACES: list[AnySpace] = [
    Discrete(3),
    Discrete(3, start=-1),
    *(Discrete(5, start=2, dtype=dtype) for dtype in _DISCRETE_DTYPES),
    *BOXES,
    MultiDiscrete([2, 2]),
    MultiDiscrete([[2, 3], [3, 2]]),
    MultiDiscrete([3, 4], start=[-10, 10]),
    *(MultiDiscrete([3, 4, 5], dtype=dtype) for dtype in _INTEGERS),
    MultiDiscrete(np.zeros((0, 2), np.int64)),
    MultiBinary(1),
    MultiBinary(8),
    MultiBinary([8]),
    MultiBinary([2, 3]),
    Text(6),
    Text(min_length=3, max_length=6),
    Text(6, charset="abcdef"),
    Text(4, min_length=0, charset='é日本😀"\\\n'),
]

COMPOSITE_SPACES: list[AnySpace] = [
    Tuple([]),
    Tuple([Discrete(5), Discrete(4)]),
    Tuple((Discrete(5), Box(0, 5, (2, 2)), MultiDiscrete([2, 3]))),
    Tuple((Discrete(5), Tuple((Box(0, 255, (3,), np.uint8), Discrete(2))))),
    Tuple((Box(0, 1, (2, 0)), Text(3), Dict({}))),
    Dict({}),
    Dict({"position": Discrete(5), "velocity": Box(-1, 1, (2,))}),
    Dict({"b": Dict({"y": Discrete(2), "x": Box(0, 1, ())}), "a": Tuple((Discrete(3), Text(2)))}),
    Dict(
        [
            ("Zed", Discrete(2)),
            (3, Discrete(3)),
            ((1, "a"), Box(0, 1, (2,), np.float16)),
            ("ä-!", Discrete(4)),
        ]
    ),
    Sequence(Discrete(4)),
    Sequence(Discrete(4), stack=True),
    Sequence(Box(-1, 1, (2, 3))),
    Sequence(Box(-1, 1, (2, 3), np.float16), stack=True),
    Sequence(Box(0, 1, (), np.float64)),
    Sequence(Box(0, 1, (), np.bool_)),
    Sequence(Box(0, 1, (3,), np.bool_), stack=True),
    Sequence(Box(0, 1, (2, 0))),
    Sequence(Box(0, 1, (2, 0)), stack=True),
    Sequence(Text(5)),
    Sequence(Text(5), stack=True),
    Sequence(Dict({"feature": Box(0, 1, (3,)), "name": Text(4)})),
    Sequence(Dict({"feature": Box(0, 1, (3,)), "id": Discrete(5)}), stack=True),
    Sequence(Tuple((Box(0, 1, (2,)), Text(3), Discrete(3, start=1))), stack=True),
    Sequence(Sequence(Discrete(3))),
    Sequence(Sequence(Discrete(3), stack=True), stack=True),
    Sequence(OneOf([Discrete(2), Text(3)])),
    Sequence(Graph(Discrete(3), None)),
    Sequence(Dict({})),
    Graph(Box(-1, 1, (2,)), Box(-1, 1, (1,))),
    Graph(Discrete(5), Box(-1, 1, (1,), np.float64)),
    Graph(Box(-1, 1, (2, 2), np.float16), None),
    Graph(Discrete(3), Discrete(4, start=-2)),
    *NESTED_GRAPHS,
    OneOf([Discrete(3), Box(0, 1, (2,))]),
    OneOf([MultiBinary(3), Text(3), Discrete(2), Box(0, 1, (2, 0)), Box(0, 1, ())]),
    OneOf(
        [Tuple((Discrete(3), Text(2))), Dict({"a": Sequence(Discrete(2))}), Graph(Discrete(2), Discrete(3))]
    ),
    OneOf([Sequence(Box(0, 1, (2,)), stack=True), OneOf([Discrete(2), Text(2)])]),
    Dict(
        {
            "graph": Graph(Box(-1, 1, (2,)), Discrete(3)),
            "words": Sequence(Text(4)),
            "pick": OneOf([Discrete(2)]),
        }
    ),
]

SPACES: list[AnySpace] = FUNDAMENTAL_SPACES + COMPOSITE_SPACES


def space_id(space: object) -> str:
    """A short, printable test id."""
    return repr(space).encode("ascii", "replace").decode()[:60]
