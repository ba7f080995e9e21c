"""Filters: one AST with one meaning, in memory and in every database.

A filter is true or false for an item (nested mappings of JSON values), never unknown:

- A key is a dotted path through mappings (`metadata.score`); it does not go into lists. A **missing** key makes
  every comparison false, NE too. NOT is the complement: it is true if its filter is false.
- Values are null, booleans, numbers, texts, lists and mappings. **EQ** is true for two equal values of one kind; a
  boolean is no number. **NE** is true if the key is there and EQ is false.
- Numbers of any size, int or float, compare exactly. **NaN** equals nothing and is neither smaller nor greater than
  anything, itself included; NE is true for it.
- **GT, GEQ, LT, LEQ** compare numbers with numbers and texts with texts (by code point); they are false for every
  other pair.
- **null** (None) is a value: EQ None is true if the key is there and null. An episode without a seed or a return has
  null there, so `seed != 8` is true for it.
- A **list** is EQ to each of its elements: `run.tags = "x"` is true if "x" is one of the tags, and NE if it is
  none of them. GT, GEQ, LT and LEQ are false for lists.
- A mapping, also one in a list, is EQ to nothing, and so NE to everything. A filter cannot compare with a mapping or a
  list.
- **CONTAINS** is true for a text that contains its value, a text; A to Z equal a to z there. It is true for a list
  if it is true for one of its elements, and false for anything else.
- **IN** is true if EQ is true for one of its values. An empty **AND** is true; an empty **OR** or IN is false.
- **Times** (`created_at`, and an episode's `ended`, which is the same, `run.started` and `run.ended`, the `time` of a
  step) compare as times of any zone, with dates, `datetime`s and `datetime64`s too: see `tupli_mcap.schema.times`. A
  text that is no time is as a missing one.

A filter without a meaning is a `FilterError`: an unknown top-level key, a value that is no scalar, ordering by
anything but a number or a text, a field compared with a value of a kind that it never has.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any, Final, Literal, Self

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    ValidationError,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from tupli_mcap.errors import FilterError
from tupli_mcap.schema.keys import join_key, split_key
from tupli_mcap.schema.times import COMPARED_PATHS, date_of, text_of
from tupli_mcap.schema.values import classify, tag_float


class FilterType(StrEnum):
    """What a filter does; the meaning of each is in the module's docstring."""

    EQ = "EQ"
    GEQ = "GEQ"
    LEQ = "LEQ"
    GT = "GT"
    LT = "LT"
    NE = "NE"
    IN = "IN"
    CONTAINS = "CONTAINS"
    AND = "AND"
    OR = "OR"
    NOT = "NOT"


COMBINING: Final = frozenset({FilterType.AND, FilterType.OR, FilterType.NOT})
ORDERING: Final = frozenset({FilterType.GT, FilterType.GEQ, FilterType.LT, FilterType.LEQ})
MAX_DEPTH: Final = 32
_MAX_INT_BITS: Final = 13_000  # Python converts no decimal integers that are much longer

_SYMBOL: Final[Mapping[FilterType, str]] = {
    FilterType.EQ: "==",
    FilterType.NE: "!=",
    FilterType.GT: ">",
    FilterType.GEQ: ">=",
    FilterType.LT: "<",
    FilterType.LEQ: "<=",
}


