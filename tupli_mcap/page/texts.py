"""Numbers and times as texts for people."""

from __future__ import annotations

import datetime
import math
import re
from collections.abc import Sequence
from typing import Any

from markupsafe import Markup

from tupli_mcap.schema.times import local_text, time_ns

__all__ = ["duration", "iso", "minus", "moment", "names", "number", "percent", "spread"]

_TIME = Markup('<time datetime="{}">{}</time>')
_DASH = Markup("–")


def number(value: float | None) -> str:
    """`1,234`, `0.0123`, `−4.5e+20` (with the sign U+2212); a dash for None and NaN."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "\N{MINUS SIGN}∞"
    if abs(value) < 1e15 and float(value).is_integer():
        return f"{int(value):,}".replace("-", "\N{MINUS SIGN}")
    shown = f"{value:.4g}" if abs(value) < 999.95 or abs(value) >= 1e7 else f"{value:,.0f}"
    return shown.replace("-", "\N{MINUS SIGN}")


def minus(value: str) -> str:
    """The text of a value, with the signs of `number` if it is a number."""
    is_number = re.fullmatch(r"-?(\d[\d.]*(e[-+]\d+)?|inf)", value)
    return value.replace("-", "\N{MINUS SIGN}") if is_number else value


def names(given: Sequence[str]) -> str:
    """`ann, bob, cid`; of more than four, the first three: `ann, bob, cid and 7 more`."""
    if len(given) <= 4:
        return ", ".join(given)
    return f"{', '.join(given[:3])} and {len(given) - 3:,} more"


def percent(part: int, known: int, of: int) -> str:
    """A share of the episodes of which it is known, such as `40%`, or `40% of 5` if there are more episodes."""
    return f"{100 * part / known:.0f}%{'' if known == of else f' of {known:,}'}"


def iso(ns: int) -> str:
    """ISO 8601 in UTC, to the second."""
    moment = datetime.datetime.fromtimestamp(ns // 10**9, datetime.UTC)
    return moment.isoformat(timespec="seconds").replace("+00:00", "Z")


def moment(time: Any) -> Markup:
    """A time (ns, or ISO 8601) as tables of commands show it; a script turns it into the zone of the browser.

    A dash if it is no time.
    """
    ns = time if isinstance(time, int) else time_ns(time)
    try:
        return _DASH if ns is None else _TIME.format(iso(ns), local_text(ns))
    except (OverflowError, ValueError):  # a file may hold a time that no clock has
        return _DASH


def duration(seconds: float) -> str:
    """`2.5 ms`, `4.2 s`, `45 s`, `12 min`, `3.5 h`, `2 days`."""
    if seconds < 1:
        return f"{number(1000 * seconds)} ms"
    for unit, length, most in (("s", 1.0, 90), ("min", 60.0, 90), ("h", 3600.0, 48)):
        if seconds < most * length:
            value = seconds / length
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 86_400:.0f} days"


def spread(low: float | None, high: float | None) -> str:
    """`−4.8 … 4.8`, with the signs of `number`; one number if both are the same."""
    return number(low) if low == high else f"{number(low)} … {number(high)}"
