"""`F` makes filters from comparisons: `F("metadata.score") > 3`."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import NoReturn

from tupli_mcap.errors import FilterError
from tupli_mcap.schema.filters import (
    FilterCONTAINS,
    FilterEQ,
    FilterGEQ,
    FilterGT,
    FilterIN,
    FilterLEQ,
    FilterLT,
    FilterNE,
)
from tupli_mcap.schema.keys import join_key, split_key


class F:
    """A key to compare: `F("metadata.score") > 3` is `FilterGT(key="metadata.score", value=3)`.

    Each of several arguments is one segment, taken literally: `F("metadata", "v1.0")`.

    Attributes:
        key: the dotted key.
    """

    __slots__ = ("key",)

    key: str

    def __init__(self, *segments: str) -> None:
        for segment in segments:
            if not isinstance(segment, str):
                raise FilterError(
                    f"expected the name of a key, such as 'metadata.score', found {segment!r:.80}"
                )
        self.key = segments[0] if len(segments) == 1 else join_key(segments)
        split_key(self.key)

    def __eq__(self, value: object) -> FilterEQ:  # type: ignore[override]
        return FilterEQ(key=self.key, value=value)

    def __ne__(self, value: object) -> FilterNE:  # type: ignore[override]
        return FilterNE(key=self.key, value=value)

    def __gt__(self, value: object) -> FilterGT:
        return FilterGT(key=self.key, value=value)

    def __ge__(self, value: object) -> FilterGEQ:
        return FilterGEQ(key=self.key, value=value)

    def __lt__(self, value: object) -> FilterLT:
        return FilterLT(key=self.key, value=value)

    def __le__(self, value: object) -> FilterLEQ:
        return FilterLEQ(key=self.key, value=value)

    def contains(self, text: str) -> FilterCONTAINS:
        """True if the key's value is a text that contains `text`, ignoring the case of A to Z, or a list with such a
        text."""
        return FilterCONTAINS(key=self.key, value=text)

    def isin(self, values: Iterable[object]) -> FilterIN:
        """True if the key's value equals one of `values`."""
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise FilterError(f"isin on {self.key!r} takes a list of values, found {values!r:.80}")
        return FilterIN(key=self.key, value=list(values))

    def __and__(self, other: object) -> NoReturn:
        """`F("a") > 1 & F("b") < 3` binds `1 & F("b")` first."""
        raise FilterError(
            f"{self!r} is not compared, {self!r} == True, or its comparison needs parentheses: "
            "(F('a') > 1) & (F('b') < 3)"
        )

    __rand__ = __or__ = __ror__ = __and__

    def __invert__(self) -> NoReturn:
        raise FilterError(
            f"{self!r} is not compared, ~({self!r} == True), or its comparison needs parentheses: ~(F('a') > 1)"
        )

    def __bool__(self) -> bool:
        raise FilterError(f"{self!r} has no truth value: compare it, {self!r} == True")

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return f"F({json.dumps(self.key, ensure_ascii=False)})"
