"""A thread that compresses, or writes, chunks while the next rows are recorded.

For a single small chunk it would cost more than it saves: the interpreter lock starves it. Images, and the chunks of
many sub-environments in one call, spend their time in the compressor, which lets go of that lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

__all__ = ["ChunkWorker"]

T = TypeVar("T")


class ChunkWorker:
    """Runs jobs on a thread of its own, one after another. The thread is started at the first one."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, job: Callable[[], T]) -> Future[T]:
        """Hands a job over; returns once the thread has taken it up. Its memory must stay until the result comes."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="tupli-mcap-chunks")
        started = threading.Event()

        def run() -> T:
            started.set()
            return job()

        try:
            future = self._pool.submit(run)
        except RuntimeError:  # the interpreter is about to end, and starts nothing new
            future = Future()
            future.set_result(job())
            return future
        # without the handshake the recording thread keeps the interpreter lock until its next half is full, too
        started.wait(1.0)
        return future

    def close(self) -> None:
        """Waits for the thread and ends it."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None
