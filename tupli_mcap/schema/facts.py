"""Checks filters against a model: their keys exist, values are of the right kind, and times are compared as times."""

from __future__ import annotations

import datetime
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from pydantic import BaseModel

from tupli_mcap.errors import FilterError, did_you_mean
from tupli_mcap.schema.filters import (
    COMBINING,
    ORDERING,
    BaseFilter,
    FilterAND,
    FilterGEQ,
    FilterLT,
    FilterOR,
    FilterType,
)
from tupli_mcap.schema.keys import join_key, split_key
from tupli_mcap.schema.models import DERIVED, EpisodeHeader
from tupli_mcap.schema.parse import key_positions, parse_filter
from tupli_mcap.schema.times import EXPECTED, TIME_PATHS, TimeSpan, span_of
from tupli_mcap.schema.values import Scalar, classify

_MEANT: Final[Mapping[str, str]] = {"ended": "created_at", "return": "episode_return", "steps": "n_tuples"}
LISTED_AS: Final[Mapping[str, str]] = {field: key for key, field in _MEANT.items()}
"""By fields of an episode, the keys that lists name them by; filters and columns take both."""
_OTHER_NAMES: Final = {
    **_MEANT,
    **dict.fromkeys(("terminal", "terminals", "terminations"), "terminated"),
    **dict.fromkeys(("truncated", "truncations", "timeouts"), "timeout"),
}
_LIKE: Final = {
    "length": "steps",
    "episode_length": "steps",
    "total_reward": "return",
    "reward": "return",
    "rewards": "return",
    "date": "ended",
    "time": "ended",
    "tag": "run.tags",
}
_STEP_VALUES: Final = (
    "state", "action", "reward", "info", "time", "frame", "next_state", "observation", "next_observation",
)  # fmt: skip
_OF_STEPS: Final = frozenset(("step", *_STEP_VALUES, *(f"{name}s" for name in _STEP_VALUES)))
_INSIDE: Final = ("run.name", "run.tags", "run.split", "run.environment", "run.started", "metadata.success")
_ENDS: Final = ("terminal", "timeout", "interrupted", "")
_KINDS: Final[Mapping[Any, str]] = {
    str: "text",
    bool: "bool",
    int: "whole",
    float: "number",
    type(None): "null",
}
_WORDS: Final = {
    "text": "a text",
    "bool": "true or false",
    "whole": "a whole number",
    "number": "a number",
    "null": "null",
}


def filter_keys(fields: type[BaseModel] | Collection[str]) -> list[str]:
    """The top-level keys that a filter over items of a model (or with these fields) may name, sorted.

    An episode's `created_at`, `episode_return` and `n_tuples` are listed as `ended`, `return` and `steps`; both names
    work.
    """
    if not isinstance(fields, type):
        return sorted(fields)
    if not issubclass(fields, EpisodeHeader):
        return sorted(fields.model_fields)
    return sorted({*fields.model_fields, *_MEANT, *DERIVED} - {*_MEANT.values()})


def path_in(key: str, fields: type[BaseModel] | Collection[str]) -> tuple[str, ...]:
    """The path of a key in items of a model, or with these fields.

    Raises:
        FilterError: there is no such top-level key.
    """
    name, *inside = split_key(key)
    of_episodes = isinstance(fields, type) and issubclass(fields, EpisodeHeader)
    if of_episodes:
        name = _OTHER_NAMES.get(name, name)
    own = fields.model_fields if isinstance(fields, type) else fields
    if name not in own and not (of_episodes and name in DERIVED):
        known = filter_keys(fields)
        nested = _INSIDE if of_episodes else _inside(fields)
        like = next((there for there in nested if there.endswith(f".{name}")), _LIKE.get(name, name))
        hint = did_you_mean(like, [*known, *(_MEANT.values() if of_episodes else ()), *nested])
        if name in _OF_STEPS and of_episodes:
            hint += ": it is of steps, which filter_steps(...) of a dataset chooses"
        elif "step" in known and name in filter_keys(EpisodeHeader):
            hint += ": it is of episodes, which filter(...) of a dataset chooses"
        elif not hint and of_episodes:
            hint = f" (your own: metadata.{name:.40}, run.metadata.{name:.40})"
        raise FilterError(f"unknown key {key!r}{hint}; the keys are {', '.join(known)}")
    return (name, *inside)


