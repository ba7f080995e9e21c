"""A progress bar on stderr for work that takes longer than a second."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from importlib.util import find_spec
from typing import Any

_PATIENCE = 1.0  # seconds without a bar
_PAUSE = 0.1  # seconds between two pictures of a bar: drawing takes longer than many a step
_BESIDE = 44  # columns of a terminal beside what is being done: the bar itself, sizes, speed and time
_shown: list[object] = []  # the bar or other display that shows at the moment: at most one
_choosing = threading.Lock()  # which of the bars of several threads shows


class Progress:
    """Counts steps, or bytes, and shows a bar after a second, if somebody can see it and no other one shows.
    Thread-safe."""

    def __init__(self, total: int, what: str, *, in_bytes: bool) -> None:
        self._total = total
        self._what = what
        self._in_bytes = in_bytes
        self._done = 0.0
        self._started = time.monotonic()
        self._lock = threading.Lock()
        self._drawn = 0.0
        self._closed = False
        self._bar: Any = None
        self._task: Any = None

    def advance(self, steps: float) -> None:
        """`steps`, or parts of one, more are done."""
        with self._lock:
            self._done += steps
            if self._bar is None and self._is_due():
                self._show()
            now = time.monotonic()
            if self._bar is not None and now - self._drawn >= _PAUSE:
                self._drawn = now
                self._bar.update(self._task, completed=self._done, total=self._total, refresh=True)

    def reach(self, steps: float) -> None:
        """`steps` are done in all. For one thread: steps that others advance meanwhile would be lost."""
        self.advance(steps - self._done)

    def expect(self, steps: int) -> None:
        """Adds `steps` to the total; a negative number makes it smaller."""
        with self._lock:
            self._total += steps

    @property
    def is_done(self) -> bool:
        """Whether all steps are done."""
        return self._done >= self._total

    def hide(self) -> None:
        """Takes the bar away until the next step."""
        with self._lock:
            if self._bar is not None:
                self._bar.stop()
                self._bar = None
                _shown.remove(self)

    def close(self) -> None:
        """Takes the bar away."""
        self._closed = True
        self.hide()

    def _is_due(self) -> bool:
        waited = time.monotonic() - self._started
        return waited >= _PATIENCE and not self._closed and not _shown and _visible()

    def _show(self) -> None:
        with _choosing:
            if _shown:
                return
            _shown.append(self)

        from rich.console import Console
        from rich.markup import escape
        from rich.progress import DownloadColumn, Progress as Bar, TransferSpeedColumn

        columns = [*Bar.get_default_columns()]
        if self._in_bytes:
            columns[2:3] = [DownloadColumn(), TransferSpeedColumn()]
        console = Console(stderr=True)
        # The bar must not touch stdout.
        self._bar = Bar(*columns, console=console, transient=True, auto_refresh=False, redirect_stdout=False)
        # a name may have brackets, which are no markup, and characters that would move the cursor
        what = "".join(c if c.isprintable() else "?" for c in self._what)
        what = escape(_within(what, console.width - _BESIDE))
        self._task = self._bar.add_task(what, total=self._total)
        self._bar.start()


def _within(what: str, width: int) -> str:
    """A text of "downloading URL" or so within a width: the end of a longer one shows, which is the name of a file."""
    doing, _, name = what.partition(" ")
    room = max(width - len(doing) - 2, 1)
    return what if len(what) <= width or not name else f"{doing} …{name[-room:]}"


@contextmanager
def alone() -> Iterator[None]:
    """Keeps bars away while something else shows, for the block."""
    mark = object()
    for bar in [each for each in _shown if isinstance(each, Progress)]:
        bar.hide()
    _shown.append(mark)
    try:
        yield
    finally:
        _shown.remove(mark)


def progress(total: int, what: str, *, in_bytes: bool = False) -> closing[Progress]:
    """A `Progress` that is closed when the block ends."""
    return closing(Progress(total, what, in_bytes=in_bytes))


def can_redraw() -> bool:
    """Whether stderr is a terminal that can replace what it shows. That of a notebook's `!command` cannot."""
    return sys.stderr.isatty() and "JPY_PARENT_PID" not in os.environ


def _visible() -> bool:
    # In a notebook, rich needs ipywidgets; without them it would print a warning instead of a bar.
    in_notebook = "ipykernel" in sys.modules and find_spec("ipywidgets") is not None
    return in_notebook or can_redraw()