class BaseFilter(BaseModel):
    """A filter: a comparison (`key`, `value`) or a combination (`filters`), as `type` says.

    Immutable and hashable; `filters` and the `value` of IN are tuples. Equality compares contents, not classes,
    so that a filter equals the one that is read from its JSON.

    Raises:
        FilterError: The filter is invalid. (Validation of data, `model_validate` and so on, raises
            pydantic's ValidationError with the same words.)
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    type: FilterType = FilterType.OR
    key: str | None = None
    value: Any = None
    filters: Sequence[BaseFilter] = ()

    def __init__(self, **data: Any) -> None:
        # Before the parts are validated: each level of them takes some of Python's stack.
        if _is_too_deep(data):
            raise FilterError(f"{type(self).__name__}: filters nest at most {MAX_DEPTH} deep")
        try:
            super().__init__(**data)
        except ValidationError as err:
            raise FilterError(_sentence(type(self).__name__, err)) from err

    @field_validator("filters", mode="before")
    @classmethod
    def _immutable(cls, filters: Any) -> Any:
        if filters is None:
            return ()
        return tuple(filters) if isinstance(filters, list) else filters

    @field_validator("key")
    @classmethod
    def _check_key(cls, key: str | None) -> str | None:
        if key is not None:
            _check_text(key, "key")
            split_key(key)
        return key

    @field_validator("value", mode="before")
    @classmethod
    def _plain_value(cls, value: Any, info: ValidationInfo) -> Any:
        key = info.data.get("key")
        if isinstance(value, set | frozenset):
            return tuple(_plain(item, key) for item in sorted(value, key=repr))
        if isinstance(value, np.ndarray) and value.ndim == 1:
            return tuple(_plain(item, key) for item in value)
        if isinstance(value, list | tuple):
            return tuple(_plain(item, key) for item in value)
        return _plain(value, key)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.type in COMBINING:
            if self.key is not None or self.value is not None:
                raise ValueError(f"{self.type} combines filters and takes no key or value")
            if self.type is FilterType.NOT and len(self.filters) != 1:
                raise ValueError(f"NOT takes exactly one filter, found {len(self.filters)}")
            return self
        if self.key is None or "value" not in self.model_fields_set:
            raise ValueError(f"{self.type} needs a key and a value")
        if self.filters:
            raise ValueError(f"{self.type} compares a key with a value and takes no filters")
        _check_value(self.type, self.key, self.value)
        return self

    @field_serializer("value", when_used="json")
    def _strict_json(self, value: Any) -> Any:
        if isinstance(value, tuple):
            return [tag_float(item) if isinstance(item, float) else item for item in value]
        return tag_float(value) if isinstance(value, float) else value

    def __and__(self, other: BaseFilter) -> BaseFilter:
        combined: BaseFilter = _combined(FilterAND, FilterType.AND, self, other)
        return combined

    def __or__(self, other: BaseFilter) -> BaseFilter:
        combined: BaseFilter = _combined(FilterOR, FilterType.OR, self, other)
        return combined

    def __invert__(self) -> BaseFilter:
        return self.filters[0] if self.type is FilterType.NOT else FilterNOT(filters=[self])

    def __bool__(self) -> bool:
        raise FilterError(
            "a filter has no truth value: combine filters with & | ~ (a < x < b is (x > a) & (x < b)), "
            "and test for its absence with `is None`"
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, BaseFilter) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> tuple[Any, ...]:
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        # All NaNs are alike here: two filters for NaN are the same filter.
        scalars = tuple((s.kind, None if s.kind == "nan" else s.value) for s in map(classify, values))
        path = None if self.key is None else split_key(self.key)
        return (self.type, path, scalars, self.filters)

    def __repr__(self) -> str:
        return _expression(self)

    __str__ = __repr__

    def to_params_dict(self, params: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """The filter as JSON-able query parameters, together with those in `params`, which is not changed."""
        own = self.model_dump(
            mode="json", exclude_none=True, exclude={"filters"} if not self.filters else None
        )
        if self.type not in COMBINING:
            own["value"] = self.model_dump(mode="json", include={"value"})["value"]  # null is a value
        if self.filters:
            own["filters"] = [item.to_params_dict() for item in self.filters]
        return {**(params or {}), **own}

    def apply_prefix(self, prefix: str) -> BaseFilter:
        """The same filter with every key below `prefix` (a dotted path)."""
        if self.type in COMBINING:
            return self.model_copy(update={"filters": tuple(f.apply_prefix(prefix) for f in self.filters)})
        return self.model_copy(update={"key": join_key((*split_key(prefix), *path_of(self)))})


class FilterEQ(BaseFilter):
    """The key's value equals `value`."""

    type: Literal[FilterType.EQ] = FilterType.EQ


class FilterGEQ(BaseFilter):
    """The key's value is greater than or equal to `value`."""

    type: Literal[FilterType.GEQ] = FilterType.GEQ


class FilterLEQ(BaseFilter):
    """The key's value is less than or equal to `value`."""

    type: Literal[FilterType.LEQ] = FilterType.LEQ


class FilterGT(BaseFilter):
    """The key's value is greater than `value`."""

    type: Literal[FilterType.GT] = FilterType.GT


class FilterLT(BaseFilter):
    """The key's value is less than `value`."""

    type: Literal[FilterType.LT] = FilterType.LT


class FilterNE(BaseFilter):
    """The key is there and its value does not equal `value`."""

    type: Literal[FilterType.NE] = FilterType.NE


class FilterIN(BaseFilter):
    """The key's value equals one of `value`."""

    type: Literal[FilterType.IN] = FilterType.IN


class FilterCONTAINS(BaseFilter):
    """The key's value is a text that contains `value`, ignoring the case of A to Z."""

    type: Literal[FilterType.CONTAINS] = FilterType.CONTAINS


class FilterAND(BaseFilter):
    """All of `filters` are true."""

    type: Literal[FilterType.AND] = FilterType.AND
    filters: Sequence[BaseFilter]


class FilterOR(BaseFilter):
    """At least one of `filters` is true."""

    type: Literal[FilterType.OR] = FilterType.OR
    filters: Sequence[BaseFilter]

    @classmethod
    def from_list(cls, items: Iterable[Any], on_key: str, from_key: str) -> FilterOR:
        """True if `on_key` equals the attribute `from_key` of any item; without items never true."""
        return cls(filters=[FilterEQ(key=on_key, value=getattr(item, from_key)) for item in items])


