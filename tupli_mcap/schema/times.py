"""Times: stored in UTC, shown in the local zone, and compared as times, to the microsecond.

A text stands for the whole span that it names: `2026-11-23` is a day, `2026-11-23 03:31` a minute, `2026-11-23
03:31:07` a second. So `==` is true within the span, `>` after its end, `>=` from its beginning, `<` before it and
`<=` up to its end: a time as a table shows it can be found by `==`. A text without a zone is in local time. A week
begins on Monday. Times before the year 1 or after 9999 in UTC count as the first or last microsecond of these years.
"""

from __future__ import annotations

import datetime
import re
from typing import Final, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array

EXPECTED: Final = (
    'a time, such as "2026-11-23", "2026-11-23 03:31:07", "2026-11-23T03:31:07+01:00", "today", "yesterday", '
    '"last tuesday", "this week", "last month", "7d ago" (w, d, h, min), or nanoseconds since 1970'
)
TIME_PATHS: Final = (("created_at",), ("run", "started"), ("run", "ended"))
"""Where stored items have times."""
COMPARED_PATHS: Final = frozenset({*TIME_PATHS, ("ended",), ("time",), ("times",)})
"""Where any filter names times: those of items, also by the other name of `created_at`, and those of steps."""
_EPOCH: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_MICROSECOND: Final = datetime.timedelta(microseconds=1)
_DAY: Final = datetime.timedelta(days=1)
_LONGER: Final = {"week": 7, "month": 31, "year": 366}  # days after the first one that lie in the next
_ISO: Final = re.compile(
    r"(?P<day>\d{4}-\d\d-\d\d)"
    r"(?:[ T](?P<minute>\d\d:\d\d)(?::(?P<second>\d\d)(?:[.,](?P<fraction>\d+))?)? ?(?P<zone>Z|[+-]\d\d:?\d\d)?)?",
    re.ASCII | re.IGNORECASE,
)
_AGO: Final = re.compile(r"(\d{1,9}) ?(min|h|d|w|minutes?|hours?|days?|weeks?) ago", re.ASCII | re.IGNORECASE)
_WEEKDAYS: Final = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_CALENDAR: Final = re.compile(r"(this|last) (week|month|year)")
_UNITS: Final = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_EARLIEST_NS: Final = 10**17  # 1973: a smaller number is not in nanoseconds, but in seconds or milliseconds


class TimeSpan(NamedTuple):
    """From `start` to before `stop` (ns since 1970 in UTC, whole microseconds)."""

    start: int
    stop: int


