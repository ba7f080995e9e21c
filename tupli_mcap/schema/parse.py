"""Filters as text, for command lines: `metadata.score > -200 and (env in [1, 2] or not terminated = true)`.

    filter     = conjunction { "or" conjunction }
    conjunction = negation { "and" negation }
    negation   = "not" negation | "(" filter ")" | comparison
    comparison = key ( "=" | "==" | "!=" | ">" | ">=" | "<" | "<=" ) value
               | key [ "not" ] "in" "[" [ value { "," value } ] "]"
    value      = number | "text" | 'text' | true | false | null | nan | inf | -inf

Words are case-insensitive (`none` is `null`), keys are not; a name in a key that is no word is quoted:
`metadata."a b"`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from tupli_mcap.errors import FilterError
from tupli_mcap.schema.filters import (
    BaseFilter,
    FilterAND,
    FilterEQ,
    FilterGEQ,
    FilterGT,
    FilterIN,
    FilterLEQ,
    FilterLT,
    FilterNE,
    FilterNOT,
    FilterOR,
    FilterType,
    path_of,
)
from tupli_mcap.schema.values import tag_float

_MAX_PARENTHESES: Final = 64
_TOKEN: Final = re.compile(
    r"""\s*(?:
      (?P<number>[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|inf\b|nan\b))
    | (?P<text>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')
    | (?P<word>[^\W\d][\w\-]*(?:\.(?:[\w\-]+|"(?:[^"\\]|\\.)*"))*)
    | (?P<sign>==|!=|>=|<=|[=<>()\[\],])
    | (?P<end>\Z)
    )""",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
_UNQUOTED: Final = re.compile(r"""[^\s()\[\],"'=<>!][^()\[\],"']*""")
_AFTER_UNQUOTED: Final = re.compile(r"\s(?:and|or)\b", re.IGNORECASE)
_COMPARISON: Final[Mapping[str, type[BaseFilter]]] = {
    "=": FilterEQ,
    "==": FilterEQ,
    "!=": FilterNE,
    ">": FilterGT,
    ">=": FilterGEQ,
    "<": FilterLT,
    "<=": FilterLEQ,
}
_SIGNS: Final = {cls.model_fields["type"].default: sign for sign, cls in _COMPARISON.items()}
_CONSTANTS: Final[Mapping[str, Any]] = {"true": True, "false": False, "null": None, "none": None}
_RESERVED: Final = frozenset({"and", "or", "not", "in", "nan", "inf", *_CONSTANTS})
_PLAIN_KEY: Final = re.compile(r"[^\W\d][\w\-]*")
_PLAIN_SEGMENT: Final = re.compile(r"[\w\-]+")
_ESCAPES: Final = {"n": "\n", "t": "\t", "r": "\r"}
_SINGLE_ESCAPE: Final = re.compile(r"\\(.)", re.DOTALL)


class _Token(NamedTuple):
    kind: str
    text: str
    position: int

    def says(self, *words: str) -> bool:
        return self.kind in ("word", "sign") and self.text.lower() in words


def parse_filter(text: str) -> BaseFilter:
    """The filter that a text describes.

    Raises:
        FilterError: The text is no filter, or a comparison in it has no meaning; names the character
            (from 0) and what was expected there.
    """
    parser = _Parser(text)
    parsed = parser.filter(0)
    parser.expect_end()
    return parsed


def format_filter(filter: BaseFilter) -> str:
    """The text that `parse_filter` makes this filter of.

    Raises:
        FilterError: The filter has no such text: an empty AND or OR, or a key that starts with no word.
    """
    return _format(filter, outer=True)


class _Parser:
    """Recursive descent over the tokens of one text, one token ahead."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._position = 0
        self._next = self._read()

    def filter(self, depth: int) -> BaseFilter:
        parts = [self._conjunction(depth)]
        while self._next.says("or"):
            self._take()
            parts.append(self._conjunction(depth))
        return parts[0] if len(parts) == 1 else FilterOR(filters=parts)

    def expect_end(self) -> None:
        if self._next.kind != "end":
            raise self._error("and, or, or the end")

    def _conjunction(self, depth: int) -> BaseFilter:
        parts = [self._negation(depth)]
        while self._next.says("and"):
            self._take()
            parts.append(self._negation(depth))
        return parts[0] if len(parts) == 1 else FilterAND(filters=parts)

    def _negation(self, depth: int) -> BaseFilter:
        if depth > _MAX_PARENTHESES:
            raise FilterError(
                f"filter nests deeper than {_MAX_PARENTHESES} at character {self._next.position}"
            )
        if self._next.says("not"):
            self._take()
            return FilterNOT(filters=[self._negation(depth + 1)])
        if self._next.says("("):
            self._take()
            inner = self.filter(depth + 1)
            self._expect(")")
            return inner
        return self._comparison()

    def _comparison(self) -> BaseFilter:
        token = self._next
        if token.kind != "word" or token.text.lower() in _RESERVED:
            raise self._error("a key such as metadata.score")
        self._take()
        try:
            return self._compare(token.text)
        except FilterError as err:
            if "at character" in str(err):
                raise
            raise FilterError(f"{err} (at character {token.position} of the filter)") from err

    def _compare(self, key: str) -> BaseFilter:
        if self._next.says("not"):
            self._take()
            self._expect("in")
            return FilterNOT(filters=[FilterIN(key=key, value=self._list())])
        if self._next.says("in"):
            self._take()
            return FilterIN(key=key, value=self._list())
        if not self._next.says(*_COMPARISON):
            raise self._error(f"one of {' '.join(_COMPARISON)} in")
        cls = _COMPARISON[self._take().text]
        return cls(key=key, value=self._value())

    def _list(self) -> list[Any]:
        self._expect("[")
        values: list[Any] = []
        while not self._next.says("]"):
            values.append(self._value())
            if not self._next.says("]"):
                self._expect(",")
        self._take()
        return values

    def _value(self) -> Any:
        token = self._next
        if token.kind == "number":
            value: Any = self._number(token.text)
        elif token.kind == "text":
            value = self._string(token.text)
        elif token.kind == "word" and token.text.lower() in _CONSTANTS:
            value = _CONSTANTS[token.text.lower()]
        else:
            raise self._no_value(token)
        self._take()
        touches = self._next.position == token.position + len(token.text)
        if touches and self._next.kind in ("number", "word", "unknown") and not self._next.says("and", "or"):
            raise self._no_value(token)  # 2024-05-01, 7d ago, 1.2.3
        return value

    def _no_value(self, token: _Token) -> FilterError:
        """What to say of a token that begins no value, perhaps a text or a time without quotes."""
        expected = 'a value (a number, "text", true, false or null)'
        match = _UNQUOTED.match(self._text, token.position)
        if match is None or token.says("and", "or", "not", "in"):
            return self._error(expected, token)
        unquoted = _AFTER_UNQUOTED.split(match[0], maxsplit=1)[0].rstrip()
        before, after = self._text[: token.position], self._text[token.position + len(unquoted) :]
        right = f"{before}{json.dumps(unquoted, ensure_ascii=False)}{after}"
        error = self._error(expected, token._replace(text=unquoted))
        return FilterError(f"{error}; put a text or a time in quotes, as in {right:.200}")

    def _number(self, text: str) -> float:
        try:
            return float(text) if re.search(r"[.enEN]", text) else int(text)
        except ValueError as err:  # Python refuses ints of more than 4300 digits
            raise self._error("a shorter number") from err

    def _string(self, text: str) -> str:
        if text[0] == "'":
            return _SINGLE_ESCAPE.sub(lambda match: _ESCAPES.get(match[1], match[1]), text[1:-1])
        try:
            return str(json.loads(text, strict=False))
        except ValueError as err:
            raise self._error("a text with JSON's escapes") from err

    def _expect(self, text: str) -> None:
        if not self._next.says(text):
            raise self._error(repr(text))
        self._take()

    def _take(self) -> _Token:
        token, self._next = self._next, self._read()
        return token

    def _read(self) -> _Token:
        match = _TOKEN.match(self._text, self._position)
        if match is None or match.lastgroup is None:
            rest = self._text[self._position :]
            start = self._position + len(rest) - len(rest.lstrip())
            return _Token("unknown", self._text[start : start + 1], start)
        self._position = match.end()
        kind = match.lastgroup
        return _Token(kind, match[kind], match.start(kind))

    def _error(self, expected: str, token: _Token | None = None) -> FilterError:
        token = token or self._next
        found = "the end" if token.kind == "end" else repr(token.text[:40])
        return FilterError(
            f"filter {self._text!r:.200} needs {expected} at character {token.position}, found {found}"
        )


def _format(filter: BaseFilter, outer: bool) -> str:
    match filter.type:
        case FilterType.NOT:
            return f"not {_format(filter.filters[0], outer=False)}"
        case FilterType.AND | FilterType.OR:
            if not filter.filters:
                raise FilterError(f"an empty {filter.type} has no text")
            text = f" {filter.type.lower()} ".join(_format(part, outer=False) for part in filter.filters)
            return text if outer or len(filter.filters) == 1 else f"({text})"
        case FilterType.IN:
            return f"{_format_key(filter)} in [{', '.join(_format_value(value) for value in filter.value)}]"
    return f"{_format_key(filter)} {_SIGNS[filter.type]} {_format_value(filter.value)}"


def _format_key(filter: BaseFilter) -> str:
    first, *rest = path_of(filter)
    if not _PLAIN_KEY.fullmatch(first) or (first.lower() in _RESERVED and not rest):
        raise FilterError(f"filter key {filter.key!r} has no text: it does not start with a word")
    segments = (
        part if _PLAIN_SEGMENT.fullmatch(part) else json.dumps(part, ensure_ascii=False) for part in rest
    )
    return ".".join((first, *segments))


def _format_value(value: Any) -> str:
    if isinstance(value, float):
        return repr(value) if isinstance(tag_float(value), float) else _spell(value)
    return json.dumps(value, ensure_ascii=False)


def _spell(value: float) -> str:
    return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