class FilterNOT(BaseFilter):
    """The one filter in `filters` is false."""

    type: Literal[FilterType.NOT] = FilterType.NOT
    filters: Sequence[BaseFilter]


class EpisodesListRequest(BaseFilter):
    """A filter over episodes, and whether their tuples are requested; without arguments, every episode."""

    type: FilterType = FilterType.AND
    include_tuples: bool = False


def path_of(filter: BaseFilter) -> tuple[str, ...]:
    """The segments of a comparison's key."""
    return split_key(filter.key or "")


def _is_too_deep(filter: Any) -> bool:
    """Whether the parts of a filter, or of data for one, nest deeper than `MAX_DEPTH`."""
    level = [filter]
    for _ in range(MAX_DEPTH + 1):
        level = [part for each in level for part in _parts(each)]
        if not level:
            return False
    return True


def _parts(filter: Any) -> Sequence[Any]:
    found = filter.filters if isinstance(filter, BaseFilter) else None
    if isinstance(filter, Mapping):
        found = filter.get("filters")
    return found if isinstance(found, Sequence) else ()


def _combined(cls: type[BaseFilter], type: FilterType, left: BaseFilter, right: object) -> Any:
    if not isinstance(right, BaseFilter):
        return NotImplemented
    parts: list[BaseFilter] = [
        item for side in (left, right) for item in (side.filters if side.type is type else (side,))
    ]
    return cls(filters=parts)


def _plain(value: Any, key: str | None) -> Any:
    if isinstance(value, np.datetime64):
        value = date_of(value) or value
    if isinstance(value, datetime.date):
        if key is None or split_key(key) not in COMPARED_PATHS:
            raise ValueError(
                f"{key!r} holds no times: expected a text to compare it with, found {value!r:.60}"
            )
        return text_of(value)
    scalar = classify(value)
    return value if scalar.kind == "other" else scalar.value


def _check_text(text: str, what: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError as err:
        raise ValueError(f"its {what} {text!r} holds a lone surrogate, which is not valid Unicode") from err


def _check_value(type: FilterType, key: str, value: Any) -> None:
    """Raises ValueError unless the comparison has a meaning."""
    if type is FilterType.IN and not isinstance(value, tuple):
        raise ValueError(f"IN on {key!r} takes a list of values, found {value!r:.60}")
    for item in value if type is FilterType.IN else (value,):
        kind = classify(item).kind
        if kind == "other":
            raise ValueError(f"{key!r} can be compared with null, bool, numbers and text, found {item!r:.60}")
        if type in ORDERING and kind not in ("number", "nan", "text"):
            raise ValueError(f"{type} on {key!r} orders numbers or text, found {item!r:.60}")
        if type is FilterType.CONTAINS and kind != "text":
            raise ValueError(f"{type} (~) on {key!r} takes a text, found {item!r:.60}")
        if isinstance(item, str):
            _check_text(item, "value")
        if isinstance(item, int) and item.bit_length() > _MAX_INT_BITS:
            raise ValueError(
                f"{key!r} is compared with too large an integer, one of {item.bit_length()} bits"
            )


def _sentence(name: str, err: ValidationError) -> str:
    """Pydantic's first error as one sentence."""
    first = err.errors(include_url=False, include_input=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    message = first["msg"].removeprefix("Value error, ")
    return f"{name}: {where + ': ' if where else ''}{message}"


def _expression(filter: BaseFilter, outer: bool = True) -> str:
    """The filter as the Python expression that makes it."""
    if filter.type is FilterType.NOT:
        return f"~{_expression(filter.filters[0], outer=False)}"
    if filter.type in COMBINING:
        if len(filter.filters) < 2:
            return f"Filter{filter.type}(filters={list(filter.filters)!r})"
        sign = " & " if filter.type is FilterType.AND else " | "
        text = sign.join(_expression(item, outer=False) for item in filter.filters)
        return text if outer else f"({text})"
    name = f"F({json.dumps(filter.key, ensure_ascii=False)})"
    if filter.type is FilterType.IN:
        return f"{name}.isin([{', '.join(map(_value, filter.value))}])"
    if filter.type is FilterType.CONTAINS:
        return f"{name}.contains({_value(filter.value)})"
    text = f"{name} {_SYMBOL[filter.type]} {_value(filter.value)}"
    return text if outer else f"({text})"


def _value(value: Any) -> str:
    """A scalar as Python writes it; NaN and the infinities have no literals, so they are calls of float."""
    if isinstance(value, float) and isinstance(tag_float(value), dict):
        return f'float("{value}")'
    return repr(value)
