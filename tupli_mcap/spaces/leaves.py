"""The leaves of a Gymnasium space: their places in it, and how a message stores them.

A Dict or Tuple is only structure. Everything below it is a leaf: an array or scalar of constant size (Box, Discrete,
MultiDiscrete, MultiBinary), an image, or a value of variable size (Text, Sequence, Graph, OneOf).
"""

from __future__ import annotations

import math
import re
import string
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import DType
from tupli_mcap.errors import SpaceError, did_you_mean
from tupli_mcap.schema.keys import name_within

# The ros2msg primitive of each dtype. float16 has none: its bit pattern is stored, and the channel's metadata says so.
ROS_TYPES: dict[str, str] = {
    "bool": "bool",
    "int8": "int8",
    "uint8": "uint8",
    "int16": "int16",
    "uint16": "uint16",
    "int32": "int32",
    "uint32": "uint32",
    "int64": "int64",
    "uint64": "uint64",
    "float16": "uint16",
    "float32": "float32",
    "float64": "float64",
}

CONSTANT = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
_VARIABLE = (spaces.Text, spaces.Sequence, spaces.Graph, spaces.OneOf)
MAX_DEPTH = 64  # of nested spaces
_MOST_SHOWN = 12  # parts of a value, in a message


@dataclass(frozen=True)
class Leaf:
    """One leaf of a space.

    Attributes:
        keys: lead to it from the root value.
        root: "state", "action" or "reward".
        name: its ROS field.
        space: its own space.
        kind: "scalar", "array", "image", "stack" or "variable".
        dtype, shape: as declared; `dtype` is None for a variable leaf.
        frames_last: the last axis of a stack holds its frames, not the first one.
    """

    keys: tuple[Any, ...]
    root: str
    name: str
    space: gym.Space[Any]
    kind: Literal["array", "scalar", "image", "stack", "variable"]
    dtype: DType | None
    shape: tuple[int, ...]
    frames_last: bool = False

    @cached_property
    def path(self) -> str:
        """Its name for people: `state.pos[1]`."""
        return name_within(self.root, *self.keys)

    @property
    def size(self) -> int:
        """Number of elements of one value; 1 of a value of variable size."""
        return math.prod(self.shape)

    @property
    def apart(self) -> bool:
        """True if the leaf has a channel of its own: an image, or a stack of frames."""
        return self.kind in ("image", "stack")

    @property
    def is_scalar(self) -> bool:
        """True if Gymnasium's own samples are scalars: a Discrete, and a Box of shape () of integers or bools."""
        return self.shape == () and self.dtype is not None and self.dtype.kind in "iub"

    @property
    def stored_shape(self) -> tuple[int, ...]:
        """The shape of one value in the rows of its channel; the frames of a stack come first."""
        return (self.shape[-1], *self.shape[:-1]) if self.frames_last else self.shape

    def as_values(self, stored: Any) -> Any:
        """A view of stored values, (..., *stored_shape), with the shape of the leaf."""
        return np.moveaxis(stored, -len(self.shape), -1) if self.frames_last else stored

    def newest(self, value: Any) -> Any:
        """The newest frame of a stack."""
        return value[..., -1] if self.frames_last else value[-1]

    def get(self, value: Any) -> Any:
        """The leaf's value inside a value of the whole space."""
        for key in self.keys:
            value = value[key]
        return value


class NameRegistry:
    """Makes ROS field names that are valid and unique within one message."""

    def __init__(self, reserved: Sequence[str] = ()) -> None:
        self._taken = set(reserved)
        self._counted: dict[tuple[str, tuple[str, ...]], int] = {}  # last suffix of each name

    def take(self, text: str, prefixes: Sequence[str] = ("",)) -> str:
        """A name made of `text` that is free with each of `prefixes` before it."""
        base = re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_") or "field"
        if not base[0].isalpha():
            base = f"f_{base}"
        counted = (base, tuple(prefixes))
        name, n = base, self._counted.get(counted, 2)
        if n > 2:
            name, n = f"{base}_{n}", n + 1
        while any(prefix + name in self._taken for prefix in prefixes):
            name, n = f"{base}_{n}", n + 1
        self._counted[counted] = n
        self._taken.update(prefix + name for prefix in prefixes)
        return name


def camel(name: str) -> str:
    """A field's name as the name of a type: `arm_x` becomes `ArmX`."""
    return "".join(part.capitalize() for part in name.split("_"))


def flatten_space(
    space: gym.Space[Any], root: str, names: NameRegistry, *, images: bool = False
) -> list[Leaf]:
    """The leaves of `space` in its own order; `root` is "state", "action" or "reward".

    With `images`, uint8 leaves of shape H x W x 1|3|4 become image leaves. Raises SpaceError, with the leaf's path, for
    a space of another class, or a dtype no message can hold.
    """

    def walk(space: gym.Space[Any], keys: tuple[Any, ...], name: str) -> Iterator[Leaf]:
        path = name_within(root, *keys)
        if len(keys) > MAX_DEPTH:
            raise SpaceError(f"{path}: a space nested more than {MAX_DEPTH} deep cannot be recorded")
        if type(space) in (spaces.Dict, spaces.Tuple):
            for key, sub in subspaces(space):
                yield from walk(sub, (*keys, key), f"{name}_{key}")
        elif type(space) in _VARIABLE:
            yield Leaf(keys, root, names.take(name), space, "variable", None, ())
        elif type(space) in CONSTANT:
            yield _constant_leaf(space, keys, root, names.take(name), images)
        else:
            kind = type(space)
            advice = (
                "wrap the environment in gymnasium.wrappers.TransformObservation (or TransformAction) with a function "
                "that makes a value of Gymnasium's own of it, and the space of such values"
                if isinstance(space, gym.Space)
                else "give one, such as gymnasium.spaces.Box(-1, 1, (3,))"
            )
            raise SpaceError(
                f"{path}: expected a space of Gymnasium itself, found {kind.__module__}.{kind.__qualname__}; {advice}"
            )

    return list(walk(space, (), root))


