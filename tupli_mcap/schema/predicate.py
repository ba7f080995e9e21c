"""Filters evaluated in memory: on one item at a time, or on whole NumPy columns of steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.schema.facts import bound
from tupli_mcap.schema.filters import ORDERING, BaseFilter, FilterType, path_of
from tupli_mcap.schema.keys import join_key
from tupli_mcap.schema.models import DERIVED, EpisodeHeader
from tupli_mcap.schema.parse import parse_filter
from tupli_mcap.schema.times import TIME_PATHS, time_ns
from tupli_mcap.schema.values import OPERATORS, Scalar, against_floats, classify, compare, untag_float

Item: TypeAlias = Mapping[str, Any] | BaseModel
Predicate: TypeAlias = Callable[[Item], bool]
Mask: TypeAlias = npt.NDArray[np.bool_]

MISSING: Final = object()
_NAMED: Final = 8  # most numbers of a step that an error names


def compile_predicate(
    filter: BaseFilter | str | None, fields: type[BaseModel] | Collection[str] | None = None
) -> Predicate:
    """A function that tells whether a filter, or its text, is true for an item: nested mappings, or a pydantic model.

    None as the filter is true for every item. With `fields` (a model class, or names), only those top-level keys exist;
    with a model class, times are compared as times.

    Raises:
        FilterError: The filter names an unknown top-level key, or compares a field with a value of a kind that it never
            has.
    """
    if filter is None:
        return lambda item: True
    if fields is not None:
        return _predicate(bound(filter, fields), timed=isinstance(fields, type))
    return _predicate(parse_filter(filter) if isinstance(filter, str) else filter, timed=False)


def bound_predicate(filter: BaseFilter) -> Predicate:
    """The same for a filter that is already `bound` to a model."""
    return _predicate(filter, timed=True)


def _predicate(filter: BaseFilter, *, timed: bool) -> Predicate:
    match filter.type:
        case FilterType.AND:
            parts = [_predicate(part, timed=timed) for part in filter.filters]
            return lambda item: all(part(item) for part in parts)
        case FilterType.OR:
            parts = [_predicate(part, timed=timed) for part in filter.filters]
            return lambda item: any(part(item) for part in parts)
        case FilterType.NOT:
            inner = _predicate(filter.filters[0], timed=timed)
            return lambda item: not inner(item)
    path = path_of(filter)
    if timed and path in TIME_PATHS:
        of_time = scalar_test(filter)
        return lambda item: (ns := time_ns(look_up(item, path))) is not None and of_time(Scalar("number", ns))
    test = _value_test(filter)

    def comparison(item: Item) -> bool:
        found = look_up(item, path)
        return found is not MISSING and test(found)

    return comparison


def _value_test(filter: BaseFilter) -> Callable[[object], bool]:
    """The test of a comparison on a value that is there; a list is tested by its elements."""
    test = scalar_test(filter)
    if filter.type in ORDERING:
        return lambda found: test(classify(found))
    joined = all if filter.type is FilterType.NE else any

    def comparison(found: object) -> bool:
        if isinstance(found, list | tuple):
            return joined(test(classify(element)) for element in found)
        return test(classify(found))

    return comparison


def scalar_test(filter: BaseFilter) -> Callable[[Scalar], bool]:
    """The result of a comparison with an existing scalar."""
    if filter.type is FilterType.IN:
        # Equal scalars of one kind hash alike, 1 and 1.0 too; only NaN is not equal to itself.
        choices = {scalar for value in filter.value if (scalar := classify(value)).kind != "nan"}
        return lambda found: found in choices
    operation, wanted = filter.type.value, classify(filter.value)
    return lambda found: compare(operation, found, wanted)


def look_up(item: object, path: tuple[str, ...]) -> object:
    """The value at a path in nested mappings and models; `MISSING` if there is none."""
    for segment in path:
        if isinstance(item, BaseModel):
            derived = DERIVED if isinstance(item, EpisodeHeader) else ()
            if segment not in type(item).model_fields and segment not in derived:
                return MISSING
            item = getattr(item, segment)
        elif isinstance(item, Mapping) and segment in item and untag_float(item) is None:
            item = item[segment]
        else:
            return MISSING
    return item


def evaluate_columns(filter: BaseFilter, columns: Mapping[str, Any]) -> Mask:
    """A mask of the steps for which a filter is true.

    Args:
        filter: Comparisons of step fields: `F("reward") > 0`, `F("state[0]") < 1`, `F("state.pos[1]") >= 2`.
        columns: Field name to its column: an array of shape `(n, ...)`, a list of n values (leaves of
            variable size), or dicts and tuples of those, nested as the space is. Path segments after the
            field name go into dicts by key, into tuples by position, and then into the axes of an array.

    Returns:
        A bool array of shape `(n,)`.

    Raises:
        FilterError: There is no such column, key or position, or the path names several values of a step.
    """
    if not columns:
        raise FilterError("a filter over steps needs at least one column")
    return _mask(filter, columns, _length(next(iter(columns.values()))))


def _mask(filter: BaseFilter, columns: Mapping[str, Any], length: int) -> Mask:
    match filter.type:
        case FilterType.AND | FilterType.OR:
            join = np.logical_and if filter.type is FilterType.AND else np.logical_or
            total = np.full(length, filter.type is FilterType.AND)
            for part in filter.filters:
                join(total, _mask(part, columns, length), out=total)
            return total
        case FilterType.NOT:
            return ~_mask(filter.filters[0], columns, length)
    leaf = _leaf(filter.key or "", path_of(filter), columns)
    if (
        isinstance(leaf, np.ndarray)
        and leaf.dtype.kind in "biufU"
        and not (filter.type is FilterType.CONTAINS and leaf.dtype.kind == "U")
    ):
        if filter.type is FilterType.IN:
            parts = [_compare_array("EQ", leaf, classify(value)) for value in filter.value]
            return np.logical_or.reduce(parts) if parts else np.zeros(length, np.bool_)
        return _compare_array(filter.type.value, leaf, classify(filter.value))
    test = _value_test(filter)
    matches = (value is not MISSING and test(value) for value in leaf)
    return np.fromiter(matches, np.bool_, count=len(leaf))


def _length(column: Any) -> int:
    while isinstance(column, Mapping | tuple):
        nested = list(column.values()) if isinstance(column, Mapping) else list(column)
        if not nested:
            raise FilterError("a filter over steps needs columns with values, found an empty dict or tuple")
        column = nested[0]
    return len(column)


def _leaf(key: str, path: tuple[str, ...], columns: Mapping[str, Any]) -> Array | Sequence[Any]:
    """The column of one scalar per step that a path names."""
    column: Any = columns
    keys: list[Any] = []
    for segment in path:
        if not isinstance(column, Mapping | tuple):
            break
        known: list[Any] = list(column) if isinstance(column, Mapping) else list(range(len(column)))
        found: Any = next((name for name in known if str(name) == segment), MISSING)
        if found is MISSING:
            where = join_key(keys) if keys else "a step"
            hint = did_you_mean(join_key(path), _numbers(keys, column))
            raise FilterError(
                f"unknown key {key!r}{hint}: {where} has {', '.join(map(str, known)) or 'nothing'}"
            )
        keys.append(found)
        column = column[found]
    rest = path[len(keys) :]
    if isinstance(column, Mapping | tuple):
        such = ", ".join(_numbers(keys, column)[:_NAMED]) or "none"
        raise FilterError(f"filter key {key!r} names several values of a step; name one of them: {such}")
    if not isinstance(column, np.ndarray):
        return [step_value(value, rest) for value in column] if rest else list(column)
    shape = column.shape[1:]
    if len(rest) != len(shape) or not all(map(_is_below, rest, shape)):
        last = f" to {join_key([*keys, tuple(size - 1 for size in shape)])}" if shape else ""
        (first,) = _numbers(keys, column)
        raise FilterError(f"filter key {key!r} names no number: values of shape {shape} have {first}{last}")
    index: Any = (slice(None), *map(int, rest))
    leaf: Array = column[index]
    return leaf


def _is_below(index: str, size: int) -> bool:
    return index.isascii() and index.isdigit() and int(index) < size


def _numbers(keys: Sequence[Any], column: Any) -> list[str]:
    """The names of all values in a column of steps, to which `keys` lead; of an array, that of its first element."""
    if isinstance(column, Mapping | tuple):
        parts = column.items() if isinstance(column, Mapping) else enumerate(column)
        return [name for key, part in parts for name in _numbers([*keys, key], part)]
    first = (0,) * (column.ndim - 1) if isinstance(column, np.ndarray) else ()
    return [join_key([*keys, first] if first else keys)]


def step_value(value: Any, path: tuple[str, ...]) -> Any:
    """A value inside one step of a column of variable size; every comparison is false for a missing one."""
    for segment in path:
        try:
            value = value[segment] if isinstance(value, Mapping) else value[int(segment)]
        except (LookupError, ValueError, TypeError):
            return MISSING
    return value


_EVERY_KIND: Final = {"b": "bool", "i": "number", "u": "number", "f": "number", "U": "text"}


def _compare_array(operation: str, array: Array, wanted: Scalar) -> Mask:
    """One comparison of an array of shape (n,), with the meaning that `compare` has for scalars."""
    if operation == "NE":
        return ~_compare_array("EQ", array, wanted)
    if _EVERY_KIND[array.dtype.kind] != wanted.kind or (wanted.kind == "bool" and operation != "EQ"):
        return np.zeros(len(array), np.bool_)
    if array.dtype.kind == "f":
        return _compare_floats(operation, array, wanted.value)
    if array.dtype.kind in "iu":
        return _compare_ints(operation, array, wanted.value)
    return _apply(operation, array, wanted.value)


def _compare_ints(operation: str, array: Array, number: float) -> Mask:
    # NumPy would compare int64 with a float as float64, which cannot tell neighbours beyond 2**53 apart.
    limits = np.iinfo(array.dtype)
    if number > limits.max or number < limits.min:
        return np.full(len(array), operation in (("LT", "LEQ") if number > 0 else ("GT", "GEQ")))
    whole = math.floor(number)
    if whole != number:
        if operation == "EQ":
            return np.zeros(len(array), np.bool_)
        operation = "LEQ" if operation in ("LT", "LEQ") else "GT"
    return _apply(operation, array, array.dtype.type(whole))


def _compare_floats(operation: str, array: Array, number: float) -> Mask:
    # NumPy would round the number to float32 or float16 before it compares.
    array = array.astype(np.float64) if array.dtype.itemsize < 8 else array
    exact = against_floats(operation, number)
    if exact is None:
        return np.zeros(len(array), np.bool_)
    return _apply(exact[0], array, np.float64(exact[1]))


def _apply(operation: str, array: Array, value: Any) -> Mask:
    return np.asarray(OPERATORS[operation](array, value), np.bool_)
