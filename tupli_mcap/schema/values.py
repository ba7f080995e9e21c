"""Scalars as filters see them: their kind, and how two of them compare."""

from __future__ import annotations

import math
import operator
import string
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal, NamedTuple

import numpy as np

Kind = Literal["null", "bool", "number", "nan", "text", "other"]

FLOAT_TAG: Final = "$float"
_TAGGED: Final = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}

OPERATORS: Final[Mapping[str, Callable[[Any, Any], Any]]] = {
    "EQ": operator.eq,
    "NE": operator.ne,
    "GT": operator.gt,
    "GEQ": operator.ge,
    "LT": operator.lt,
    "LEQ": operator.le,
}


class Scalar(NamedTuple):
    """A value and its kind; `value` is plain Python (None, bool, int, float, str; None for `other`)."""

    kind: Kind
    value: Any


_OTHER: Final = Scalar("other", None)
_SMALL: Final = str.maketrans(string.ascii_uppercase, string.ascii_lowercase)


def classify(value: object) -> Scalar:
    """A value as filters see it.

    NumPy scalars and 0-d arrays are the Python numbers they hold, `{"$float": "nan"}` is the float that strict JSON
    writes like this, and everything that is no scalar is `other`.
    """
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, np.timedelta64):
        return _OTHER  # NumPy counts it among its integers
    if value is None:
        return Scalar("null", None)
    if isinstance(value, bool | np.bool_):
        return Scalar("bool", bool(value))
    if isinstance(value, int | np.integer):
        return Scalar("number", int(value))
    if isinstance(value, float | np.float16 | np.float32):
        number = float(value)
        return Scalar("nan" if math.isnan(number) else "number", number)
    if isinstance(value, str):
        return Scalar("text", str.__str__(value))  # an enum member is the text it holds, not its name
    if isinstance(value, Mapping):
        tagged = untag_float(value)
        return _OTHER if tagged is None else classify(tagged)
    return _OTHER


def small_letters(text: str) -> str:
    """The text with A to Z replaced by a to z; other letters stay, as in every database."""
    return text.lower() if text.isascii() else text.translate(_SMALL)


def compare(operation: str, found: Scalar, wanted: Scalar) -> bool:
    """The result of one comparison of two scalars; the meaning is in `tupli_mcap.schema.filters`.

    `operation` is EQ, NE, GT, GEQ, LT, LEQ or CONTAINS.
    """
    same_kind = found.kind == wanted.kind
    if operation == "CONTAINS":
        return same_kind and small_letters(wanted.value) in small_letters(found.value)
    if operation in ("EQ", "NE"):
        equal = same_kind and found.kind not in ("nan", "other") and bool(found.value == wanted.value)
        return equal == (operation == "EQ")
    ordered = same_kind and found.kind in ("number", "text")
    return ordered and bool(OPERATORS[operation](found.value, wanted.value))


def against_floats(operation: str, number: float) -> tuple[str, float] | None:
    """A comparison with a float that gives the same result as one with `number` for every float; None if never true.

    An int may lie between two neighbouring floats, or beyond all of them.
    """
    try:
        nearest = float(number)
    except OverflowError:
        nearest = math.inf if number > 0 else -math.inf
    if nearest == number:
        return operation, nearest
    if operation == "EQ":
        return None
    if operation in ("GT", "GEQ"):
        return ("GT" if nearest < number else "GEQ"), nearest
    return ("LEQ" if nearest < number else "LT"), nearest


def tag_float(value: float) -> float | dict[str, str]:
    """A float as strict JSON can hold it: NaN and the infinities become `{"$float": ...}`."""
    return value if math.isfinite(value) else {FLOAT_TAG: repr(float(value))}


def untag_float(value: Mapping[Any, Any]) -> float | None:
    """The float that `{"$float": ...}` stands for, or None if the mapping is not one."""
    if len(value) != 1:
        return None
    tag = value.get(FLOAT_TAG)
    return _TAGGED.get(tag) if isinstance(tag, str) else None
