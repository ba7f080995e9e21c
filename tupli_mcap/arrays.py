"""Names of array types for annotations, and functions for arrays nested in dicts and tuples."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

Array = np.ndarray[Any, Any]
DType = np.dtype[Any]
T = TypeVar("T")
_SHOWN, _LONGEST = 20, 300  # numbers of an array, characters of a value, in a repr
_FIRST = 3  # values of a list, in its repr


class ShortList(list[T]):
    """A list whose repr has its first values, and how many there are."""

    def __repr__(self) -> str:
        if len(self) <= _FIRST:
            return super().__repr__()
        return f"[{', '.join(map(repr, self[:_FIRST]))}, … ({len(self):,} in all)]"


def map_arrays(
    tree: Any, function: Callable[[Any], Any], of_list: Callable[[list[Any]], Any] | None = None
) -> Any:
    """Applies a function to each array of nested dicts and tuples, and to each list, unless there is `of_list` for
    these; None stays None."""
    if isinstance(tree, np.ndarray):
        return function(tree)
    if tree is None:
        return None
    if isinstance(tree, Mapping):
        return {key: map_arrays(value, function, of_list) for key, value in tree.items()}
    if isinstance(tree, tuple):
        return tuple(map_arrays(value, function, of_list) for value in tree)
    return of_list(tree) if of_list is not None and isinstance(tree, list) else function(tree)


def arrays_at(tree: Any, place: Any) -> Any:
    """Indexes each array of nested dicts and tuples with `place`: an index, a slice, or a tuple of these."""
    return map_arrays(tree, operator.itemgetter(place))


def is_masked(value: object) -> bool:
    """Whether a value is a masked array."""
    if type(value) is np.ndarray or not isinstance(value, np.ndarray):
        return False  # without `numpy.ma`, which NumPy imports when it is first named
    return isinstance(value, np.ma.MaskedArray)


def are_floats(numbers: Iterable[Array]) -> bool:
    """Whether float64 holds arrays of one shape exactly: no integer in them is as far from 0 as 2**53, beyond which not
    every integer is a float."""
    whole = [each for each in numbers if each.dtype.kind in "iu"]
    return not whole or bool((np.abs(np.stack(whole, dtype=np.float64)) < 2**53).all())


def short_repr(value: Any) -> str:
    """A repr in at most a line: of a large array its dtype and shape, of all else the first characters."""
    if isinstance(value, np.ndarray) and value.size > _SHOWN:
        return f"<{value.dtype} {value.shape}>"
    if isinstance(value, dict):
        inner = ", ".join(f"{key!r}: {short_repr(part)}" for key, part in value.items())
        text = f"{{{inner}}}"
    elif type(value) is tuple:
        text = f"({', '.join(map(short_repr, value))})"
    else:
        text = " ".join(repr(value).split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"
