"""A cache of downloaded files: `<cache>/downloads/<SHA-256>`. All of it may be deleted at any time.

1. The bytes so far are in `<SHA-256>.part`, which the downloading process locks. Another process that wants the same
   file waits; after a download that was interrupted, the next one goes on where it ended.
2. A complete file is checked against its SHA-256, then renamed. Wrong bytes are an error, and are deleted.
3. A process that uses a file holds a shared lock on it. Files without a lock are deleted, those used longest ago first,
   until the rest is within the budget.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

from tupli_mcap.cache import cache_dir, delete_oldest, make_private
from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.mcap.lock import drop_private, open_private
from tupli_mcap.storage.atomic import os_errors

_BUDGET_VARIABLE: Final = "TUPLI_MCAP_CACHE_BYTES"
_BUDGET: Final = 4 << 30
_PART: Final = ".part"


@contextlib.contextmanager
def fetched(
    digest: str, pieces: Callable[[int], Iterable[bytes]], *, tell: Callable[[int], None] = lambda _: None
) -> Iterator[Path]:
    """The path of a file, valid in the block; it is downloaded unless the cache has it.

    Args:
        digest: SHA-256 of its bytes.
        pieces: returns them from an offset on.
        tell: called with the number of bytes that have arrived.

    Raises:
        FormatError: the bytes have another SHA-256.
        StorageError: there is no room for it, or TUPLI_MCAP_CACHE_BYTES is no number.
    """
    budget, path = _budget(), cache_dir() / "downloads" / digest
    with os_errors(
        "cannot keep downloads, for which TUPLI_MCAP_CACHE_DIR may name another directory, in", path.parent
    ):
        make_private(path.parent)
        while (file := _held(path)) is None:
            _fetch(path, pieces, tell)
    try:
        yield path
    finally:
        drop_private(file)
        with contextlib.suppress(OSError):
            delete_oldest(path.parent.iterdir(), budget, _delete)


def _held(path: Path) -> io.FileIO | None:
    """The file, with a shared lock, so that nobody deletes the file; None if there is no file."""
    try:
        file = open_private(path, "r")
    except FileNotFoundError:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_SH)
        if _is_at(file, path):
            os.utime(file.fileno())
            return file
    except BaseException:
        drop_private(file)
        raise
    drop_private(file)
    return None


def _fetch(path: Path, pieces: Callable[[int], Iterable[bytes]], tell: Callable[[int], None]) -> None:
    part = path.with_name(path.name + _PART)
    file = open_private(part, "a+")
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
        if not _is_at(file, part):  # another process has finished it, or it was deleted
            return
        if path.exists():  # another process had finished it before this file was made
            part.unlink()
            return
        with os.fdopen(os.dup(file.fileno()), "r+b") as buffered:
            tell(buffered.seek(0, os.SEEK_END))
            for piece in pieces(buffered.tell()):
                buffered.write(piece)
                tell(len(piece))
            buffered.flush()
            buffered.seek(0)
            found = hashlib.file_digest(buffered, "sha256").hexdigest()
        if found != path.name:
            part.unlink()
            raise FormatError(
                f"expected bytes with the SHA-256 {path.name}, found {found}: they are not kept; try again"
            )
        part.replace(path)
    finally:
        drop_private(file)


def _delete(path: Path) -> bool:
    """Deletes a file unless somebody uses it."""
    try:
        file = open_private(path, "r")
    except FileNotFoundError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if _is_at(file, path):
            path.unlink()
    except BlockingIOError:
        return False
    finally:
        drop_private(file)
    return True


def _is_at(file: io.FileIO, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _budget() -> int:
    text = os.environ.get(_BUDGET_VARIABLE, str(_BUDGET))
    if not text.isdecimal():
        raise StorageError(f"expected {_BUDGET_VARIABLE} to be a number of bytes, found {text!r:.80}")
    return int(text)
