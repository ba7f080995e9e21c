"""Filters compiled to SQL, with the meaning that `tupli_mcap.schema.filters` gives them.

An expression made here may be NULL where the filter is false, never where it is true; NOT takes that into
account. A comparison is made by an `Operand`, one class per kind of column, and the operands of metadata come
from a `Dialect`: the rest is common to all databases.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, Protocol

from sqlalchemy import Text, and_, case, cast, false, or_, true
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, FilterIN, FilterType, bound
from tupli_mcap.schema.facts import comparisons
from tupli_mcap.schema.filters import COMBINING, path_of
from tupli_mcap.schema.values import Scalar, classify
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING
from tupli_mcap.storage.common import escape_text

Condition = ColumnElement[bool]

_EPISODE_NUMBER: Final = re.compile("0|[1-9][0-9]{0,9}")
# A database compares the constants of a statement with each other, and parses a chain of ORs as a deep tree.
_MANY: Final = 64
_MAX_TERMS: Final = 500


class Operand(Protocol):
    """One side of a comparison: what is known of a key in SQL."""

    def compare(self, filter: BaseFilter) -> Condition:
        """True where the comparison is."""


class Dialect(Protocol):
    """What differs between databases."""

    def metadata(self, path: tuple[str, ...]) -> Operand:
        """The operand of a path inside the metadata (one segment or more)."""

    def metadata_filter(self, filter: BaseFilter) -> Condition:
        """A filter that is about metadata only, of any size."""

    def number(self, column: ColumnElement[Any]) -> Operand:
        """The operand of a nullable column of numbers."""

    def any_text(self, column: ColumnElement[Any], texts: Sequence[str]) -> Condition:
        """True where a column holds one of `texts` (one or more, escaped; thousands are fine)."""

    def any_integer(self, column: ColumnElement[Any], integers: Sequence[int]) -> Condition:
        """True where a column holds one of `integers` (64 bits each; thousands are fine)."""

    def any_episode(self, episodes: Sequence[tuple[str, int]]) -> Condition:
        """True of the episodes named by (uuid of the recording, number) (one or more, escaped)."""


def compile_filter(filter: BaseFilter | None, dialect: Dialect) -> Condition:
    """The condition on rows of `EPISODE` joined with `RECORDING` that a filter stands for.

    Raises:
        FilterError: The filter names an unknown top-level key, compares a fact with what it can never be, or makes too
            many comparisons.
    """
    if filter is None:
        return true()
    return _compile(bound(filter, EpisodeHeader), dialect)


def _compile(filter: BaseFilter, dialect: Dialect) -> Condition:
    if filter.type is FilterType.NOT:
        return negated(_compile(filter.filters[0], dialect))
    if filter.type not in COMBINING:
        return _operand(path_of(filter), dialect).compare(filter)
    either = filter.type is FilterType.OR
    parts = _merged(filter.filters) if either else filter.filters
    inside: list[BaseFilter] = []
    others: list[BaseFilter] = []
    if sum(1 for part in parts for _ in comparisons(part)) > _MANY:
        for part in parts:
            (inside if _is_metadata_only(part) else others).append(part)
    else:
        others = list(parts)
    if len(others) > _MAX_TERMS:
        raise FilterError(
            f"a filter has at most {_MAX_TERMS} comparisons outside the metadata beside each other, "
            f"found {len(others)}; ask for many values of one key with IN"
        )
    compiled = [_compile(part, dialect) for part in others]
    if inside:
        compiled.append(dialect.metadata_filter(BaseFilter(type=filter.type, filters=inside)))
    return or_(false(), *compiled) if either else and_(true(), *compiled)


def _is_metadata_only(filter: BaseFilter) -> bool:
    return all(path_of(item)[0] == "metadata" for item in comparisons(filter))


def negated(condition: Condition) -> Condition:
    """True where a condition is false or NULL."""
    return case((condition, false()), else_=true())


def _merged(filters: Iterable[BaseFilter]) -> list[BaseFilter]:
    """The parts of an OR, where those that ask one key for one value each are one IN."""
    values: dict[tuple[str, ...], list[Any]] = {}
    rest: list[BaseFilter] = []
    for part in filters:
        if part.type is FilterType.EQ:
            values.setdefault(path_of(part), []).append(part)
        else:
            rest.append(part)
    for parts in values.values():
        if len(parts) == 1:
            rest.append(parts[0])
        else:
            rest.append(FilterIN(key=parts[0].key, value=[part.value for part in parts]))
    return rest


def _operand(path: tuple[str, ...], dialect: Dialect) -> Operand:
    name, *inside = path
    if name == "metadata":
        return dialect.metadata(tuple(inside)) if inside else PRESENT
    if inside:
        return ABSENT  # the other fields are no mappings
    if name == "id":
        return _EpisodeId(dialect)
    if name in _TEXTS:
        return TextOperand(_TEXTS[name], dialect)
    if name in _INTEGERS:
        return IntegerOperand(_INTEGERS[name], dialect)
    if name in _FLAGS:
        return _Flag(_FLAGS[name])
    if name in _NUMBERS:
        return dialect.number(_NUMBERS[name])
    return PRESENT


_TEXTS: Final[Mapping[str, ColumnElement[Any]]] = {
    "created_by": EPISODE.c.created_by,
    "benchmark_id": RECORDING.c.benchmark_id,
    "end": EPISODE.c.end,
    "recording": RECORDING.c.path,
}
_INTEGERS: Final[Mapping[str, ColumnElement[Any]]] = {
    "created_at": EPISODE.c.created_at,
    "n_tuples": EPISODE.c.n_tuples,
    "env": EPISODE.c.env,
    "episode": EPISODE.c.episode,
}
_FLAGS: Final = {"terminated": EPISODE.c.end == "terminal", "timeout": EPISODE.c.end == "timeout"}
_NUMBERS: Final[Mapping[str, ColumnElement[Any]]] = {
    "episode_return": EPISODE.c.episode_return,
    "seed": EPISODE.c.seed,
}


_OPERATORS: Final[Mapping[FilterType, Callable[[Any, Any], Any]]] = {
    FilterType.EQ: operator.eq,
    FilterType.GT: operator.gt,
    FilterType.GEQ: operator.ge,
    FilterType.LT: operator.lt,
    FilterType.LEQ: operator.le,
}


def apply(operation: FilterType, left: ColumnElement[Any], right: Any) -> Condition:
    """The SQL comparison that a filter's type names: EQ, GT, GEQ, LT or LEQ."""
    result: Condition = _OPERATORS[operation](left, right)
    return result


