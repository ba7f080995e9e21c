"""Waits for events, with a time-out that a busy machine does not reach; a port that nobody uses."""

from __future__ import annotations

import itertools
import os
import socket
import time
from collections.abc import Callable

_PORTS = itertools.count(
    10_000 + 1009 * os.getpid() % 20_000
)  # far from those of a process started beside it


def wait_for(condition: Callable[[], bool], seconds: float = 120.0) -> None:
    """Asks again and again. An AssertionError if it has not happened in time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.02)


def free_port() -> int:
    """A port of 127.0.0.1. The system gives it to nobody who asks for any port, and no other test process takes it."""
    for port in _PORTS:
        try:
            socket.create_server(("127.0.0.1", port)).close()
        except OSError:
            continue
        return port
    raise AssertionError
