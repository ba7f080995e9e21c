"""Filters in SQLite: operands of metadata, and the functions that decide what SQLite cannot.

A metadata key is two expressions: its kind (`null`, `bool`, `number`, `nan`, `text`, `other`, NULL where it
is missing) and its value. A declared key has them as generated columns with an index over both, which is why
every comparison starts with the kind.

SQLite reads a decimal number to within a few units in the last place, and integers beyond 64 bits as floats.
A comparison with a number therefore is SQL outside a narrow band around it, and inside that band, for what
SQLite holds as a float, `tupli_match` asks Python: exact, and rarely called.
"""

from __future__ import annotations

import json
import math
import re
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from sqlalchemy import Text, and_, case, column, false, func, literal_column, null, or_, select, true
from sqlalchemy.dialects import sqlite
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlalchemy.sql.elements import ColumnElement

from tupli_mcap.schema import BaseFilter, FilterIN, FilterType, compile_predicate, join_key, split_key
from tupli_mcap.schema.predicate import scalar_test
from tupli_mcap.schema.values import FLOAT_TAG, Scalar, against_floats, classify
from tupli_mcap.storage.catalog.rows import load_metadata, load_number
from tupli_mcap.storage.catalog.sql import Condition, Operand, ScalarOperand, apply, bindable, whole_numbers
from tupli_mcap.storage.catalog.tables import (
    EPISODE,
    EPISODE_BITS,
    METADATA,
    RECORDING,
    AsStored,
    declared_columns,
    declared_index,
)
from tupli_mcap.storage.common import escape_text

_SEARCHABLE: Final = re.compile(r"(?!\$)[ !#-&(-\[\]-~]+")  # printable ASCII without " ' and \
_FEW: Final = 16  # so many numbers of an IN are looked up one by one
_FEW_VALUES: Final = 500

# Far wider than what SQLite's reading of decimals errs by, narrow enough to hold few values.
_RELATIVE_BAND: Final = 1e-12
_ABSOLUTE_BAND: Final = 1e-300

_DIALECT: Final = sqlite.dialect()
_OWN_COLUMNS: Final = ("n_tuples", "env", "end", "episode_return", "seed", "created_at", "created_by")

_Value = ColumnElement[Any]


class SqliteDialect:
    """SQLite's part of compiling filters; `declared` maps the paths of declared keys to their numbers."""

    def __init__(self, declared: Mapping[tuple[str, ...], int]) -> None:
        self._declared = declared

    def metadata(self, path: tuple[str, ...]) -> Operand:
        number = self._declared.get(path)
        if number is not None:
            kind, value = declared_columns(number)
            return _Json(path, _declared(kind), _declared(value), self)
        if is_searchable(path):
            return _Json(path, *_expressions(path, EPISODE.c.metadata), self)
        return _Unsearchable()

    def metadata_filter(self, filter: BaseFilter) -> Condition:
        return _asked(filter)

    def number(self, column: _Value) -> Operand:
        return _Number(column)

    def any_text(self, column: _Value, texts: Sequence[str]) -> Condition:
        if len(texts) <= _FEW_VALUES:
            return column.in_(texts)
        # SQLite takes some 30,000 parameters, and a list of any length.
        values = func.json_each(json.dumps(texts, ensure_ascii=False)).table_valued("value")
        return column.in_(select(values.c.value))

    def any_integer(self, column: _Value, integers: Sequence[int]) -> Condition:
        if len(integers) <= _FEW_VALUES:
            return column.in_(integers)
        values = func.json_each(json.dumps(integers)).table_valued("value")
        return column.in_(select(values.c.value))

    def any_episode(self, episodes: Sequence[tuple[str, int]]) -> Condition:
        # One list of row ids, so that SQLite finds each by its primary key.
        wanted = func.json_each(json.dumps(episodes, ensure_ascii=False)).table_valued("value")
        recording = RECORDING.alias("named")
        row = recording.c.id.op("<<")(EPISODE_BITS) + func.json_extract(wanted.c.value, "$[1]")
        named = recording.c.uuid == func.json_extract(wanted.c.value, "$[0]")
        return EPISODE.c.id.in_(select(row).select_from(wanted.join(recording, named)))


def is_searchable(path: tuple[str, ...]) -> bool:
    """Whether SQLite can be given the path; it knows no way to write a quote in one."""
    return all(_SEARCHABLE.fullmatch(segment) for segment in path)


