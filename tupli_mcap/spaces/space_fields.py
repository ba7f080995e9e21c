"""The fields of a space's JSON object: bounds, dtypes and shapes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError, SpaceError
from tupli_mcap.spaces.leaves import ROS_TYPES

Json = dict[str, Any]

_DTYPES = {name: np.dtype(name) for name in ROS_TYPES}
_MAX_DIMENSIONS = 32  # of NumPy 1
_LARGE = 2**16  # elements


class Fields:
    """Takes the fields of one object, and checks each of them."""

    def __init__(self, obj: Json, path: str) -> None:
        self._obj = obj
        self.path = path

    def take(self, name: str) -> Any:
        if name not in self._obj:
            raise FormatError(f"{self.path}: expected a field {name!r}, found none")
        return self._obj[name]

    def wrong(self, name: str, expected: str) -> FormatError:
        return FormatError(f"{self.path}: expected {expected} in {name!r}, found {short(self.take(name))}")

    def integer(self, name: str) -> int:
        value = self.take(name)
        if type(value) is not int:
            raise self.wrong(name, "an integer")
        return value

    def items(self, name: str) -> list[Any]:
        value = self.take(name)
        if not isinstance(value, list):
            raise self.wrong(name, "a list")
        return value

    def flag(self, name: str) -> bool:
        value = self.take(name)
        if type(value) is not bool:
            raise self.wrong(name, "true or false")
        return value

    def dtype(self) -> np.dtype[Any]:
        value = self.take("dtype")
        if not isinstance(value, str) or value not in _DTYPES:
            raise self.wrong("dtype", "the name of a dtype")
        return _DTYPES[value]

    def shape(self, name: str) -> tuple[int, ...]:
        value = self.items(name)
        if len(value) > _MAX_DIMENSIONS or not all(type(n) is int and 0 <= n < 2**63 for n in value):
            raise self.wrong(name, f"a list of at most {_MAX_DIMENSIONS} lengths")
        return tuple(value)

    def array(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
        """An array of `shape`, from one number or from one for each element."""
        value = self.take(name)
        if not isinstance(value, list):
            return np.full(shape, self._number(name, value, dtype), dtype)
        if len(value) != math.prod(shape):
            raise FormatError(
                f"{self.path}: expected {math.prod(shape)} numbers in {name!r}, found {len(value)}"
            )
        array = np.array([self._number(name, item, dtype) for item in value], dtype)
        return array.reshape(shape)

    def built_shape(self, shape: tuple[int, ...], *names: str) -> tuple[int, ...]:
        """`shape`, or a shape of one element with as many dimensions if a large space has the same bounds everywhere.

        Such a space takes a few bytes in a file, and must take few in memory.
        """
        uniform = not any(isinstance(self._obj.get(name), list) for name in names)
        return (1,) * len(shape) if uniform and math.prod(shape) > _LARGE else shape

    def _number(self, name: str, value: Any, dtype: np.dtype[Any]) -> Any:
        if dtype.kind == "b":
            exact = type(value) is bool
        elif dtype.kind == "f":
            if isinstance(value, str) and value in ("inf", "-inf"):
                return float(value)
            with np.errstate(all="ignore"):
                exact = type(value) is float and value == float(dtype.type(value))
        else:
            exact = type(value) is int and np.iinfo(dtype).min <= value <= np.iinfo(dtype).max
        if not exact:
            raise FormatError(f"{self.path}: expected a number of {dtype} in {name!r}, found {short(value)}")
        return value


def short(value: Any) -> str:
    """A value for an error message, in one line of bounded length."""
    try:
        text = str(value) if isinstance(value, Exception) else repr(value)
    except ValueError:  # an integer of too many digits to show
        text = f"a huge {type(value).__name__}"
    return text if len(text) <= 80 else text[:77] + "..."


def dtype_name(dtype: np.dtype[Any], path: str) -> str:
    if _DTYPES.get(dtype.name) != dtype:  # big-endian ones have the same name
        raise SpaceError(
            f"{path}: expected a dtype of {', '.join(_DTYPES)}, found {dtype.str} ({dtype.name})"
        )
    return str(dtype.name)


def numbers(array: np.ndarray[Any, Any]) -> Any:
    """One number if all elements are the same bits, else the list of them; the opposite of `Fields.array`."""
    if array.size and not any(array.strides):  # one element, spread
        array = array[(slice(1),) * array.ndim]
    flat = np.ascontiguousarray(array).reshape(-1)
    if flat.size == 0:
        return []
    items = flat.view(f"u{flat.itemsize}")
    values = flat[:1].tolist() if (items == items[0]).all() else flat.tolist()
    if flat.dtype.kind == "f":
        values = [value if math.isfinite(value) else str(value) for value in values]
    return values[0] if len(values) == 1 else values
