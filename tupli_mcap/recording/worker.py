"""A thread that writes chunks of large rows while the next rows are recorded.

For small rows it would cost more than it saves: the interpreter lock starves it. A chunk of images spends its time in
the compressor, which lets go of that lock.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

from tupli_mcap.recording.container import Rows

__all__ = ["ChunkWorker"]


class ChunkWorker:
    """Calls `sink` with chunks on a thread of its own, one after another. The thread is started at the first chunk."""

    def __init__(self, sink: Callable[[Rows], None]) -> None:
        self._sink = sink
        self._pool: ThreadPoolExecutor | None = None

    def submit(self, rows: Rows) -> Future[None]:
        """Hands a chunk over; returns once the thread has taken it up. Its memory must stay until the result comes."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="tupli-mcap-chunks")
        started = threading.Event()

        def write() -> None:
            started.set()
            self._sink(rows)

        try:
            future = self._pool.submit(write)
        except RuntimeError:  # the interpreter is about to end, and starts nothing new
            future = Future()
            self._sink(rows)
            future.set_result(None)
            return future
        # without the handshake the recording thread keeps the interpreter lock until its next half is full, too
        started.wait(1.0)
        return future

    def close(self) -> None:
        """Waits for the thread and ends it."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None
