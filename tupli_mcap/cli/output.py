"""Prints results: tables that fit the terminal, facts, JSON, numbers and times."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Final, Literal, NamedTuple

from tupli_mcap.cli.terminal import say, say_json, say_styled, terminal_width, visible

JSON_VERSION: Final = 1
"""The version of what --json prints. It grows when a key goes away or changes its meaning, not when a key is added."""

# nested lists and records of a result; deeper values are a user's, and stay as they are
_OWN_LEVELS: Final = 6
_GAP = "  "
_WIDEST = 100  # columns of running text
WHOLE_NAME: Final = 32
"""Characters of a run's name that are not cut where there is room."""
_LONG_ID = re.compile(r"\b([0-9a-f]{12})[0-9a-f]{20,52}\b")

_STORED = re.compile(r"\brecordings/(?:[0-9a-f]{64}|plain)/")


class Column(NamedTuple):
    """A column of a table; `shrink` says which end of its values is cut if the terminal is too narrow, down to `least`
    characters. A column with a `rank` is left out if there is still no room, that of the highest rank first."""

    title: str
    align: Literal["left", "right"] = "left"
    shrink: Literal["start", "end"] | None = None
    least: int = 8
    rank: int = 0


def print_table(
    columns: Sequence[Column], rows: Iterable[Sequence[str]], *, empty: str, named: bool = False
) -> None:
    """Print rows under titles, or the sentence `empty` if there are none. A column without any value is left out,
    unless the user `named` the columns."""
    from rich.cells import cell_len

    cells = [[visible(cell) for cell in row] for row in rows]
    if not cells:
        say(empty)
        return
    widths = [
        max(cell_len(text) for text in (column.title, *(row[i] for row in cells)))
        for i, column in enumerate(columns)
    ]
    shown = _with_room(
        columns, widths, [i for i in range(len(columns)) if named or any(row[i] for row in cells)]
    )
    columns, widths = [columns[i] for i in shown], [widths[i] for i in shown]
    cells = [[row[i] for i in shown] for row in cells]
    _fit(columns, widths)
    lines = [_line(columns, widths, [column.title for column in columns])]
    lines += [_line(columns, widths, row) for row in cells]
    width = terminal_width()
    if width is not None:
        lines = [_cut(line, width, "end") for line in lines]
    say_styled((lines[0], "bold"))
    say(*lines[1:])  # not by rich, which is slow for many lines


def print_facts(facts: Iterable[tuple[str, str]]) -> None:
    """Print `label  value` lines, but none without a value; long values are wrapped."""
    pairs = [(visible(label), visible(value)) for label, value in facts if value]
    indent = max(len(label) for label, _ in pairs) + len(_GAP)
    width = terminal_width()
    for label, value in pairs:
        lines = [value]
        if width is not None:
            lines = textwrap.wrap(value, max(20, width - indent), break_on_hyphens=False) or [""]
        for i, line in enumerate(lines):
            say(f"{label if i == 0 else '':<{indent}}{line}")


def print_wrapped(text: str, first: str, others: str) -> None:
    """Print a text in lines that fit the terminal, at most 100 columns; `first` and `others` begin the lines."""
    width = terminal_width()
    if width is None:
        say(first + text)
        return
    room = max(30, min(width, _WIDEST))
    lines = textwrap.wrap(
        visible(text),
        room,
        initial_indent=first,
        subsequent_indent=others,
        break_on_hyphens=False,
        break_long_words=False,
    )
    say(*(lines or [""]))


# --- JSON, as docs/reference/json.md describes it ---


@dataclass
class _Document:
    """The one JSON document that a call of the program prints."""

    command: str | None = None
    printed: bool = False


_document = _Document()


def begin_json(command: str | None) -> None:
    """Name the command whose result or error will be printed; None if the user named no command."""
    _document.command, _document.printed = command, False


def print_json(result: Any) -> None:
    """Print the result of a command as one JSON document: `{"version", "command", "result"}`.

    NamedTuples become objects, paths become texts, NumPy values become numbers and lists, NaN and infinities null.
    """
    _print_document({"result": _plain(result, _OWN_LEVELS)})


def print_result(result: Any, *lines: str, as_json: bool) -> None:
    """Print the result of a command as JSON, or as lines."""
    if as_json:
        print_json(result)
    else:
        say(*lines)


def print_rows(
    result: Any, columns: Sequence[Column], rows: Iterable[Sequence[str]], *, empty: str, as_json: bool
) -> None:
    """Print the result of a command as JSON, or as a table."""
    if as_json:
        print_json(result)
    else:
        print_table(columns, rows, empty=empty)


def print_json_error(kind: str, message: str, exit_code: int) -> None:
    """Print an error as one JSON document, `{"version", "command", "error"}`, unless one was printed before."""
    if not _document.printed:
        _print_document({"error": {"type": kind, "message": message, "exit_code": exit_code}})


