"""Decides which dtype stores a leaf, and casts values exactly or refuses."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array, DType, is_masked
from tupli_mcap.errors import StepError, warn
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.leaves import ROS_TYPES, Leaf

_LONGEST = 120  # characters of a value in an error
_MANTISSA = {"float16": 11, "float32": 24, "float64": 53}


def shorten(value: object) -> str:
    """A repr for error messages, cut to 120 characters."""
    text = " ".join(jsonvalue.shown(value).split())
    return text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…"


def decide_dtype(leaf: Leaf, values: Sequence[Any]) -> DType:
    """The dtype that stores a leaf for a whole recording, from its first values (reset's and the first step's).

    Python scalars take the declared dtype, but a Python float in a leaf narrower than float64 makes it float64, since
    rounding would change what the environment returned. NumPy values widen the dtype and never narrow it. A warning
    names each leaf whose values have another dtype than the declared one.
    """
    if leaf.dtype is None:
        raise StepError(f"{leaf.path}: a value of variable size has no dtype")
    dtype = leaf.dtype
    for value in values:
        dtype = _widen(dtype, value)
    if dtype.name not in ROS_TYPES:
        raise StepError(
            f"{leaf.path}: expected values of dtype {leaf.dtype.name}, found {dtype.name}, which no message holds"
        )
    if dtype != leaf.dtype:
        warn(
            f"{leaf.path} is declared {leaf.dtype.name}, but the values are {dtype.name}; "
            f"they are recorded as {dtype.name}, exactly as given; cast them if {leaf.dtype.name} is meant"
        )
    return dtype


def _widen(dtype: DType, value: Any) -> DType:
    if isinstance(value, float) and not isinstance(value, np.generic):
        return np.result_type(dtype, np.float64)
    if isinstance(value, list | tuple):
        try:
            array = np.asarray(value)
        except (ValueError, TypeError, RuntimeError):
            return dtype  # storing the value refuses it, and names its path
        return _widen(dtype, array) if array.dtype.kind == "f" else dtype
    if not isinstance(value, np.ndarray | np.generic):
        return dtype
    if value.dtype.kind not in "biuf":
        return dtype  # storing the value refuses it, and names its path
    wide = np.result_type(dtype, value.dtype)
    if wide.kind == "f" and dtype.kind in "biu" and value.dtype.kind in "biu":
        # int64 and uint64 have no common integer dtype: take that of the values
        wide = value.dtype
    return np.dtype(wide.name)


def exact_array(value: Any, dtype: DType, shape: tuple[int, ...], path: str) -> Array:
    """`value` as an array of `dtype` and `shape`, equal to it in every element; bools are 0 or 1, as in messages.
    Raises StepError for another shape, no numbers, or a value that `dtype` cannot hold exactly."""
    array = number_array(value, dtype, shape, path)
    if array.dtype == dtype:
        # a bool made by a view may hold any byte
        return array if dtype.kind != "b" else array.view(np.uint8) != 0
    with np.errstate(all="ignore"):
        cast = array.astype(dtype)
    if not _always_exact(array.dtype, dtype) and not _equal(array, cast):
        raise StepError(
            f"{path}: expected values that {dtype.name} holds exactly, found {array.dtype.name} {shorten(value)}; "
            f"the first step has fixed the dtypes: cast the values, or declare {array.dtype.name} in the space"
        )
    return cast


def number_array(value: Any, dtype: DType, shape: tuple[int, ...], path: str) -> Array:
    """`value` as an array of numbers of any dtype. Raises StepError for another shape or no numbers, which says that
    `dtype` is expected."""
    if is_masked(value):
        raise StepError(f"{path}: expected an array, found a masked array, whose mask cannot be recorded")
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError) as err:  # RuntimeError: a torch tensor that requires grad
        raise StepError(
            f"{path}: expected {dtype.name}{list(shape)}, found {shorten(value)}{_how_to_pass(value)}"
        ) from err
    if array.dtype.kind not in "biuf":
        raise StepError(f"{path}: expected {dtype.name}{list(shape)}, found {shorten(value)}")
    if array.shape != shape:
        raise StepError(
            f"{path}: expected shape {shape}, found shape {array.shape}; reshape it, or declare this shape in the space"
        )
    return array


def _how_to_pass(value: object) -> str:
    """What makes an array of a tensor of PyTorch that is none for NumPy."""
    if getattr(value, "requires_grad", False):
        return "; pass .detach() of it"
    return "; pass .float() of it" if str(getattr(value, "dtype", "")) == "torch.bfloat16" else ""


def exact_flag(value: Any, name: str) -> bool:
    """A flag of a step; raises StepError unless it is a bool or the number 0 or 1."""
    if value is True or value is False:
        return value
    with contextlib.suppress(ValueError, TypeError, RuntimeError):
        array = np.asarray(value)
        if array.shape == () and array.dtype.kind in "biuf" and array.item() in (0, 1):
            return bool(array)
    raise StepError(f"{name}: expected true or false, found {shorten(value)}")


def exact_flags(values: Any, shape: tuple[int, ...], name: str, expected: str) -> Array:
    """Flags of several steps as bools; raises StepError unless they are bools or the numbers 0 and 1, in that shape.

    `expected` says so in the error.
    """
    try:
        given = np.asarray(values)
    except (ValueError, TypeError, RuntimeError) as err:
        raise StepError(f"{name}: expected {expected}, found {shorten(values)}") from err
    if given.shape != shape:
        raise StepError(f"{name}: expected shape {shape}, found shape {given.shape}")
    if given.dtype.kind not in "biufO" or not (given.dtype == np.bool_ or np.isin(given, (0, 1)).all()):
        raise StepError(f"{name}: expected {expected}, found {given.dtype}: {shorten(values)}")
    return given.astype(np.bool_)


def _always_exact(source: DType, target: DType) -> bool:
    if source.kind in "iu" and target.kind == "f":
        return source.itemsize * 8 <= _MANTISSA[target.name]
    # a cast between floats may quiet a signalling NaN
    return np.can_cast(source, target, "safe") and source.kind != "f"


def _equal(array: Array, cast: Array) -> bool:
    """Exact element-wise equality (NumPy would round an int64 to compare it with a float64).

    A float must also come back from the cast bit for bit: some casts lose -0.0 or the payload of a NaN.
    """
    if array.dtype.kind == "f":
        with np.errstate(all="ignore"):
            return cast.astype(array.dtype).tobytes() == array.tobytes()
    return bool(np.all(array.astype(object) == cast.astype(object)))


_NESTED = (spaces.Dict, spaces.Tuple)


def check_structure(space: gym.Space[Any], value: Any, root: str, keys: tuple[Any, ...] = ()) -> None:
    """Raises StepError unless `value`, the part of `root` at `keys`, has dicts of the same keys and tuples of the same
    length as `space`."""
    if type(space) is spaces.Dict:
        if not isinstance(value, Mapping) or set(value) != space.spaces.keys():
            own = list(space.spaces)
            found = sorted(value, key=repr) if isinstance(value, Mapping) else shorten(value)
            raise StepError(
                f"{name_within(root, *keys)}: expected an entry for each of {shorten(own)}, found {shorten(found)}"
            )
        for key, sub in space.spaces.items():
            if type(sub) in _NESTED:
                check_structure(sub, value[key], root, (*keys, key))
    elif type(space) is spaces.Tuple:
        if not isinstance(value, tuple) or len(value) != len(space.spaces):
            raise StepError(
                f"{name_within(root, *keys)}: expected a tuple of {len(space.spaces)} entries, found {shorten(value)}"
            )
        for i, sub in enumerate(space.spaces):
            if type(sub) in _NESTED:
                check_structure(sub, value[i], root, (*keys, i))


def leaf_value(value: Any, leaf: Leaf) -> Any:
    """A leaf's value inside `value`; raises a StepError that names the place where the structure differs."""
    for i, key in enumerate(leaf.keys):
        try:
            value = value[key]
        except (KeyError, IndexError, TypeError) as err:
            path = name_within(leaf.root, *leaf.keys[:i])
            raise StepError(f"{path}: expected an entry {key!r}, found {shorten(value)}") from err
    return value
