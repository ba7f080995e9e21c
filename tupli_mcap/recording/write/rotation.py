"""A rollout in one file or several: what they are called, and when it is time for the next one.

A directory gets a new file, `CartPole-v1_2026-11-23_16-55-03.mcap`; what the path lacks of directories is made. A path
without a suffix, such as `runs`, is a directory. A new file's name ends in `.mcap`, or its directory would not show it.
`run.mcap` is followed by `run_0001.mcap`, `run_0002.mcap`, …, an order that sorting by name keeps. Each is a recording
of its own, with its benchmark and attachments.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from tupli_mcap.errors import FormatError, RecordingError, asking, os_reason
from tupli_mcap.files import as_file_name
from tupli_mcap.journal.derive import LAST_ROW
from tupli_mcap.recording.about.run import RUN_NAME, RecordedRuns, name_after
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.write.options import Mode, RecordOptions, check_name, check_place
from tupli_mcap.recording.write.writer import RecordingWriter, finish_in_place

_NUMBER = r"_([0-9]{4,5})"  # more digits are a date
_NUMBERED = re.compile(rf"(.+){_NUMBER}\Z")
_MANY_ROWS = LAST_ROW - (1 << 27)  # of a channel: room for an episode of 60 million steps is left


class Rotation:
    """Decides when a recording continues in another file, and in which one.

    A file is full when whole chunks of `max_bytes` are written to it (attachments left out), when it has been open for
    `max_seconds`, or when a channel nears the most rows it may have. It is left as soon as no episode is running: one
    that runs goes on in its file.

    With limits, mode "a" goes on in the last file of a series, and finishes one before it that a killed process left.

    Args:
        path: of the first file, or a directory.
        options: how each of the files is written; `mode` is that of the first one.
        format_version: the least one that has what is recorded.
        name: what a new file in a directory is called, before the time; "run" if nothing of it can be in a file name.

    Attributes:
        beginning: a context in which the next file is made.
        finished: called with each file that is left.

    Raises:
        RecordingError: the path is that of a new file that does not end in `.mcap`; or files of an earlier series would
            follow it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        options: RecordOptions,
        format_version: str = "1",
        name: str = "run",
    ) -> None:
        check_place(path)
        self._name = as_file_name(name) or "run"
        self._folder = Path(path) if _is_folder(path) else None
        if self._folder is None and not os.path.lexists(path):
            check_name(path, or_directory=True)
        self._options, self._format_version = options, format_version
        self._max_bytes, self._max_seconds = options.max_bytes, options.max_seconds
        if options.has_limits:  # the program may change its directory before the next file
            path = Path(path).absolute()
            self._folder = None if self._folder is None else path
        self._paths = [Path(path) if self._folder is None else self._new_in(self._folder)]
        self._base: Path | None = None  # after which the next files are called
        self._number = 0  # of the last one
        if options.has_limits and self._folder is None:
            self._join(options.mode)
        self._opened = 0.0
        self._head = 0  # bytes of attachments
        self.beginning: Callable[[], AbstractContextManager[object]] = contextlib.nullcontext
        self.finished: Callable[[Path], object] = lambda path: None

    def _new_in(self, folder: Path) -> Path:
        """A path in a directory at which nothing is."""
        stem = f"{self._name}_{time.strftime('%Y-%m-%d_%H-%M-%S')}"
        for k in itertools.count(1):
            path = folder / f"{stem}{'' if k == 1 else f'_{k:02}'}.mcap"  # sorted by name they are in order
            if not os.path.lexists(path):
                break
        return path

    def _join(self, mode: Mode) -> None:
        path = self._paths[0]
        base, later = series(path)
        self._base = base
        if mode != "a":
            if later:
                names = ", ".join(one.name for one in list(later.values())[:3])
                append = asking('mode="a"', "--mode a")
                raise RecordingError(
                    f"{path}: {names}{' …' if len(later) > 3 else ''} of an earlier series would follow it; "
                    f"delete them, record to another path, or go on with {append}"
                )
            return
        files = [base, *later.values()]
        for left in files[-2:-1]:  # changes nothing about a finished one
            with contextlib.suppress(RecordingError, FormatError):  # it is read as it is
                finish_in_place(left, RecordOptions(mode="a"))
        self._paths = [files[-1]]

    @property
    def paths(self) -> list[Path]:
        """The files so far; a file without steps is removed when it is closed."""
        return [path for path in self._paths if path.exists()] or self._paths[:1]

    @property
    def path(self) -> Path:
        """The newest of them."""
        return self.paths[-1]

    def open_first(self) -> RecordingWriter:
        """A writer of the first file, or of the one to append to; mode "a" makes the file if there is none.
        RecordingError as `RecordingWriter`."""
        while True:
            path, mode = self._paths[0], self._options.mode
            is_new = not os.path.lexists(path)
            if is_new:
                _make_folder(path)
            try:
                return self._open(path, "x" if self._folder is not None or (mode == "a" and is_new) else mode)
            except RecordingError:
                if self._folder is None or not os.path.lexists(path):
                    raise
            self._paths = [self._new_in(self._folder)]  # another process has made a file of this name

    def _open(self, path: Path, mode: Mode) -> RecordingWriter:
        options = replace(self._options, mode=mode)
        writer = RecordingWriter(path, options, format_version=self._format_version)
        attachments = writer.container.attachment_indexes
        self._head = sum(index.length for index in attachments if index.name != INDEX_NAME)
        self._opened = time.monotonic()
        self._counted, self._most = -1, 0  # chunks in the file, and rows of the channel that has most
        return writer

    def is_due(self, writer: RecordingWriter) -> bool:
        """Whether the file is full, and to be left once no episode is running."""
        container = writer.container
        if len(container.chunk_indexes) != self._counted:
            self._counted = len(container.chunk_indexes)
            self._most = max(container.counts.values(), default=0)
        is_full = (
            self._most >= _MANY_ROWS
            or (self._max_bytes is not None and container.position - self._head >= self._max_bytes)
            or (self._max_seconds is not None and time.monotonic() - self._opened >= self._max_seconds)
        )
        return is_full and (writer.journal is not None or writer.index.count > 0)

    def open_next(self) -> RecordingWriter:
        """A writer of the next file; the caller closes the one before. RecordingError if it cannot be made; the one
        before can be recorded to as before."""
        if self._base is None:
            self._base = series(self._paths[0])[0]
        base = self._base
        number = max(self._number, *series(base)[1], 0) + 1  # files before it may have been moved away
        path = base.with_name(f"{base.stem}_{number:04}{base.suffix}")
        self._options = _named_after(base, self._options)
        with self.beginning():
            writer = self._open(path, "x")
        self._paths.append(path)
        self._number = number
        return writer