class ScalarOperand:
    """An operand that compares with one scalar at a time; subclasses know how for each kind."""

    present: Condition = true()

    def compare(self, filter: BaseFilter) -> Condition:
        if filter.type is FilterType.IN:
            return self._any([classify(value) for value in filter.value])
        if filter.type is FilterType.NE:
            return and_(self.present, negated(self._one(FilterType.EQ, classify(filter.value))))
        return self._one(filter.type, classify(filter.value))

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        return or_(false(), *(self._one(FilterType.EQ, choice) for choice in choices))

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        raise NotImplementedError


class _Present(ScalarOperand):
    """A key that is there and holds no scalar."""

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        return false()


class _Absent:
    """A key that is nowhere."""

    def compare(self, filter: BaseFilter) -> Condition:
        return false()


PRESENT: Final = _Present()
ABSENT: Final = _Absent()


class TextOperand(ScalarOperand):
    """A column of texts, never NULL."""

    def __init__(self, column: ColumnElement[Any], dialect: Dialect) -> None:
        self._column = column
        self._dialect = dialect

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind != "text":
            return false()
        return apply(operation, self._column, escape_text(wanted.value))

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        texts = [escape_text(choice.value) for choice in choices if choice.kind == "text"]
        return self._dialect.any_text(self._column, texts) if texts else false()


class IntegerOperand(ScalarOperand):
    """A column of 64-bit integers, never NULL."""

    def __init__(self, column: ColumnElement[Any], dialect: Dialect) -> None:
        self._column = column
        self._dialect = dialect

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind != "number":
            return false()
        return apply(operation, self._column, bindable(wanted.value))

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        return self._dialect.any_integer(self._column, whole_numbers(choices))


class _Flag(ScalarOperand):
    """A condition that is never NULL, as a column of booleans."""

    def __init__(self, condition: Condition) -> None:
        self._condition = condition

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind != "bool" or operation is not FilterType.EQ:
            return false()
        return self._condition if wanted.value else negated(self._condition)


class _EpisodeId(ScalarOperand):
    """The id of an episode: its recording's uuid, a hyphen and its number."""

    def __init__(self, dialect: Dialect) -> None:
        self._dialect = dialect

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind != "text":
            return false()
        if operation is not FilterType.EQ:
            return apply(operation, RECORDING.c.uuid + "-" + cast(EPISODE.c.episode, Text), wanted.value)
        return self._any([wanted])

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        # Taken apart, so that indexes lead to them.
        parts = (choice.value.rpartition("-") for choice in choices if choice.kind == "text")
        episodes = [
            (escape_text(uuid), int(number)) for uuid, _, number in parts if _EPISODE_NUMBER.fullmatch(number)
        ]
        return self._dialect.any_episode(episodes) if episodes else false()


def bindable(number: float) -> float:
    """A number that a database can be given, and that compares with every 64-bit integer as `number` does."""
    if isinstance(number, int) and not -(2**63) <= number < 2**63:
        return math.inf if number > 0 else -math.inf
    return number


def whole_numbers(choices: Iterable[Scalar]) -> list[int]:
    """The 64-bit integers among scalars, floats with such a value included."""
    numbers = (choice.value for choice in choices if choice.kind == "number")
    return [int(number) for number in numbers if -(2**63) <= number < 2**63 and int(number) == number]
