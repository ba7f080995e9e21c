"""Writes chunks into the file; compresses them at once, or on a thread while the next rows are recorded, where a job is
long enough.

A small chunk is done before a thread has woken up and both have waited for the interpreter lock. Photographs, and the
chunks of many sub-environments in one call, spend milliseconds in the compressor, which lets go of that lock.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from tupli_mcap.errors import RecordingError, warn
from tupli_mcap.journal.derive import LAST_ROW
from tupli_mcap.mcap.container import Container, Rows
from tupli_mcap.mcap.lock import FileLock

_MOST_ROWS = LAST_ROW - (1 << 26)  # of a channel in the file: those in the journal must not come to LAST_ROW

T = TypeVar("T")
# Seconds of work from which a job is handed over: that costs the recording thread time, too, on virtual machines most.
WORTH_A_THREAD = 0.001
# Bytes of a first job that is handed over; how long a job takes is known from the second one on.
LARGE = 3 << 20


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


class ChunkWriter:
    """Writes chunks of rows into a file.

    Args:
        path: of the file, as its user names it.
        settle: called after chunks are written: waits until they are on the disk, where that is asked for.
    """

    def __init__(self, path: Path, container: Container, lock: FileLock, settle: Callable[[], None]) -> None:
        self._path, self._container, self._lock, self._settle = path, container, lock, settle
        self._worker = ChunkWorker()
        self._warned_of_deletion = False

    def add(self, rows: Rows) -> None:
        """Writes a chunk."""
        self._check_room(rows)
        self._container.add_chunk(rows)
        self.warn_if_deleted()
        self._settle()

    def start(self, chunks: Sequence[Rows]) -> Callable[[], None]:
        """Begins to compress chunks, on the worker's thread; the result waits for it and writes them.

        Until then their memory must stay, and no other chunk of their channels be written.
        """
        for rows in chunks:
            self._check_room(rows)
        container = self._container
        pack = container.start_chunks(chunks)
        # a thread that needs the interpreter lock for every chunk would wait for it again and again
        in_thread = len(chunks) == 1 or container.packs_together
        size = sum(len(rows.data) for rows in chunks)
        packed = self._worker.submit(pack, size) if in_thread else pack

        def finish() -> None:
            container.finish_chunks(packed())
            self._settle()
            self.warn_if_deleted()

        return finish

    def close(self) -> None:
        """Waits for the worker's thread and ends it."""
        self._worker.close()

    def warn_if_deleted(self) -> None:
        """Once: what is written to a file without a name is lost when it is closed."""
        if self._lock.is_deleted and not self._warned_of_deletion:
            self._warned_of_deletion = True
            warn(
                f"{self._path} was deleted while it is being recorded, and nothing of it will remain; "
                "record to another file",
                RuntimeWarning,
            )

    def _check_room(self, rows: Rows) -> None:
        if rows.first + len(rows.offsets) > _MOST_ROWS:
            raise RecordingError(
                f"{self._path}: expected at most {_MOST_ROWS} messages in a channel, found more; close it (every step "
                "is safe), and go on in a new recording"
            )
