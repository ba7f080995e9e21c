"""Filters as text, for command lines: `metadata.score > -200 and (env in [1, 2] or not terminated = true)`.

    filter      = conjunction { "or" conjunction }
    conjunction = negation { "and" negation }
    negation    = "not" negation | "(" filter ")" | comparison
    comparison  = key ( "=" | "==" | "!=" | ">" | ">=" | "<" | "<=" | "~" ) value
                | key [ "not" ] "in" "[" [ value { "," value } ] "]"
                | value [ "not" ] "in" key
                | key
    value       = number | "text" | 'text' | true | false | null | nan | inf | -inf

A key is a name such as `metadata.score` or `state.arm.q[0]`, as `tupli_mcap.schema.keys` has them; a part of it that
is no word is quoted: `metadata."a b"`. A key alone stands for `key = true`, and `"x" in key` for `key = "x"`, which is
true for lists that hold "x". `key ~ "x"` is true for texts that contain "x". Words are case-insensitive (`none` is
`null`), keys are not.

And, or, not and parentheses bind as in Python, so Python's parser finds the structure. It gets `k` for each key, `0`
for each value and `<` for each sign, nothing else of the text; nothing is evaluated.
"""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

from tupli_mcap.errors import FilterError
from tupli_mcap.schema.filters import (
    BaseFilter,
    FilterAND,
    FilterCONTAINS,
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
from tupli_mcap.schema.keys import INDEX

_MAX_PARENTHESES: Final = 64
_KEY: Final = rf"""[^\W\d][\w\-]*(?:{INDEX})*(?:\.(?:[\w\-]+|"(?:[^"\\]|\\.)*")(?:{INDEX})*)*"""
_TOKEN: Final = re.compile(
    rf"""\s*(?:
      (?P<number>[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?|(?:inf|nan)\b))(?=(?:and|or)\b|[\s()\[\],"'=<>!~]|\Z)
    | (?P<text>"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')
    | (?P<word>in(?=\[)|{_KEY})
    | (?P<sign>==|!=|>=|<=|[=<>~])
    | (?P<bracket>[()\[\],])
    | (?P<end>\Z)
    | (?P<unknown>.)
    )""",
    re.VERBOSE | re.IGNORECASE | re.DOTALL,
)
_UNQUOTED: Final = re.compile(r"""[^\s()\[\],"'=<>!~][^()\[\],"']*""")
_AFTER_UNQUOTED: Final = re.compile(r"\s(?:and|or)\b", re.IGNORECASE)
_COMPARISON: Final[Mapping[str, type[BaseFilter]]] = {
    "=": FilterEQ,
    "==": FilterEQ,
    "!=": FilterNE,
    ">": FilterGT,
    ">=": FilterGEQ,
    "<": FilterLT,
    "<=": FilterLEQ,
    "~": FilterCONTAINS,
}
_SIGNS: Final = {cls.model_fields["type"].default: sign for sign, cls in _COMPARISON.items()}
_WORDS: Final = ("and", "or", "not", "in")
_CONSTANTS: Final[Mapping[str, Any]] = {"true": True, "false": False, "null": None, "none": None}
_RESERVED: Final = frozenset({*_WORDS, "nan", "inf", *_CONSTANTS})
_PLAIN_KEY: Final = re.compile(r"[^\W\d][\w\-]*")
_PLAIN_SEGMENT: Final = re.compile(r"[\w\-]+")
_ESCAPES: Final = {"n": "\n", "t": "\t", "r": "\r"}
_SINGLE_ESCAPE: Final = re.compile(r"\\(.)", re.DOTALL)

_A_VALUE: Final = 'a value (a number, "text", true, false or null)'
_EXPECTED: Final[Mapping[str, str]] = {
    "key": "a key such as metadata.score",
    "sign": f"one of {' '.join(_COMPARISON)} in, and, or, or the end",
    "in": "'in'",
    "held": 'in and a key, as a value comes first only in a comparison such as "x" in run.tags',
    "not held": "'in'",
    "holder": "a key such as run.tags",
    "list": "'['",
    "item": _A_VALUE,
    "comma": "','",
    "value": _A_VALUE,
    "more": "and, or, or the end",
}
_NEXT: Final[Mapping[str, Mapping[str, str]]] = {
    "key": {"not": "key", "(": "key", "key": "sign", "value": "held"},
    "held": {"in": "holder", "not": "not held"},
    "not held": {"in": "holder"},
    "holder": {"key": "more"},
    "sign": {
        "sign": "value",
        "in": "list",
        "not": "in",
        "and": "key",
        "or": "key",
        ")": "more",
        "end": "more",
    },
    "in": {"in": "list"},
    "list": {"[": "item"},
    "item": {"value": "comma", "]": "more"},
    "comma": {",": "item", "]": "more"},
    "value": {"value": "more"},
    "more": {"and": "key", "or": "key", ")": "more", "end": "more"},
}
"""State of the parser -> the kinds of token that may come, and the state after each."""
_PYTHON: Final = {"key": "k", "value": "0", "sign": "<", "end": ""}
_WIDTH: Final = 4  # characters of Python for each token, so that a node's column says which token it is


class _Token(NamedTuple):
    """kind: key, value, sign, end, unknown, or the word or bracket itself. value: of a value."""

    kind: str
    text: str
    position: int
    value: Any = None


def parse_filter(text: str) -> BaseFilter:
    """The filter that a text describes.

    Raises:
        FilterError: The text is no filter, or a comparison in it is invalid; the message names the character
            (from 0) and what was expected there.
    """
    if not isinstance(text, str):
        raise FilterError(f"expected a filter as a text, such as 'return > 100', found {text!r:.80}")
    tokens = _checked_tokens(text)
    python = "".join(f"{_PYTHON.get(token.kind, token.kind):{_WIDTH}}" for token in tokens)
    return _filter(ast.parse(python, "<filter>", "eval").body, tokens)


def key_positions(text: str) -> list[int]:
    """Where the key of each comparison in a filter's text begins, from left to right."""
    return [token.position for token in _checked_tokens(text) if token.kind == "key"]


def format_filter(filter: BaseFilter) -> str:
    """The text of a filter, which `parse_filter` turns into the same filter; an AND or OR of one filter is written as
    that one.

    Raises:
        FilterError: The filter has no text: an empty AND or OR, or a key that starts with no word, or is one of the
            syntax, such as `not`.
    """
    if not isinstance(filter, BaseFilter):
        raise FilterError(f"expected a filter, such as F(...) > 3, found {filter!r:.80}")
    return _format(filter, outer=True)


def _checked_tokens(text: str) -> list[_Token]:
    """The tokens of a filter; raises FilterError for one that is not allowed in its place."""
    tokens: list[_Token] = []
    expected, parentheses, negations = "key", 0, 0
    for token in _tokens(text):
        if parentheses + negations > _MAX_PARENTHESES:
            deep = f"filter nests deeper than {_MAX_PARENTHESES} at character {token.position}"
            raise FilterError(deep).at(token.position)
        if token.kind not in _NEXT[expected] or token.kind == (")", "end")[parentheses > 0]:
            if expected in ("value", "item") and token.kind in ("key", "unknown"):
                raise _unquoted(text, token)
            if expected == "sign" and token.kind in ("key", "unknown") and tokens[-1:]:
                raise _blank(text, tokens[-1], token)
            inside = expected == "more" and parentheses
            raise _error(text, "and, or, or ')'" if inside else _EXPECTED[expected], token)
        parentheses += {"(": 1, ")": -1}.get(token.kind, 0)
        negations = negations + 1 if token.kind == "not" else 0 if token.kind == "key" else negations
        expected = _NEXT[expected][token.kind]
        tokens.append(token)
        if token.kind == "end":
            break
    return tokens


def _tokens(text: str) -> Iterator[_Token]:
    for match in _TOKEN.finditer(text):
        kind = str(match.lastgroup)
        token = _Token(kind, match[kind], match.start(kind))
        word = token.text.lower()
        if kind in ("number", "text"):
            yield token._replace(kind="value", value=_value(text, token))
        elif kind == "word" and word in _CONSTANTS:
            yield token._replace(kind="value", value=_CONSTANTS[word])
        elif kind == "word":
            yield token._replace(kind=word if word in _WORDS else "key")
        else:
            yield token._replace(kind=token.text) if kind == "bracket" else token


def _value(text: str, token: _Token) -> float | str:
    """The number or text that a token spells."""
    is_number, spelled = token.kind == "number", token.text
    if spelled[0] == "'":
        return _SINGLE_ESCAPE.sub(lambda match: _ESCAPES.get(match[1], match[1]), spelled[1:-1])
    try:
        if is_number:
            return float(spelled) if re.search(r"[.enEN]", spelled) else int(spelled)
        return str(json.loads(spelled, strict=False))
    except ValueError as err:  # Python refuses ints of more than 4300 digits
        raise _error(text, "a shorter number" if is_number else "a text with JSON's escapes", token) from err


def _filter(node: ast.expr, tokens: Sequence[_Token]) -> BaseFilter:
    if isinstance(node, ast.BoolOp):
        parts = [_filter(part, tokens) for part in node.values]
        return FilterAND(filters=parts) if isinstance(node.op, ast.And) else FilterOR(filters=parts)
    if isinstance(node, ast.UnaryOp):
        return FilterNOT(filters=[_filter(node.operand, tokens)])
    compared = node.left if isinstance(node, ast.Compare) else node
    first = compared.col_offset // _WIDTH
    key, sign = tokens[first], tokens[first + 1]
    if isinstance(node, ast.Compare) and key.kind == "value":
        key = tokens[node.comparators[0].col_offset // _WIDTH]
    try:
        if not isinstance(node, ast.Compare):
            return FilterEQ(key=key.text, value=True)
        right = node.comparators[0]
        if isinstance(right, ast.Name):
            held = FilterEQ(key=key.text, value=tokens[first].value)
            return FilterNOT(filters=[held]) if sign.kind == "not" else held
        if isinstance(right, ast.List):
            values = [tokens[item.col_offset // _WIDTH].value for item in right.elts]
            chosen = FilterIN(key=key.text, value=values)
            return FilterNOT(filters=[chosen]) if sign.kind == "not" else chosen
        return _COMPARISON[sign.text](key=key.text, value=tokens[first + 2].value)
    except FilterError as err:
        where = f"{err} (at character {key.position} of the filter)"
        raise FilterError(where).at(key.position) from err


def _unquoted(text: str, token: _Token) -> FilterError:
    """The error for a token that is no value: maybe a text or a time without quotes."""
    match = _UNQUOTED.match(text, token.position)
    if match is None:
        return _error(text, _A_VALUE, token)
    unquoted = _AFTER_UNQUOTED.split(match[0], maxsplit=1)[0].rstrip()
    before, after = text[: token.position], text[token.position + len(unquoted) :]
    right = f"{before}{json.dumps(unquoted, ensure_ascii=False)}{after}"
    error = _error(text, _A_VALUE, token._replace(text=unquoted))
    return FilterError(f"{error}; put a text or a time in quotes, as in {right:.200}").at(token.position)


def _blank(text: str, key: _Token, token: _Token) -> FilterError:
    """The error for a word after a key: maybe the rest of a name with a blank, if the key names one in another."""
    error, (first, dot, name) = _error(text, _EXPECTED["sign"], token), key.text.rpartition(".")
    if not dot or name.endswith('"'):
        return error
    written = f"{first}.{json.dumps(f'{name} {token.text}', ensure_ascii=False)}"
    return FilterError(f"{error}; a name with a blank is put in quotes: {written:.100}").at(token.position)


def _error(text: str, expected: str, token: _Token) -> FilterError:
    found = "the end" if token.kind == "end" else repr(token.text[:40])
    needs = f"filter {text!r:.200} needs {expected} at character {token.position}, found {found}"
    return FilterError(needs).at(token.position)


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
    first, *rest = path = path_of(filter)
    if not _PLAIN_KEY.fullmatch(first) or (first.lower() in _RESERVED and not rest):
        raise FilterError(
            f"filter key {filter.key!r} has no text: expected a word at its beginning, other than 'not', 'in' and such"
        )
    given = str(filter.key)
    return (
        given if rest and re.fullmatch(_KEY, given) and first.lower() not in _RESERVED else format_key(path)
    )


def format_key(path: Sequence[str]) -> str:
    """A key as texts of filters have it: `join_key` that also quotes names with spaces and signs."""
    return ".".join(
        part if _PLAIN_SEGMENT.fullmatch(part) else json.dumps(part, ensure_ascii=False) for part in path
    )


def _format_value(value: Any) -> str:
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