def key_ddl(path: tuple[str, ...]) -> list[str]:
    """The SQL of the generated columns (kind, value) of a searchable metadata path."""
    source = column(EPISODE.c.metadata.name, Text)
    return [
        str(part.compile(dialect=_DIALECT, compile_kwargs={"literal_binds": True}))
        for part in _expressions(path, source)
    ]


def table_statements() -> list[str]:
    """The SQL that makes the tables of an empty catalog."""
    made: list[CreateTable | CreateIndex] = []
    for table in METADATA.sorted_tables:
        indexes = sorted(table.indexes, key=lambda index: str(index.name))
        made += [CreateTable(table), *(CreateIndex(index) for index in indexes)]
    return [str(statement.compile(dialect=_DIALECT)) for statement in made]


def key_statements(key: str, number: int) -> Iterator[str]:
    """The SQL that declares a key: generated columns and an index, or an index where it has a column."""
    name, *inside = split_key(key)
    name = {"ended": "created_at"}.get(name, name)
    if name == "metadata":
        columns: tuple[str, ...] = declared_columns(number)
        for made, expression in zip(columns, key_ddl(tuple(inside)), strict=True):
            # Without a type, so that a text of digits stays a text.
            yield f"ALTER TABLE {EPISODE.name} ADD COLUMN {made} GENERATED ALWAYS AS ({expression}) VIRTUAL"
    elif name in _OWN_COLUMNS:
        columns = (name,)
    else:
        return  # of recordings there are few, and the others are lists
    quoted = ", ".join(f'"{part}"' for part in columns)
    yield f"CREATE INDEX {declared_index(number)} ON {EPISODE.name} ({quoted})"


def register_functions(connection: sqlite3.Connection) -> None:
    """Give a connection the functions that compiled filters call."""
    connection.create_function("tupli_match", 2, _match, deterministic=True)
    connection.create_function("tupli_compare", 2, _compare, deterministic=True)


def _match(filter_json: str, metadata: str) -> bool:
    """Whether a filter on `metadata.…` is true of a metadata text."""
    return _predicate(filter_json)({"metadata": load_metadata(metadata)})


def _compare(filter_json: str, number: float | str | None) -> bool:
    """Whether a comparison is true of a number as the catalog holds it."""
    return _test(filter_json)(classify(load_number(number)))


@lru_cache(maxsize=256)
def _predicate(filter_json: str) -> Callable[[Mapping[str, Any]], bool]:
    return compile_predicate(BaseFilter.model_validate_json(filter_json))


@lru_cache(maxsize=256)
def _test(filter_json: str) -> Callable[[Scalar], bool]:
    return scalar_test(BaseFilter.model_validate_json(filter_json))


def _asked(filter: BaseFilter) -> Condition:
    """The filter, decided by Python from the whole metadata."""
    text = func.coalesce(EPISODE.c.original, EPISODE.c.metadata)
    return func.tupli_match(filter.model_dump_json(), text) == 1


def _compared(filter: BaseFilter, column: _Value) -> Condition:
    """A comparison with a column of numbers, decided by Python."""
    return func.tupli_compare(filter.model_dump_json(), column) == 1


def _expressions(path: tuple[str, ...], source: _Value) -> tuple[_Value, _Value]:
    """Kind and value of a path in a column of metadata."""
    where = "$" + "".join(f'."{segment}"' for segment in path)
    json_type = func.json_type(source, where, type_=Text)
    tagged = func.json_extract(source, f'{where}."{FLOAT_TAG}"', type_=Text)
    kinds = {"integer": "number", "real": "number", "text": "text", "true": "bool", "false": "bool"}
    kinds |= {"null": "null", "array": "other"}
    floats = {"nan": "nan", "inf": "number", "-inf": "number"}
    of_object = case(_words(floats), value=tagged, else_=_word("other"))
    kind = case(_words(kinds) | {"object": of_object}, value=json_type)
    value = case(
        {"object": case({"inf": _INFINITY, "-inf": -_INFINITY}, value=tagged), "array": null()},
        value=json_type,
        else_=func.json_extract(source, where, type_=AsStored),
    )
    return kind, value


_INFINITY: Final[_Value] = literal_column("9e999")


