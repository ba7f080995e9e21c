"""Who tries passwords may not try many."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Final

from tupli_mcap.errors import TupliError

__all__ = ["Throttle", "TooManyError"]

_SECONDS: Final = 60.0


class TooManyError(TupliError):
    """There were too many failures; `seconds` is how long to wait."""

    def __init__(self, seconds: float) -> None:
        super().__init__("too many failed attempts; wait a minute")
        self.seconds = seconds


class Throttle:
    """Counts failures of the last minute by key. Usable from any thread."""

    def __init__(self) -> None:
        self._failures: dict[str, deque[float]] = {}
        self._turn = threading.Lock()

    def wait(self, most: Mapping[str, int]) -> float:
        """Seconds until another try, where each key may have so many failures; 0 if it may be made now."""
        now = time.monotonic()
        with self._turn:
            for key in list(self._failures):
                times = self._failures[key]
                while times and times[0] < now - _SECONDS:
                    times.popleft()
                if not times:
                    del self._failures[key]
            full = [self._failures[key] for key in most if len(self._failures.get(key, ())) >= most[key]]
            return max((times[0] + _SECONDS - now for times in full), default=0.0)

    def failed(self, most: Mapping[str, int]) -> None:
        """Notes a failure of each key."""
        with self._turn:
            for key in most:
                self._failures.setdefault(key, deque()).append(time.monotonic())
