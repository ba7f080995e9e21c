"""Files that are read at random places: many of them, of which only some are open."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

from tupli_mcap.mcap.source import Source, open_source

__all__ = ["FileOfMany", "OpenFiles"]


class OpenFiles:
    """Opens files when they are read, and keeps those open that were read last. Safe from several threads.

    A forked child opens them itself, as does a copy in another process.

    Args:
        limit: how many are open at a time; a few more while several threads read.
    """

    def __init__(self, limit: int = 64) -> None:
        self._limit = limit
        self._forget()

    def _forget(self) -> None:
        self._sources: OrderedDict[str, Source] = OrderedDict()
        self._lock = threading.Lock()
        self._process = os.getpid()

    def source(self, where: str) -> Source:
        """The open file of a path or a URL. It closes when nobody holds it any more."""
        if self._process != os.getpid():  # the lock may be held by a thread that is not here
            self._forget()
        with self._lock:
            found = self._sources.get(where)
            if found is None:
                found = self._sources[where] = open_source(where)
                if len(self._sources) > self._limit:
                    self._sources.popitem(last=False)  # closed when the last reader has let go of it
            self._sources.move_to_end(where)
            return found

    def __getstate__(self) -> dict[str, Any]:
        return {"limit": self._limit}

    def __setstate__(self, state: dict[str, Any]) -> None:
        OpenFiles.__init__(self, state["limit"])


class FileOfMany:
    """A `Source` that is open only while it is among those read last."""

    def __init__(self, files: OpenFiles, where: str, size: int) -> None:
        self._files = files
        self.name = where
        self.path: Path | None = None if "://" in where else Path(where)
        self.size = size

    def read(self, offset: int, length: int) -> bytes:
        return self._files.source(self.name).read(offset, length)

    def lend(self, offset: int, length: int) -> memoryview:
        return self._files.source(self.name).lend(offset, length)

    def view(self, offset: int, length: int) -> memoryview:
        return self._files.source(self.name).view(offset, length)

    def refresh(self) -> None:
        self.size = self._files.source(self.name).size

    def close(self) -> None:
        """Nothing: the others decide."""
