"""Blocks of remote files that outlive the process: `<cache>/blocks/<version>/<first byte>-<byte after the last>`.

Only the user turns this on, with TUPLI_MCAP_BLOCK_BYTES, as blocks may be of private files. All of it may be deleted at
any time, and any number of processes may use it:

1. `<version>` is a hash of a file's URL and ETag. A file without a strong ETag is not kept: a weak one does not change
   with each byte.
2. A block is a SHA-256 and the bytes. It appears by renaming; a damaged block counts as missing.
3. Blocks used longest ago are deleted until the rest is within the budget. Each process looks after that when it has
   written a sixteenth of the budget.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from pathlib import Path
from typing import Final

from tupli_mcap import files
from tupli_mcap.cache import cache_dir, delete_oldest, make_private
from tupli_mcap.errors import RecordingError
from tupli_mcap.remote.plan import Range

_VARIABLE: Final = "TUPLI_MCAP_BLOCK_BYTES"
_DIGEST: Final = 32
_PARTS: Final = 16
_lock = threading.Lock()
_written = 0  # bytes of blocks since this process has last deleted some


def kept_blocks(url: str, version: str) -> KeptBlocks | None:
    """The blocks of one version of a file; None if none are kept.
    RecordingError if TUPLI_MCAP_BLOCK_BYTES is no number of bytes."""
    text = os.environ.get(_VARIABLE, "0")
    if not text.isdecimal():
        raise RecordingError(f"expected {_VARIABLE} to be a number of bytes, found {text!r:.80}")
    if not int(text) or not version.startswith('"'):
        return None
    name = hashlib.sha256(f"{version} {url}".encode()).hexdigest()[:32]
    return KeptBlocks(cache_dir() / "blocks" / name, int(text))


class KeptBlocks:
    """The blocks of one version of a file. Thread-safe. A disk that fails or is full keeps nothing."""

    def __init__(self, folder: Path, budget: int) -> None:
        self._folder, self._budget = folder, budget

    def ranges(self) -> list[Range]:
        """The ranges of bytes that are kept."""
        found = []
        with contextlib.suppress(OSError):
            for path in self._folder.iterdir():
                first, _, last = path.name.partition("-")
                if first.isdecimal() and last.isdecimal():
                    found.append((int(first), int(last)))
        return found

    def read(self, block: Range) -> memoryview | None:
        """The bytes of a block; None if it is gone or damaged."""
        path = self._path(block)
        try:
            data = path.read_bytes()
            os.utime(path)
        except OSError:
            return None
        body = memoryview(data)[_DIGEST:]
        if len(body) != block[1] - block[0] or hashlib.sha256(body).digest() != data[:_DIGEST]:
            return None
        return body

    def write(self, block: Range, data: memoryview) -> None:
        """Keeps the bytes of a block."""
        global _written
        size = _DIGEST + len(data)
        if size > self._budget:
            return
        with contextlib.suppress(OSError):
            make_private(self._folder)
            files.write_bytes(
                self._path(block), hashlib.sha256(data).digest() + bytes(data), permissions=0o600
            )
            with _lock:
                _written += size
                is_due = _written > self._budget // _PARTS
                _written = 0 if is_due else _written
            if is_due:
                self._delete_oldest()

    def _path(self, block: Range) -> Path:
        return self._folder / f"{block[0]}-{block[1]}"

    def _delete_oldest(self) -> None:
        left = self._budget - self._budget // _PARTS
        delete_oldest((path for path in self._folder.parent.rglob("*") if path.is_file()), left, _delete)
        for folder in self._folder.parent.iterdir():
            with contextlib.suppress(OSError):  # not empty
                folder.rmdir()


def _delete(path: Path) -> bool:
    path.unlink(missing_ok=True)
    return True
