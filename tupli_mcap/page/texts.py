"""Numbers and times as texts for people."""

from __future__ import annotations

import datetime
import math
from typing import Any

from tupli_mcap.schema.times import time_ns

__all__ = ["day", "duration", "iso", "minute", "number", "percent", "spread"]


def number(value: float | None) -> str:
    """`1,234`, `0.0123`, `-4.5e+20`; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if abs(value) < 1e15 and float(value).is_integer():
        return f"{int(value):,}".replace("-", "\N{MINUS SIGN}")
    shown = f"{value:.4g}" if abs(value) < 1e4 or abs(value) >= 1e7 else f"{value:,.0f}"
    return shown.replace("-", "\N{MINUS SIGN}")


def percent(part: int, whole: int) -> str:
    """A share such as `40%`; a dash if the whole is 0."""
    return f"{100 * part / whole:.0f}%" if whole else "–"


def iso(ns: int) -> str:
    """ISO 8601 in UTC, to the second."""
    try:
        moment = datetime.datetime.fromtimestamp(ns // 10**9, datetime.UTC)
    except (OverflowError, ValueError, OSError):  # a file may hold a time that no clock has
        return ""
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def minute(moment: Any) -> str:
    """A time (ns, or ISO 8601) as `2026-11-25 09:30 UTC`."""
    ns = moment if isinstance(moment, int) else time_ns(str(moment))
    return "" if ns is None else iso(ns)[:16].replace("T", " ") + " UTC" if iso(ns) else ""


def day(ns: int) -> str:
    """`2026-11-25`."""
    return iso(ns)[:10]


def duration(seconds: float) -> str:
    """`0.3 s`, `45 s`, `12 min`, `3.5 h`, `2 days`."""
    for unit, length, most in (("s", 1.0, 90), ("min", 60.0, 90), ("h", 3600.0, 48)):
        if seconds < most * length:
            value = seconds / length
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 86_400:.0f} days"


def spread(low: float | None, high: float | None) -> str:
    """`-4.8 … 4.8`."""
    return number(low) if low == high else f"{number(low)} … {number(high)}"
