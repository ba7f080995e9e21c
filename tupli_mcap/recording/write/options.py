"""How a recording is written."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from tupli_mcap.errors import RecordingError, os_reason
from tupli_mcap.journal.seals import Durability, check_durability
from tupli_mcap.mcap.records import MAX_CHUNK
from tupli_mcap.messages.images.pictures import ImageFormat

__all__ = ["Mode", "WriterOptions", "check_local", "check_options"]

Mode = Literal["x", "w", "a"]
_MOST = MAX_CHUNK // 2  # a chunk may come out larger; readers refuse those beyond


class WriterOptions(NamedTuple):
    """How to write: `chunk_size` in bytes before compression, `flush_seconds` None flushes by size only.

    A new recording that no step came into is removed when it is closed, unless `keep_empty`.
    `durability` says what a power loss leaves: what the system happened to write, every chunk, or every step.
    `cameras` names the one that frames will come from, if any.
    """

    compression: str = "zstd"
    mode: Mode = "x"
    benchmark_id: str = ""
    attachments: Mapping[str, tuple[str, bytes]] | None = None
    journal_dir: str | os.PathLike[str] | None = None
    chunk_size: int = 256 * 1024
    flush_seconds: float | None = None
    keep_empty: bool = False
    durability: Durability = "os"
    cameras: tuple[str, ...] = ()
    format_version: str = "1"
    image_format: ImageFormat = "raw"


def check_local(path: str | os.PathLike[str]) -> None:
    """Raises RecordingError if `path` is none, or a URL, as it was given: as a `Path` it no longer looks like one."""
    if "\0" in os.fspath(path):
        raise RecordingError(f"expected a path to record to, found {os.fspath(path)!r}, which holds a NUL")
    if "://" in os.fspath(path):
        raise RecordingError(
            f"{path}: expected a local path to record to, found a URL; record to a path, and copy the file"
        )


def _check_clock(path: str | os.PathLike[str]) -> None:
    """Raises RecordingError if the clock is not within what rows hold: a `log_time` of 0 says that there is no row."""
    now = time.time()
    if not 0 < now < (1 << 63) / 1e9:
        raise RecordingError(
            f"{path}: expected a clock between 1970 and 2262, found {now:.0f} s since 1970; set the system's clock"
        )


def check_options(path: str | os.PathLike[str], options: WriterOptions) -> WriterOptions:
    """The options, with a place for the journal that does not depend on the process's directory."""
    check_local(path)
    _check_clock(path)
    size, seconds = options.chunk_size, options.flush_seconds
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 1 <= size <= _MOST:
        raise RecordingError(f"chunk_size: expected an integer from 1 to {_MOST} (bytes), found {size!r:.80}")
    if seconds is not None and not (isinstance(seconds, int | float | np.number) and seconds >= 0):
        raise RecordingError(f"flush_seconds: expected seconds from 0 on, or None, found {seconds!r:.80}")
    check_durability(options.durability)
    if options.journal_dir is None:
        return options
    expected = f"{path}: expected a directory as journal_dir, found {str(options.journal_dir)!r}"
    try:
        if not Path(options.journal_dir).is_dir():
            raise RecordingError(f"{expected}; make it")
    except OSError as err:
        raise RecordingError(f"{expected}: {os_reason(err)}") from err
    return options._replace(journal_dir=os.path.realpath(options.journal_dir))