def span_of(value: object, now: datetime.datetime | None = None) -> TimeSpan:
    """The span that a value in a filter names: an ISO 8601 text, a word, or nanoseconds. Words are relative to `now`.

    Raises:
        ValueError: It names no time.
    """
    if isinstance(value, int) and not isinstance(value, bool) and _EARLIEST_NS <= value < 1 << 63:
        return TimeSpan(value // 1000 * 1000, value // 1000 * 1000 + 1000)
    if not isinstance(value, str):
        raise ValueError(EXPECTED)
    try:
        return _span_of_text(" ".join(value.split()), now or datetime.datetime.now(datetime.UTC))
    except (ValueError, OverflowError) as err:
        raise ValueError(EXPECTED) from err


def _span_of_text(text: str, now: datetime.datetime) -> TimeSpan:
    word = text.lower()
    if word in ("today", "yesterday"):
        return _day(now.astimezone().date() - datetime.timedelta(days=word == "yesterday"))
    weekday = word.removeprefix("last ")
    if weekday in _WEEKDAYS:  # before today
        today = now.astimezone().date()
        back = (today.weekday() - _WEEKDAYS.index(weekday) - 1) % 7 + 1
        return _day(today - datetime.timedelta(days=back))
    calendar = _CALENDAR.fullmatch(word)
    if calendar is not None:
        return _calendar(now.astimezone().date(), calendar[2], back=calendar[1] == "last")
    ago = _AGO.fullmatch(text)
    if ago is not None:
        return _span(now - datetime.timedelta(**{_UNITS[ago[2][0].lower()]: int(ago[1])}), _MICROSECOND)
    iso = _ISO.fullmatch(text)
    if iso is None:
        raise ValueError(f"no time: {text!r}")
    if iso["minute"] is None:
        return _day(datetime.date.fromisoformat(iso["day"]))
    fraction = (iso["fraction"] or "")[:6]
    clock = f"{iso['minute']}:{iso['second'] or '00'}.{fraction.ljust(6, '0')}"
    whole = f"{iso['day']}T{clock}{(iso['zone'] or '').upper()}"
    if iso["second"] is None:
        length = datetime.timedelta(minutes=1)
    else:
        length = 10 ** (6 - len(fraction)) * _MICROSECOND
    return _span(datetime.datetime.fromisoformat(whole), length)


def _day(day: datetime.date) -> TimeSpan:
    return _days(day, day)


def _calendar(today: datetime.date, unit: str, *, back: bool) -> TimeSpan:
    """The week, month or year of `today`, or with `back` the one before."""
    first = _first_of(unit, today)
    if back:
        return _days(_first_of(unit, first - _DAY), first - _DAY)
    return _days(first, _first_of(unit, first + _LONGER[unit] * _DAY) - _DAY)


def _first_of(unit: str, day: datetime.date) -> datetime.date:
    """The first day of the week, month or year of a day."""
    if unit == "week":
        return day - day.weekday() * _DAY
    return day.replace(day=1) if unit == "month" else day.replace(month=1, day=1)


def _days(first: datetime.date, last: datetime.date) -> TimeSpan:
    """The span of days in the local zone; a day has 23 or 25 hours when the clocks change."""
    if last == datetime.date.max:  # which no midnight follows
        stop = _ns(_utc(datetime.datetime.max)) + 1000
    else:
        stop = _ns(_beginning(last + _DAY))
    return TimeSpan(_ns(_beginning(first)), stop)


def _beginning(day: datetime.date) -> datetime.datetime:
    midnight = datetime.datetime.combine(day, datetime.time.min)
    early, late = _utc(midnight), _utc(midnight.replace(fold=1))
    # Where clocks are set from midnight to 1:00, the early one is 23:00 of the day before.
    return late if early != late and early.astimezone().date() < day else early


def _span(start: datetime.datetime, length: datetime.timedelta) -> TimeSpan:
    first = _ns(_utc(start))
    return TimeSpan(first, first + length // _MICROSECOND * 1000)


def _utc(time: datetime.datetime) -> datetime.datetime:
    """A time (local if it has no zone) in UTC; the first or last possible one if it lies beyond."""
    try:
        # the method of the class itself: those of subclasses (pandas) take other arguments
        return datetime.datetime.astimezone(time, datetime.UTC)
    except (OverflowError, ValueError):
        nearest = datetime.datetime.min if time.year == datetime.MINYEAR else datetime.datetime.max
        return nearest.replace(tzinfo=datetime.UTC)


def _ns(time: datetime.datetime) -> int:
    return (time - _EPOCH) // _MICROSECOND * 1000


def text_of(value: datetime.date) -> str:
    """A date or a `datetime` (local time if it has no zone) as `span_of` reads it: a day, or a microsecond in UTC."""
    if isinstance(value, datetime.datetime):
        return _utc(value).isoformat(timespec="microseconds")
    return value.isoformat()


def date_of(value: np.datetime64) -> datetime.date | None:
    """The date in a `datetime64` in days, or the `datetime` (without a zone) in a finer one, to the microsecond; None
    if there is none: NaT, or a year after 9999."""
    found = (value if np.datetime_data(value)[0] == "D" else value.astype("datetime64[us]")).item()
    return found if isinstance(found, datetime.date) else None


def time_ns(text: object) -> int | None:
    """The time (ns) of an ISO 8601 text, in UTC if it has no zone; None if it is no time."""
    try:
        found = datetime.datetime.fromisoformat(text)  # type: ignore[arg-type]
    except (ValueError, TypeError):
        return None
    return _ns(found if found.tzinfo is not None else found.replace(tzinfo=datetime.UTC))


def iso_utc(time_ns: int) -> str:
    """A time (ns) as ISO 8601 in UTC, to the microsecond."""
    return (_EPOCH + time_ns // 1000 * _MICROSECOND).isoformat(timespec="microseconds")


def iso_utc_each(times_ns: Array) -> list[str]:
    """`iso_utc` of many times (uint64)."""
    texts = np.datetime_as_string((times_ns // 1000).astype("datetime64[us]"), unit="us").tolist()
    return [f"{text}+00:00" for text in texts]


def local_text(time_ns: int) -> str:
    """A time (ns) as tables show it: in the local zone, to the second: `2026-11-23 04:31:07+01:00`."""
    return (_EPOCH + time_ns // 1000 * _MICROSECOND).astimezone().isoformat(sep=" ", timespec="seconds")
