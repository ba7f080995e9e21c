"""Texts in the files of a storage: ids, JSON, descriptions of defects, and names that every database can hold."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Final

from pydantic import ValidationError

_TO_ESCAPE: Final = re.compile("[\x00\x01\ud7ff\ud800-\udfff]")
_ESCAPED: Final = re.compile("\x01[\x01\x02]|\ud7ff[\x01\u0100-\u08ff]")
_SURROGATES_AT: Final = 0x100


def is_hash(value: object) -> bool:
    """Whether a value is 64 lower-case hex digits: only such ids become file names."""
    return isinstance(value, str) and len(value) == 64 and set(value) <= set("0123456789abcdef")


def to_json(value: Mapping[str, Any]) -> bytes:
    """JSON that is indented, for people."""
    return json.dumps(value, indent=2, ensure_ascii=False).encode("utf-8")


def first_defect(err: Exception) -> str:
    """What is wrong with data: of many defects the first one, and its place."""
    if not isinstance(err, ValidationError):
        return str(err)
    first = err.errors(include_url=False, include_input=False)[0]
    return f"{'.'.join(str(part) for part in first['loc']) or 'the whole'}: {plain_message(first['msg'])}"


def plain_message(message: str) -> str:
    """What pydantic says of a defect, without the class of the exception in which a validator of ours said it."""
    return message.removeprefix("Value error, ")


def escape_text(text: str) -> str:
    """A text that SQLite can hold (no NUL, no lone surrogates) and that sorts as the original does."""
    return text if text.isprintable() else _TO_ESCAPE.sub(_escape, text)


def unescape_text(text: str) -> str:
    """The inverse of `escape_text`."""
    return _ESCAPED.sub(_unescape, text) if "\x01" in text or "\ud7ff" in text else text


def _escape(match: re.Match[str]) -> str:
    character = match[0]
    if character <= "\x01":
        return "\x01\x01" if character == "\x00" else "\x01\x02"
    return "\ud7ff\x01" if character == "\ud7ff" else "\ud7ff" + chr(_SURROGATES_AT + ord(character) - 0xD800)


def _unescape(match: re.Match[str]) -> str:
    lead, code = match[0][0], match[0][1]
    if lead == "\x01":
        return "\x00" if code == "\x01" else "\x01"
    return "\ud7ff" if code == "\x01" else chr(0xD800 + ord(code) - _SURROGATES_AT)