def _print_document(content: dict[str, Any]) -> None:
    import json

    from tupli_mcap.jsonvalue import MAX_DEPTH, dumps_plain

    value = {"version": JSON_VERSION, "command": _document.command, **content}
    most = 2 * MAX_DEPTH  # for a value that was read, and the lists and objects around it
    try:
        text = dumps_plain(value, max_depth=most)
    except (TypeError, ValueError):
        text = dumps_plain(_printable(value, MAX_DEPTH // 2))
    finite = json.loads(text, object_hook=lambda found: None if found.keys() == {"$float"} else found)
    _document.printed = True
    say_json(json.dumps(finite, indent=2, ensure_ascii=False))


def _plain(value: Any, levels: int) -> Any:
    """Makes dicts of NamedTuples and texts of paths, down to `levels`; deeper values stay as they are."""
    if isinstance(value, PurePath):
        return str(value)
    if levels and hasattr(value, "_asdict"):
        value = value._asdict()
    if levels and isinstance(value, dict):
        return {key: _plain(item, levels - 1) for key, item in value.items()}
    if levels and isinstance(value, list | tuple):
        return [_plain(item, levels - 1) for item in value]
    return value


def _printable(value: Any, levels: int) -> Any:
    """Replaces by a text what JSON cannot hold, or what is nested deeper than `levels`: the rest is still printed."""
    from tupli_mcap.jsonvalue import dumps_plain, shown

    if levels and isinstance(value, dict):
        return {_printable(key, 0): _printable(item, levels - 1) for key, item in value.items()}
    if levels and isinstance(value, list | tuple):
        return [_printable(item, levels - 1) for item in value]
    if isinstance(value, dict | list | tuple):
        return shown(value)
    try:
        dumps_plain(value)
    except (TypeError, ValueError):
        return shown(value)
    return value


# --- values as text ---


def short_ids(text: str) -> str:
    """Shortens every long id in a text to 12 digits on a terminal; elsewhere leaves the text as it is."""
    return text if terminal_width() is None else _LONG_ID.sub(r"\1…", text)


def short_path(path: str) -> str:
    """The path of a recording as a cell of a table. The folders in a storage, which have long ids as names, are `…`:
    the name of the file tells it apart."""
    return short_ids(_STORED.sub("…/", path))


def number(value: float | None, decimals: int = 2) -> str:
    """A number with separated thousands and at most `decimals` decimals; empty for None."""
    if value is None:
        return ""
    if not math.isfinite(value):
        return str(value)
    if value == int(value) and abs(value) < 1e15:
        return f"{int(value):,}"
    if abs(value) >= 1e9 or abs(value) < 10.0**-decimals:
        return f"{value:.3g}"
    return f"{value:,.{decimals}f}"


def short_value(value: object) -> str:
    """A metadata value as a cell of a table, see `spelled`; a list of texts without brackets."""
    if isinstance(value, float):
        return f"{value:.4g}"
    from tupli_mcap.jsonvalue import spelled

    if isinstance(value, list) and all(isinstance(one, str) for one in value):
        return ", ".join(map(spelled, value))
    return spelled(value)


def pairs_of(values: Mapping[str, Any]) -> str:
    """Metadata as a cell of a table: `lr=0.0003, algo=ppo`."""
    return ", ".join(f"{key}={short_value(value)}" for key, value in values.items())


def numbers(values: Sequence[float | None], decimals: int = 2) -> list[str]:
    """The numbers of one column: all with decimals, if one of them has some."""
    whole = all(value is None or not math.isfinite(value) or value == int(value) for value in values)
    if whole:
        return [number(value) for value in values]
    texts = [number(value, decimals) for value in values]
    return [
        f"{text}.{'0' * decimals}" if text.lstrip("-").replace(",", "").isdecimal() else text
        for text in texts
    ]


def time_of(time_ns: int) -> str:
    """A wall clock time (ns) as local time to the second, in the form that filters take; empty for 0."""
    if not time_ns:
        return ""
    from tupli_mcap.schema.times import local_text

    return local_text(time_ns)


def when(created_at: str) -> str:
    """An ISO 8601 time as local time; a text that is no time, or one that no local clock has, comes back unchanged."""
    from tupli_mcap.schema.times import time_ns

    found = time_ns(created_at)
    try:
        return created_at if found is None else time_of(found)
    except (OverflowError, ValueError):  # before the year 1 or after 9999
        return created_at


def _least(column: Column, width: int) -> int:
    """How narrow a column may become."""
    return min(width, max(len(column.title), column.least)) if column.shrink else width


def _with_room(columns: Sequence[Column], widths: Sequence[int], among: Sequence[int]) -> list[int]:
    """The columns that are shown: those without a rank, and by their ranks, the others for which there is room."""
    limit, kept, taken = terminal_width(), list[int](), -len(_GAP)
    for i in sorted(among, key=lambda i: columns[i].rank):
        needed = len(_GAP) + _least(columns[i], widths[i])
        if limit is None or not columns[i].rank or taken + needed <= limit:
            kept.append(i)
            taken += needed
    return sorted(kept)


def _fit(columns: Sequence[Column], widths: list[int]) -> None:
    """Narrows the columns that may shrink, the widest first, until the table fits."""
    limit = terminal_width()
    if limit is None:
        return
    shrinkable = [i for i, column in enumerate(columns) if column.shrink]
    excess = sum(widths) + len(_GAP) * (len(widths) - 1) - limit
    while excess > 0 and shrinkable:
        widest = max(shrinkable, key=lambda i: widths[i])
        if widths[widest] <= _least(columns[widest], widths[widest]):
            shrinkable.remove(widest)
            continue
        widths[widest] -= 1
        excess -= 1


def _line(columns: Sequence[Column], widths: Sequence[int], cells: Sequence[str]) -> str:
    from rich.cells import cell_len

    parts = []
    for column, width, cell in zip(columns, widths, cells, strict=True):
        text = _cut(cell, width, column.shrink or "end")
        padding = " " * (width - cell_len(text))
        parts.append(padding + text if column.align == "right" else text + padding)
    return _GAP.join(parts).rstrip()


def _cut(text: str, width: int, end: Literal["start", "end"]) -> str:
    from rich.cells import cell_len

    if cell_len(text) <= width:
        return text
    text = text[-4 * width :] if end == "start" else text[: 4 * width]
    while cell_len(text) > width - 1:
        text = text[1:] if end == "start" else text[:-1]
    return "…" + text.lstrip("…") if end == "start" else text + "…"