def _named_after(first: Path, options: RecordOptions) -> RecordOptions:
    """The options of the further files of a series, whose run is called after the first one if it has no name."""
    attachments = options.attachments or {}
    if RUN_NAME not in attachments:
        return options
    media_type, data = attachments[RUN_NAME]
    runs = RecordedRuns.from_json(data, RUN_NAME)
    *others, last = runs.runs
    named = runs._replace(runs=[*others, replace(last, name=last.name or name_after(first.name))])
    return replace(options, attachments={**attachments, RUN_NAME: (media_type, named.to_json())})


def _is_folder(path: str | os.PathLike[str]) -> bool:
    """Whether a path is a directory, or is to become one: nothing is there, and it has no suffix."""
    try:
        if os.fspath(path).endswith(os.sep) or Path(path).is_dir():
            return True
        return not Path(path).suffix and not os.path.lexists(path)
    except OSError as err:
        raise RecordingError(f"{path} cannot be recorded to: {os_reason(err)}") from err


def _make_folder(path: Path) -> None:
    """Makes the directory that a file is to be in, and those above it."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        pass  # opening the file says what is in the way
    except OSError as err:
        raise RecordingError(f"{path} cannot be recorded to: {os_reason(err)}") from err


def series(path: Path) -> tuple[Path, dict[int, Path]]:
    """The first file of the series that a path belongs to, and those that follow it and exist, by number."""
    match = _NUMBERED.match(path.stem)
    base = path if match is None else path.with_stem(match[1])
    if match is not None and not base.exists():
        base = path
    pattern = re.compile(re.escape(base.stem) + _NUMBER + re.escape(base.suffix) + r"\Z")
    found = {}
    with contextlib.suppress(OSError):
        for name in os.listdir(base.parent):  # noqa: PTH208 - names are all it takes
            if number := pattern.match(name):
                found[int(number[1])] = base.with_name(name)
    return base, dict(sorted(found.items()))