def _inside(fields: type[BaseModel] | Collection[str]) -> Sequence[str]:
    """The keys inside of those whose values are models, such as `metadata.name` of a benchmark."""
    inner = (
        {key: of.annotation for key, of in fields.model_fields.items()} if isinstance(fields, type) else {}
    )
    return [
        f"{key}.{part}"
        for key, kind in inner.items()
        if isinstance(kind, type) and issubclass(kind, BaseModel)
        for part in kind.model_fields
    ]


def check_keys(filter: BaseFilter, fields: type[BaseModel] | Collection[str]) -> None:
    """Raises FilterError if it is no filter, names a top-level key that is not among `fields`, or compares a model's
    field with a value that the field never has: one of another kind, 1.5 for a whole number, no time for a time."""
    bound(filter, fields)


def bound(filter: BaseFilter | str, fields: type[BaseModel] | Collection[str]) -> BaseFilter:
    """A filter, or what its text describes, over items of a model (or with these fields) with its times as nanoseconds
    in UTC; "yesterday" means the day before this call.

    Raises:
        FilterError: As `check_keys`; for a text also as `parse_filter`.
    """
    if isinstance(filter, str):
        return parse_bound(filter, fields)
    if not isinstance(filter, BaseFilter):
        raise FilterError(
            f"expected a filter, such as FilterEQ(key=..., value=...) or F(...) > 3, found {filter!r:.80}"
        )
    for comparison in comparisons(filter):
        path_in(comparison.key or "", fields)
    if not isinstance(fields, type):
        return filter
    return _bound(filter, fields, datetime.datetime.now(datetime.UTC))


def parse_bound(text: str, fields: type[BaseModel] | Collection[str]) -> BaseFilter:
    """The filter that a text describes, `bound` to items of a model, or with these fields.

    Raises:
        FilterError: as `parse_filter` and `bound`; it has the position, also for an unknown key.
    """
    parsed = parse_filter(text)
    try:
        return bound(parsed, fields)
    except FilterError as err:
        for position, comparison in zip(key_positions(text), comparisons(parsed), strict=True):
            try:
                bound(comparison, fields)
            except FilterError:
                raise err.at(position) from None
        raise


def comparisons(filter: BaseFilter) -> Iterable[BaseFilter]:
    """The comparisons in a filter, from left to right."""
    if filter.key is not None:
        yield filter
    for item in filter.filters:
        yield from comparisons(item)


def with_times(filter: BaseFilter, keys: Collection[str]) -> BaseFilter:
    """The filter with times at `keys` ("yesterday", a date) as nanoseconds. FilterError if a value is no time."""
    if filter.type in COMBINING:
        return filter.model_copy(update={"filters": tuple(with_times(part, keys) for part in filter.filters)})
    key = filter.key or ""
    return _in_time(filter, key, datetime.datetime.now(datetime.UTC)) if key in keys else filter


def _bound(filter: BaseFilter, model: type[BaseModel], now: datetime.datetime) -> BaseFilter:
    if filter.type in COMBINING:
        parts = tuple(_bound(part, model, now) for part in filter.filters)
        return filter.model_copy(update={"filters": parts})
    name, *inside = path = path_in(filter.key or "", model)
    if path in TIME_PATHS:
        return _in_time(filter, join_key(path), now)
    kinds = _kinds_of(model, name)
    if inside and kinds:
        written = split_key(filter.key or "")[0]
        raise FilterError(f"filter key {filter.key!r}: {written} is {_one_of(kinds)} and has no parts")
    if not inside:
        _check_values(filter, name, kinds)
    return filter.model_copy(update={"key": join_key(path)})


