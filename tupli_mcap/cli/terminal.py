"""The only module of the command line that writes to stdout and stderr.

Names, messages and values come from files, and a file may be a stranger's. A control character in them could move the
cursor, change colours or hide text, and a right-to-left override could show a name backwards. So `visible` replaces
each such character by an escape (`\\x1b`) before anything is printed. Our own colours are given as styles, never as
text, and markup is not interpreted. Other modules call `say`, `fail` and the like, and never print.
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

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_UNUSUAL = re.compile(r"[^\n -~]")
_ROOMY, _WIDE = 100, 130  # columns
_hide_bar: Callable[[], None] | None = None


def visible(text: str) -> str:
    """Replaces each character of a text that has no visible shape, line breaks too, by an escape."""
    if text.isprintable():
        return text
    return "".join(c if _is_plain(c) else c.encode("unicode_escape").decode("ascii") for c in text)


def one_line(text: str) -> str:
    """The same for a message whose line breaks become blanks."""
    return visible(" ".join(text.split()))


def _is_plain(char: str) -> bool:
    """Whether a character may be printed. All blanks may; `isprintable` accepts only the usual one."""
    return char.isprintable() or unicodedata.category(char) == "Zs"


# --- stdout ---


def say(*lines: str) -> None:
    """Print lines."""
    _write(sys.stdout, "".join(f"{visible(line)}\n" for line in lines))


def say_styled(*parts: tuple[str, str]) -> None:
    """Print one line of parts (text, style of rich); without styles if stdout is no terminal."""
    from rich.console import Console
    from rich.text import Text

    shown = [(_encodable(sys.stdout, visible(text)), style) for text, style in parts]
    _clear()
    # rich takes COLUMNS=0 for a width, and would print nothing
    console = Console(highlight=False, soft_wrap=True, width=terminal_width() or _ROOMY)
    console.print(Text.assemble(*shown))


def say_json(text: str) -> None:
    """Print a JSON document. Unprintable characters, or those that stdout cannot encode, become `\\u` escapes."""
    raw = can_print(text)
    _write(
        sys.stdout,
        _UNUSUAL.sub(lambda m: m[0] if raw and _is_plain(m[0]) else _json_escaped(m[0]), text) + "\n",
    )


def _json_escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


def flush() -> None:
    sys.stdout.flush()


def stop_writing() -> None:
    """Send the rest of stdout to nowhere, because its reader has closed it; Python flushes it at exit, too."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def can_print(text: str) -> bool:
    """Whether stdout can encode these characters."""
    try:
        text.encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def terminal_width() -> int | None:
    """The width of stdout (columns); None if it is no terminal, or one of unknown size (0): then nothing is cut."""
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"]):
        return int(os.environ["COLUMNS"])
    try:
        return os.get_terminal_size(sys.stdout.fileno()).columns or None
    except (OSError, ValueError):
        return None


def is_roomy() -> bool:
    """Whether a table has room for more columns than the most important ones."""
    return (terminal_width() or _ROOMY) >= _ROOMY


def is_wide() -> bool:
    """Whether a table of many columns has room for all of them."""
    return (terminal_width() or _WIDE) >= _WIDE


def _write(stream: TextIO, text: str) -> None:
    _clear()
    stream.write(_encodable(stream, text))


def _clear() -> None:
    """Hides the progress bar, so that text does not end up in its line."""
    if _hide_bar is not None:
        _hide_bar()


def _encodable(stream: TextIO, text: str) -> str:
    """Replaces characters that a stream cannot encode by escapes."""
    encoding = stream.encoding or "ascii"
    return text.encode(encoding, "backslashreplace").decode(encoding)


# --- stderr ---


def fail(message: str) -> None:
    """Print an error as one line on stderr."""
    _write(sys.stderr, f"error: {one_line(message)}\n")


def say_interrupted(message: str) -> None:
    """Print a message about Ctrl-C, which is no error, as one line on stderr."""
    _write(sys.stderr, f"{one_line(message)}\n")


def print_traceback(err: BaseException) -> None:
    lines = "".join(traceback.format_exception(err)).rstrip("\n").split("\n")
    _write(sys.stderr, "".join(f"{visible(line)}\n" for line in lines))


@contextlib.contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Prints each warning once, as `warning: ...` on stderr; hides those meant for programmers."""
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


def ask_secret(question: str, *, twice: bool = False) -> str | None:
    """Ask for a text without showing what is typed, `twice` until both answers are equal; None if stdin is no
    terminal."""
    if not sys.stdin.isatty():
        return None
    import typer

    answer: str = typer.prompt(visible(question), hide_input=True, err=True, confirmation_prompt=twice)
    return answer


def confirmed(question: str) -> bool:
    """Ask a question; whether the answer is yes. False if stdin is no terminal."""
    if not sys.stdin.isatty():
        return False
    import typer

    return typer.confirm(visible(question), err=True)


@contextlib.contextmanager
def step_progress(total: int | None, what: str = "recording") -> Iterator[Callable[[int], None] | None]:
    """Shows a progress bar, of `total` steps if that is known; yields a function that takes the number of steps done,
    or None where none can be shown."""
    from tupli_mcap.progress import alone, can_redraw

    if not can_redraw():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    shown = (BarColumn(), MofNCompleteColumn(), TextColumn("steps"), TimeRemainingColumn())
    columns = TextColumn(what), *shown
    with alone(), Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("steps", total=total)
        yield lambda done: progress.update(task, completed=min(done, total or done))


@contextlib.contextmanager
def fetch_progress() -> Iterator[None]:
    """Shows a progress bar of bytes fetched from servers, once that takes a while."""
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
    """Yields a function that shows what is being worked on, or None if it cannot, or a bar is shown."""
    from tupli_mcap.progress import alone, can_redraw

    if not can_redraw() or _hide_bar is not None:
        yield None
        return
    from rich.console import Console
    from rich.text import Text

    with alone(), Console(stderr=True).status("") as shown:
        yield lambda name: shown.update(Text(visible(f"{doing} {name}"), overflow="ellipsis", no_wrap=True))
