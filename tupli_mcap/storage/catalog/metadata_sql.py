"""What SQL finds at a path of metadata, where no key was declared: in SQLite as its JSON functions give it, in
PostgreSQL as `jsonb`.

Both are compared with texts, numbers and flags. A comparison may also be true of values of another kind, which SQLite
and PostgreSQL order each in their own way.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import JSON, Dialect, Text, literal
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.sql.compiler import SQLCompiler
from sqlalchemy.sql.functions import FunctionElement
from sqlalchemy.types import NullType, TypeDecorator, TypeEngine

from tupli_mcap.storage.catalog.tables import EPISODE

__all__ = ["kind_at", "value_at"]


class _Scalar(TypeDecorator[Any]):
    impl = JSON
    cache_ok = True

    def load_dialect_impl(self, dialect: Dialect) -> TypeEngine[Any]:
        return dialect.type_descriptor(JSONB() if dialect.name == "postgresql" else NullType())


class _At(FunctionElement[Any]):
    """Something at a path, whose segments are printable ASCII without quotes and backslashes."""

    def __init__(self, path: Sequence[str]) -> None:
        for_sqlite = "$" + "".join(f'."{segment}"' for segment in path)
        for_postgresql = "{" + ",".join(f'"{segment}"' for segment in path) + "}"
        super().__init__(EPISODE.c.metadata, literal(for_sqlite, Text), literal(for_postgresql, Text))


class value_at(_At):  # noqa: N801 - it is used as a function
    """The value, to be compared with a text, a number or a flag; NULL if there is none."""

    type = _Scalar()
    inherit_cache = True


class kind_at(_At):  # noqa: N801
    """The kind of the value as a text: `null`, `array`, and others; NULL if there is none."""

    type = Text()
    inherit_cache = True


@compiles(value_at)
def _value_in_sqlite(element: value_at, compiler: SQLCompiler, **options: Any) -> str:
    metadata, path, _ = element.clauses
    return f"json_extract({compiler.process(metadata, **options)}, {compiler.process(path, **options)})"


@compiles(kind_at)
def _kind_in_sqlite(element: kind_at, compiler: SQLCompiler, **options: Any) -> str:
    metadata, path, _ = element.clauses
    return f"json_type({compiler.process(metadata, **options)}, {compiler.process(path, **options)})"


@compiles(value_at, "postgresql")
def _value_in_postgresql(element: _At, compiler: SQLCompiler, **options: Any) -> str:
    metadata, _, path = element.clauses
    found = f"CAST({compiler.process(metadata, **options)} AS JSONB)"
    return f"({found} #> CAST({compiler.process(path, **options)} AS TEXT[]))"


@compiles(kind_at, "postgresql")
def _kind_in_postgresql(element: kind_at, compiler: SQLCompiler, **options: Any) -> str:
    return f"jsonb_typeof{_value_in_postgresql(element, compiler, **options)}"
