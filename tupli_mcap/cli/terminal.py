"""The only module of the command line that writes to stdout and stderr.

Names, messages and values come from files, and a file may be a stranger's. A control character in them would move the
cursor, change colours or hide what stands before it, and a right-to-left override would show a name backwards. So
whatever is printed here is made visible first: such a character is written as an escape (`\\x1b`), one of our own
colours is given as a style and never as text, and no markup is looked for. Other modules hand their lines over to
`say`, `fail` and the like, and do not print.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from typing import TextIO

__all__ = [
    "ask_secret",
    "can_print",
    "fail",
    "fetch_progress",
    "flush",
    "one_line",
    "print_traceback",
    "say",
    "say_interrupted",
    "say_json",
    "say_styled",
    "status",
    "step_progress",
    "stop_writing",
    "terminal_width",
    "visible",
    "warnings_in_one_line",
]

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_UNUSUAL = re.compile(r"[^\n -~]")
_hide_bar: Callable[[], None] | None = None


def visible(text: str) -> str:
    """A text in one line, with an escape for each character that is none to look at."""
    if text.isprintable():
        return text
    return "".join(char if _is_plain(char) else _escaped(char) for char in text)


def one_line(text: str) -> str:
    """The same of a message, whose line breaks become blanks."""
    return visible(" ".join(text.split()))


def _is_plain(char: str) -> bool:
    """Whether a character is one to look at; Python counts blanks other than the usual one among the others."""
    return char.isprintable() or unicodedata.category(char) == "Zs"


def _escaped(char: str) -> str:
    return char.encode("unicode_escape").decode("ascii")


# --- stdout ---


def say(*lines: str) -> None:
    """Print lines."""
    _write(sys.stdout, "".join(f"{visible(line)}\n" for line in lines))


def say_styled(*parts: tuple[str, str]) -> None:
    """Print one line of (text, style as rich names it); where stdout is no terminal, without the styles."""
    from rich.console import Console
    from rich.text import Text

    shown = [(_encodable(sys.stdout, visible(text)), style) for text, style in parts]
    _clear()
    Console(highlight=False, soft_wrap=True).print(Text.assemble(*shown))


def say_json(text: str) -> None:
    """Print a JSON document, its lines as they are; in its strings, characters become `\\u` escapes."""
    raw = can_print(text)
    _write(
        sys.stdout,
        _UNUSUAL.sub(lambda m: m[0] if raw and _is_plain(m[0]) else _json_escaped(m[0]), text) + "\n",
    )


def _json_escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


def flush() -> None:
    """Hand over what was said so far."""
    sys.stdout.flush()


def stop_writing() -> None:
    """Nobody reads stdout any more: what is still to be written, at exit too, goes nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def can_print(text: str) -> bool:
    """Whether stdout has these characters."""
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def terminal_width() -> int | None:
    """The width that output has to fit (columns); None where it is no terminal: then nothing is cut."""
    if os.environ.get("COLUMNS", "").isdecimal():
        return int(os.environ["COLUMNS"])
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns
    except (OSError, ValueError):
        return None


def _write(stream: TextIO, text: str) -> None:
    _clear()
    stream.write(_encodable(stream, text))


def _clear() -> None:
    """Takes a bar away, beside which what is printed would stand."""
    if _hide_bar is not None:
        _hide_bar()


def _encodable(stream: TextIO, text: str) -> str:
    """A text with escapes for the characters that the encoding of a stream lacks."""
    encoding = stream.encoding or "ascii"
    return text.encode(encoding, "backslashreplace").decode(encoding)


# --- stderr ---


def fail(message: str) -> None:
    """Print what is wrong: one line on stderr."""
    _write(sys.stderr, f"error: {one_line(message)}\n")


def say_interrupted(message: str) -> None:
    """Print that the user pressed Ctrl-C, which is no error: one line on stderr."""
    _write(sys.stderr, f"{one_line(message)}\n")


def print_traceback(err: BaseException) -> None:
    """Print where an exception comes from, on stderr."""
    lines = "".join(traceback.format_exception(err)).rstrip("\n").split("\n")
    _write(sys.stderr, "".join(f"{visible(line)}\n" for line in lines))


@contextlib.contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Warnings become `warning: ...` on stderr, each once; those for programmers are not shown."""
    said: set[str] = set()

    def show(message: Warning | str, *_: object, **__: object) -> None:
        text = one_line(_COLOURS.sub("", str(message)).removeprefix("WARN: "))  # as Gymnasium writes them
        if text not in said:
            said.add(text)
            _write(sys.stderr, f"warning: {text}\n")

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        for ignored in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
            warnings.simplefilter("ignore", ignored)
        warnings.showwarning = show
        yield


def ask_secret(question: str) -> str | None:
    """What the user types in answer, without showing it; None where nobody is there to be asked."""
    if not sys.stdin.isatty():
        return None
    import typer

    answer: str = typer.prompt(visible(question), hide_input=True, err=True)
    return answer


@contextlib.contextmanager
def step_progress(total: int, what: str = "recording") -> Iterator[Callable[[int], None] | None]:
    """Gives a function to be told of the steps done; None where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from tupli_mcap.progress import alone

    shown = (BarColumn(), MofNCompleteColumn(), TextColumn("steps"), TimeRemainingColumn())
    columns = TextColumn(what), *shown
    with alone(), Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("steps", total=total)
        yield lambda done: progress.update(task, completed=min(done, total))


@contextlib.contextmanager
def fetch_progress() -> Iterator[None]:
    """Shows the bytes that come from servers in ranges, where that takes a while."""
    global _hide_bar
    from tupli_mcap.progress import progress
    from tupli_mcap.remote import watching

    with progress(0, "fetching", in_bytes=True) as bar:

        def watch(planned: int, came: int) -> None:
            bar.expect(planned)
            bar.advance(came)
            if bar.is_done:
                bar.hide()

        _hide_bar = bar.hide
        try:
            with watching(watch):
                yield
        finally:
            _hide_bar = None


@contextlib.contextmanager
def status(doing: str) -> Iterator[Callable[[str], None] | None]:
    """Gives a function that shows what is being worked on; None where stderr is no terminal, or a bar shows."""
    if not sys.stderr.isatty() or _hide_bar is not None:
        yield None
        return
    from rich.console import Console
    from rich.text import Text

    from tupli_mcap.progress import alone

    with alone(), Console(stderr=True).status("") as shown:
        yield lambda name: shown.update(Text(visible(f"{doing} {name}"), overflow="ellipsis", no_wrap=True))