def _declared(name: str) -> _Value:
    return literal_column(f"{EPISODE.name}.{name}")


def _words(texts: Mapping[str, str]) -> dict[str, _Value]:
    return {name: _word(text) for name, text in texts.items()}


def _word(text: str) -> _Value:
    return literal_column(f"'{text}'")


class _Json(ScalarOperand):
    """A metadata key that SQLite can look up."""

    def __init__(self, path: tuple[str, ...], kind: _Value, value: _Value, dialect: SqliteDialect) -> None:
        self._key = join_key(("metadata", *path))
        self._kind = kind
        self._value = value
        self._dialect = dialect
        self.present = kind.is_not(None)

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind == "nan":
            return false()
        of_kind = self._kind == wanted.kind
        if wanted.kind == "null":
            return of_kind
        if wanted.kind == "number":
            return and_(of_kind, self._number(operation, wanted.value))
        right = escape_text(wanted.value) if wanted.kind == "text" else int(wanted.value)
        return and_(of_kind, apply(operation, self._value, right))

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        texts = [escape_text(choice.value) for choice in choices if choice.kind == "text"]
        numbers = [choice.value for choice in choices if choice.kind == "number"]
        rest = [choice for choice in choices if choice.kind not in ("text", "number")]
        parts = [self._one(FilterType.EQ, choice) for choice in rest]
        if texts:
            parts.append(and_(self._kind == "text", self._dialect.any_text(self._value, texts)))
        if len(numbers) <= _FEW:
            parts += [self._one(FilterType.EQ, Scalar("number", number)) for number in numbers]
        else:
            within = self._value.between(_band(min(numbers))[0], _band(max(numbers))[1])
            whole = self._dialect.any_integer(self._value, whole_numbers(choices))
            asked = _asked(FilterIN(key=self._key, value=numbers))
            decided = case((func.typeof(self._value) == "integer", whole), else_=asked)
            parts.append(and_(self._kind == "number", within, decided))
        return or_(false(), *parts)

    def _number(self, operation: FilterType, number: float) -> Condition:
        value, (low, high) = self._value, _band(number)
        asked = _asked(BaseFilter(type=operation, key=self._key, value=number))
        exact = (func.typeof(value) == "integer", apply(operation, value, bindable(number)))
        if operation is FilterType.EQ:
            return and_(value.between(low, high), case(exact, else_=asked))
        if operation in (FilterType.GT, FilterType.GEQ):
            return and_(value >= low, case(exact, (value > high, true()), else_=asked))
        return and_(value <= high, case(exact, (value < low, true()), else_=asked))


def _band(number: float) -> tuple[float, float]:
    """Where a float that SQLite has read may be any side of `number`."""
    try:
        centre = float(number)
    except OverflowError:
        centre = math.inf if number > 0 else -math.inf
    width = abs(centre) * _RELATIVE_BAND + _ABSOLUTE_BAND
    if math.isinf(centre):
        return centre, centre
    return centre - width, centre + width


class _Unsearchable:
    """A metadata key that SQLite cannot look up."""

    def compare(self, filter: BaseFilter) -> Condition:
        return _asked(filter)


class _Number(ScalarOperand):
    """A column of numbers, where NULL is null and a text a number that SQLite has no type for."""

    def __init__(self, column: _Value) -> None:
        self._column = column

    def _any(self, choices: Sequence[Scalar]) -> Condition:
        if len(choices) <= _FEW:
            return super()._any(choices)
        return _compared(FilterIN(key="value", value=[choice.value for choice in choices]), self._column)

    def _one(self, operation: FilterType, wanted: Scalar) -> Condition:
        if wanted.kind == "null":
            return self._column.is_(None)
        if wanted.kind != "number":
            return false()
        asked = _compared(BaseFilter(type=operation, key="value", value=wanted.value), self._column)
        exact: tuple[str, float] | None = operation, wanted.value
        if bindable(wanted.value) != wanted.value:  # an integer beyond 64 bits; those stored are texts
            exact = against_floats(operation, wanted.value)
        if exact is None:
            return and_(self._column >= "", asked)
        compared = apply(FilterType(exact[0]), self._column, exact[1])
        # SQLite sorts texts after all numbers.
        if operation in (FilterType.GT, FilterType.GEQ):
            return and_(compared, or_(self._column < "", asked))
        return or_(compared, and_(self._column >= "", asked))
