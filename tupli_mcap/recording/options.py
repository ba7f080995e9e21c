"""How a recording is written."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from tupli_mcap.errors import RecordingError
from tupli_mcap.recording.durability import Durability, check_durability
from tupli_mcap.recording.pictures import ImageFormat
from tupli_mcap.system import refused

__all__ = ["Mode", "WriterOptions", "check_local", "check_options"]

Mode = Literal["x", "w", "a"]


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
    """Raises RecordingError if `path` is a URL, as it was given: as a `Path` it no longer looks like one."""
    if "://" in os.fspath(path):
        raise RecordingError(
            f"{path}: expected a local path to record to, found a URL; record to a path, and copy the file"
        )


def check_options(path: str | os.PathLike[str], options: WriterOptions) -> WriterOptions:
    """The options, with a place for the journal that does not depend on the process's directory."""
    check_local(path)
    if options.chunk_size < 1:
        raise RecordingError(f"chunk_size: expected at least 1 byte, found {options.chunk_size!r}")
    check_durability(options.durability)
    if options.journal_dir is None:
        return options
    expected = f"{path}: expected a directory as journal_dir, found {str(options.journal_dir)!r}"
    try:
        if not Path(options.journal_dir).is_dir():
            raise RecordingError(f"{expected}; make it")
    except OSError as err:
        raise RecordingError(f"{expected}: {refused(err)}") from err
    return options._replace(journal_dir=os.path.realpath(options.journal_dir))
