"""A progress bar on stderr for work that takes longer than a second."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any, ClassVar

__all__ = ["Progress", "progress"]

_PATIENCE = 1.0  # seconds without a bar


class Progress:
    """Counts steps, or bytes; shows a bar once it is worth it, where somebody can see it, and no other one shows."""

    _shown: ClassVar[list[Progress]] = []

    def __init__(self, total: int, what: str, *, in_bytes: bool) -> None:
        self._total = total
        self._what = what
        self._in_bytes = in_bytes
        self._done = 0
        self._started = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def advance(self, steps: int) -> None:
        """`steps` more are done."""
        self._done += steps
        if self._bar is None:
            if time.monotonic() - self._started < _PATIENCE or self._shown or not _visible():
                return
            self._shown.append(self)
            from rich.console import Console
            from rich.progress import DownloadColumn, Progress as Bar, TransferSpeedColumn

            columns = [*Bar.get_default_columns()]
            if self._in_bytes:
                columns[2:3] = [DownloadColumn(), TransferSpeedColumn()]
            self._bar = Bar(*columns, console=Console(stderr=True), transient=True, auto_refresh=False)
            self._task = self._bar.add_task(self._what, total=self._total)
            self._bar.start()
        self._bar.update(self._task, completed=self._done, total=self._total, refresh=True)

    @property
    def is_done(self) -> bool:
        return self._done >= self._total

    def expect(self, steps: int) -> None:
        """`steps` more are to be done."""
        self._total += steps

    def close(self) -> None:
        """Takes the bar away; one that advances once more comes back."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
            self._shown.remove(self)


@contextmanager
def progress(total: int, what: str, *, in_bytes: bool = False) -> Iterator[Progress]:
    """A `Progress` that is gone when the block ends."""
    shown = Progress(total, what, in_bytes=in_bytes)
    try:
        yield shown
    finally:
        shown.close()


def _visible() -> bool:
    # In a notebook, rich needs ipywidgets; without them it would print a warning instead of a bar.
    in_notebook = "ipykernel" in sys.modules and find_spec("ipywidgets") is not None
    return in_notebook or sys.stderr.isatty()