def _check_values(filter: BaseFilter, name: str, kinds: frozenset[str]) -> None:
    key = repr(filter.key)
    if not kinds:
        example = "run.name" if name == "run" else "metadata.score"
        raise FilterError(f"{key} holds several values and is equal to none; name one, such as {example}")
    ordered = filter.type in ORDERING
    for value in filter.value if filter.type is FilterType.IN else (filter.value,):
        scalar = classify(value)
        if scalar.kind == "nan" and kinds & {"whole", "number"}:
            raise FilterError(f"nan is equal to nothing; {key} <= inf is true of all numbers")
        if not _may_be(kinds, scalar, ordered):
            meant = " (did you mean 'run.environment'?)" if name == "env" and scalar.kind == "text" else ""
            raise FilterError(f"{key} is {_one_of(kinds)}: expected such a value, found {value!r:.60}{meant}")
        part_of_one = filter.type is FilterType.CONTAINS and any(value.lower() in end for end in _ENDS)
        if name == "end" and not ordered and value not in _ENDS and not part_of_one:
            raise FilterError(f"{key} is terminal, timeout or interrupted, found {value!r:.60}")
    if name == "end" and ordered:
        raise FilterError(f"{key} has no order: expected ==, != or in, found {filter!r:.80}")


def _may_be(kinds: frozenset[str], scalar: Scalar, ordered: bool) -> bool:
    """Whether a field of these kinds may hold a scalar; with `ordered`, whether it may be ordered with it."""
    if scalar.kind == "number" and "whole" in kinds:
        return ordered or scalar.value % 1 == 0
    return scalar.kind in kinds


def _in_time(filter: BaseFilter, key: str, now: datetime.datetime) -> BaseFilter:
    """A comparison with times, as comparisons of `key` with nanoseconds."""

    def within(span: TimeSpan) -> BaseFilter:
        return FilterAND(filters=[FilterGEQ(key=key, value=span.start), FilterLT(key=key, value=span.stop)])

    if filter.type is FilterType.CONTAINS:
        raise FilterError(
            f"{filter.key!r} is a time, which contains no text: expected one of = != < <= > >= or in"
        )
    if filter.type is FilterType.IN:
        return FilterOR(filters=[within(_time(filter, value, now)) for value in filter.value])
    span = _time(filter, filter.value, now)
    if filter.type is FilterType.EQ:
        return within(span)
    early, late = FilterLT(key=key, value=span.start), FilterGEQ(key=key, value=span.stop)
    if filter.type is FilterType.NE:  # not the complement, which is true where there is no time
        return FilterOR(filters=[early, late])
    if filter.type is FilterType.LT:
        return early
    if filter.type is FilterType.GT:
        return late
    if filter.type is FilterType.GEQ:
        return FilterGEQ(key=key, value=span.start)
    return FilterLT(key=key, value=span.stop)


def _time(filter: BaseFilter, value: object, now: datetime.datetime) -> TimeSpan:
    try:
        return span_of(value, now)
    except ValueError as err:
        raise FilterError(f"{filter.key!r} is a time: expected {EXPECTED}; found {value!r:.60}") from err


@lru_cache(maxsize=256)
def _kinds_of(model: type[BaseModel], name: str) -> frozenset[str]:
    """The kinds of scalars that a field may hold, by itself or in a list; none if it holds mappings."""
    annotation = DERIVED[name] if name in DERIVED else model.model_fields[name].annotation
    if typing.get_origin(annotation) is list:
        annotation = typing.get_args(annotation)[0]
    several = typing.get_origin(annotation) in (types.UnionType, typing.Union)
    parts = typing.get_args(annotation) if several else (annotation,)
    return frozenset(_KINDS[part] for part in parts) if set(parts) <= set(_KINDS) else frozenset()


def _one_of(kinds: frozenset[str]) -> str:
    return " or ".join(_WORDS[kind] for kind in _WORDS if kind in kinds)
