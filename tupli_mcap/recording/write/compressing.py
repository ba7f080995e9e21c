"""Compresses chunks at once, or on a thread while the next rows are recorded, where a job is long enough.

A small chunk is done before a thread has woken up and both have waited for the interpreter lock. Photographs, and the
chunks of many sub-environments in one call, spend milliseconds in the compressor, which lets go of that lock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
# Seconds of work: handing a chunk over costs the recording thread some 0.05 ms, on virtual machines ten times as much.
WORTH_A_THREAD = 0.001
LARGE = 3 << 20  # bytes that take as long at 3 GB/s; how long they do is known from the second job on


class ChunkWorker:
    """Runs jobs one after another: on a thread of its own if the one before took long, else at once.

    For the first job, its size decides.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._seconds: float | None = None  # of processor time, of the last job

    def submit(self, job: Callable[[], T], size: int) -> Callable[[], T]:
        """Does a job, or hands it to the thread and returns once that has begun. Returns a function that waits for the
        job.

        The job's memory, `size` bytes, must stay until then.
        """

        def timed() -> T:
            begun = time.thread_time()
            result = job()
            self._seconds = time.thread_time() - begun
            return result

        worth_a_thread = size >= LARGE if self._seconds is None else self._seconds >= WORTH_A_THREAD
        if not worth_a_thread:
            done = timed()
            return lambda: done
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="tupli-mcap-chunks")
        started = threading.Event()

        def run() -> T:
            started.set()
            return timed()

        try:
            future = self._pool.submit(run)
        except RuntimeError:  # the interpreter is about to end, and starts nothing new
            done = job()
            return lambda: done
        # without the handshake the recording thread keeps the interpreter lock until its next half is full, too
        started.wait(1.0)
        return future.result

    def close(self) -> None:
        """Waits for the thread and ends it."""
        if self._pool is not None:
            self._pool.shutdown(wait=True)
            self._pool = None