def subspaces(space: Any) -> list[tuple[Any, gym.Space[Any]]]:
    """The keys, or the indexes, of a Dict or a Tuple, and their spaces."""
    return list(space.spaces.items() if type(space) is spaces.Dict else enumerate(space.spaces))


def _constant_leaf(space: Any, keys: tuple[Any, ...], root: str, name: str, images: bool) -> Leaf:
    dtype = np.dtype(space.dtype)
    if dtype.name not in ROS_TYPES:
        raise SpaceError(
            f"{name_within(root, *keys)}: dtype {dtype.name!r} cannot be stored exactly in a message; "
            f"use one of {', '.join(ROS_TYPES)}"
        )
    shape = tuple(int(n) for n in space.shape)
    kind: Literal["array", "scalar", "image"] = "scalar" if type(space) is spaces.Discrete else "array"
    if images and dtype == np.uint8 and len(shape) == 3 and shape[2] in (1, 3, 4) and 0 not in shape:
        kind = "image"
    return Leaf(keys, root, name, space, kind, np.dtype(dtype.name), shape)


def own_space(space: gym.Space[Any]) -> gym.Space[Any]:
    """`space`, with a Text for each space of another library whose values are strings (a MissionSpace of MiniGrid).

    Such a space may allow anything: its Text has the printable ASCII characters, and up to 4,096 of them.
    """
    if type(space) in (spaces.Dict, spaces.Tuple):
        parts = subspaces(space)
        own = [(key, own_space(sub)) for key, sub in parts]
        if all(one is sub for (_, one), (_, sub) in zip(own, parts, strict=True)):
            return space
        return spaces.Dict(own) if type(space) is spaces.Dict else spaces.Tuple([sub for _, sub in own])
    if type(space) in _VARIABLE or not isinstance(space, gym.Space) or space.shape is not None:
        return space
    if space.dtype is None or space.dtype.kind != "U":
        return space
    return spaces.Text(4096, min_length=0, charset=string.printable)


def leaves_in(parts: Collection[str], leaves: Sequence[Leaf]) -> list[Leaf]:
    """The leaves that lie in parts of a value. SpaceError if a part has none."""
    paths = [leaf.path for leaf in leaves]
    names = dict.fromkeys(name for leaf in leaves for name, _ in _names_around(leaf))
    for part in parts:
        if part not in names:
            whole = next((path for path in paths if part.startswith((f"{path}.", f"{path}["))), None)
            known = [name for name in names if name != leaves[0].root] or paths
            hint = did_you_mean(part, known) if whole is None else f"; read {whole}, and index it"
            more = "" if len(known) <= _MOST_SHOWN else ", …"
            such = f"a part such as {', '.join(known[:_MOST_SHOWN])}{more}"
            raise SpaceError(
                f"expected {such if known else 'no part, as the space is empty'}, found {part:.80}{hint}"
            )
    return [leaf for leaf in leaves if any(name in parts for name, _ in _names_around(leaf))]


def keys_to(part: str, leaves: Sequence[Leaf]) -> tuple[Any, ...]:
    """The keys that lead to a part of a value, in which one of the leaves lies."""
    return next(keys for leaf in leaves for name, keys in _names_around(leaf) if name == part)


def _names_around(leaf: Leaf) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """The names of the values that a leaf lies in, and its own, each with the keys that lead there."""
    for end in range(len(leaf.keys) + 1):
        yield name_within(leaf.root, *leaf.keys[:end]), leaf.keys[:end]


def space_of(space: gym.Space[Any], leaves: Sequence[Leaf]) -> gym.Space[Any]:
    """A space without what has none of the leaves."""
    kept = {leaf.keys[:depth] for leaf in leaves for depth in range(len(leaf.keys) + 1)}

    def cut(space: gym.Space[Any], keys: tuple[Any, ...]) -> gym.Space[Any]:
        if type(space) is spaces.Dict:
            return spaces.Dict(
                [(key, cut(sub, (*keys, key))) for key, sub in subspaces(space) if (*keys, key) in kept]
            )
        if type(space) is spaces.Tuple:
            parts = subspaces(space)
            if not all((*keys, index) in kept for index, _ in parts):
                path = name_within(leaves[0].root, *keys)
                raise SpaceError(f"expected all of {path}, which is a Tuple, found a part of it; read {path}")
            return spaces.Tuple([cut(sub, (*keys, index)) for index, sub in parts])
        return space

    return cut(space, ())


def structure(space: gym.Space[Any]) -> Callable[[Sequence[Any]], Any]:
    """A function that nests a sequence of leaf values (in `flatten_space` order) as `space` is nested."""
    build = _builder(space)
    return lambda values: build(iter(values))


def _builder(space: gym.Space[Any]) -> Callable[[Iterator[Any]], Any]:
    if type(space) is spaces.Dict:
        parts = {key: _builder(sub) for key, sub in space.spaces.items()}
        return lambda left: {key: build(left) for key, build in parts.items()}
    if type(space) is spaces.Tuple:
        builds = [_builder(sub) for sub in space.spaces]
        return lambda left: tuple([build(left) for build in builds])
    return next
