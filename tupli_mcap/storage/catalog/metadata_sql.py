"""SQL that differs between SQLite and PostgreSQL.

Values at a path of metadata, without a declared key, are found with the JSON functions of SQLite, and in PostgreSQL as
`jsonb`. Look only into metadata that are `readable`: PostgreSQL raises an error for others.

A list of ids is one value of a statement: as many values, they would have to be written and read one by one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

from sqlalchemy import ARRAY, JSON, BigInteger, ColumnElement, Dialect, Float, Text, literal
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import NullType, TypeDecorator, TypeEngine

from tupli_mcap.storage.catalog.tables import EPISODE, TEXT

_SEARCHABLE: Final = re.compile(r"(?!\$)[ !#-&(-\[\]-~]+")  # printable ASCII without " ' and \


def can_search(path: Sequence[str]) -> bool:
    """Whether SQL can look for a path of metadata."""
    return all(map(_SEARCHABLE.fullmatch, path))


class _Scalar(TypeDecorator[Any]):
    impl = JSON
    cache_ok = True

    def load_dialect_impl(self, dialect: Dialect) -> TypeEngine[Any]:
        return dialect.type_descriptor(JSONB() if dialect.name == "postgresql" else NullType())


class _At(FunctionElement[Any]):
    """Something at a path that `can_search` allows."""

    def __init__(self, path: Sequence[str]) -> None:
        for_sqlite = "$" + "".join(f'."{segment}"' for segment in path)
        for_postgresql = "{" + ",".join(f'"{segment}"' for segment in path) + "}"
        super().__init__(EPISODE.c.metadata, literal(for_sqlite, Text), literal(for_postgresql, Text))


class value_at(_At):  # noqa: N801 - it is used as a function
    """The value, to compare with a text, a number or a flag; NULL if there is none.

    A comparison may also be true for values of another kind, which each database orders differently.
    """

    type = _Scalar()
    inherit_cache = True


class number_at(_At):  # noqa: N801
    """The value as a float, if it is a number or a flag; else NULL."""

    type = Float()
    inherit_cache = True


class text_at(_At):  # noqa: N801
    """The value, if it is a text; else NULL."""

    type = TEXT
    inherit_cache = True


class kind_at(_At):  # noqa: N801
    """The kind of the value as a text: `null`, `array`, and others; NULL if there is none."""

    type = Text()
    inherit_cache = True


@compiles(value_at)
def _value(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    return f"json_extract({_in_sqlite(element, compiler, options)})"


@compiles(kind_at)
def _kind(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    return f"json_type({_in_sqlite(element, compiler, options)})"


@compiles(number_at)
def _number(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    kind, value = (made(element, compiler, **options) for made in (_kind, _value))
    return f"CASE WHEN {kind} IN ('integer', 'real', 'true', 'false') THEN CAST({value} AS REAL) END"


@compiles(text_at)
def _text(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    kind, value = (made(element, compiler, **options) for made in (_kind, _value))
    return f"CASE WHEN {kind} = 'text' THEN {value} END"


@compiles(value_at, "postgresql")
def _jsonb_value(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    metadata, _, path = (compiler.process(clause, **options) for clause in element.clauses)
    return f"(CAST({metadata} AS JSONB) #> CAST({path} AS TEXT[]))"


@compiles(kind_at, "postgresql")
def _jsonb_kind(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    return f"jsonb_typeof{_jsonb_value(element, compiler, **options)}"


@compiles(number_at, "postgresql")
def _jsonb_number(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    kind, value = (made(element, compiler, **options) for made in (_jsonb_kind, _jsonb_value))
    number = f"WHEN 'number' THEN CAST({value} AS DOUBLE PRECISION)"
    flag = f"WHEN 'boolean' THEN CAST(CAST(CAST({value} AS BOOLEAN) AS INTEGER) AS DOUBLE PRECISION)"
    return f"CASE {kind} {number} {flag} END"


@compiles(text_at, "postgresql")
def _jsonb_text(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    kind, value = (made(element, compiler, **options) for made in (_jsonb_kind, _jsonb_value))
    return f"CASE {kind} WHEN 'string' THEN {value} #>> '{{}}' END COLLATE \"C\""


_IDS: Final = JSON().with_variant(ARRAY(BigInteger), "postgresql")


class among(FunctionElement[bool]):  # noqa: N801
    """Whether a row id is one of some ids. Not of the type Boolean: `= 1` would follow it in SQLite, which then uses no
    index."""

    inherit_cache = True

    def __init__(self, row_id: ColumnElement[int], ids: Sequence[int]) -> None:
        super().__init__(row_id, literal(ids, _IDS))


@compiles(among)
def _among(element: among, compiler: SQLCompiler, **options: Any) -> str:
    row_id, ids = (compiler.process(clause, **options) for clause in element.clauses)
    return f"{row_id} IN (SELECT value FROM json_each({ids}))"


@compiles(among, "postgresql")
def _among_array(element: among, compiler: SQLCompiler, **options: Any) -> str:
    row_id, ids = (compiler.process(clause, **options) for clause in element.clauses)
    return f"{row_id} = ANY({ids})"


def _in_sqlite(element: _At, compiler: SQLCompiler, options: dict[str, Any]) -> str:
    metadata, path, _ = (compiler.process(clause, **options) for clause in element.clauses)
    return f"{metadata}, {path}"
