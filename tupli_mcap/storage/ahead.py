"""Recordings read ahead of the catalog, by processes: for one that has many files to go through.

They are started as programs, not forked (this process may have threads) and not by `multiprocessing` (which would run
the caller's script again). What goes wrong in one is nobody's trouble: the recording is read here then.
"""

from __future__ import annotations

import json
import marshal
import os
import struct
import subprocess
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.recording import Recording
from tupli_mcap.storage.catalog.entries import catalog_rows
from tupli_mcap.storage.catalog.rows import RecordingStamp, store_row
from tupli_mcap.storage.scan import stamp_of
from tupli_mcap.storage.sidecar import Notes

__all__ = ["Ahead", "ReadRecording"]

_MOST_EPISODES = 50_000  # of a recording that is read ahead: its rows are in memory twice
_TRIAL = 1.0  # seconds of reading here before it is known whether more processes are worth their start
_WORTH = 3.0  # seconds that must be left then
_MOST_WORKERS = 8
_SIZE = struct.Struct("<I")
_PROGRAM = "from tupli_mcap.storage.ahead import serve; serve()"


class ReadRecording(NamedTuple):
    """What the catalog holds of a recording; `rows` are as `StoredRow`, of a recording whose id is 0.

    `ends` are the numbers of its first and last episode, deleted ones too.
    """

    stamp: RecordingStamp
    live: bool
    uuid: str
    benchmark_id: str
    ends: Sequence[int]
    rows: Sequence[tuple[Any, ...]]


class Ahead:
    """Gives what other processes have read of recordings, in the order of `names` (below `root`), once that is worth
    while; None where it has not been read."""

    def __init__(self, root: Path, names: Sequence[str], workers: int | None = None) -> None:
        self._root, self._names = root, deque(names)
        self._total = len(names)
        self._started = time.monotonic()
        self._wanted = workers
        self._count = min(workers or len(os.sched_getaffinity(0)), _MOST_WORKERS)
        self._pool: ThreadPoolExecutor | None = None
        self._local = threading.local()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._coming: deque[tuple[str, Future[ReadRecording | None]]] = deque()

    def __enter__(self) -> Ahead:
        return self

    def take(self, name: str) -> ReadRecording | None:
        """The next of the names."""
        if self._pool is None and self._is_worth_while():
            self._pool = ThreadPoolExecutor(self._count, "tupli-mcap-catalog")
        if self._pool is None:
            self._names.popleft()
            return None
        while self._names and len(self._coming) < 4 * self._count:
            following = self._names.popleft()
            self._coming.append((following, self._pool.submit(self._read, following)))
        found, future = self._coming.popleft()
        return future.result() if found == name else None

    def _is_worth_while(self) -> bool:
        if self._wanted is not None:
            return self._wanted > 0
        taken, done = time.monotonic() - self._started, self._total - len(self._names)
        return self._count > 1 and taken > _TRIAL and taken / max(1, done) * len(self._names) > _WORTH

    def _read(self, name: str) -> ReadRecording | None:
        """In a thread of the pool, each of which has a process."""
        with suppress(OSError, ValueError, TypeError, EOFError, struct.error):
            if not hasattr(self._local, "process"):
                self._local.process = self._start()
            process = self._local.process
            if process.poll() is None:
                process.stdin.write(json.dumps([os.fspath(self._root), name]).encode() + b"\n")
                process.stdin.flush()
                (size,) = _SIZE.unpack(process.stdout.read(_SIZE.size))
                found = marshal.loads(process.stdout.read(size))
                return None if found is None else ReadRecording(RecordingStamp(*found[0]), *found[1:])
        return None

    def _start(self) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
        )
        self._processes.append(process)
        return process

    def __exit__(self, *_: object) -> None:
        for _name, coming in self._coming:
            coming.cancel()
        for process in self._processes:
            process.kill()
        if self._pool is not None:
            self._pool.shutdown()
        for process in self._processes:
            process.wait()
            for pipe in (process.stdin, process.stdout):
                with suppress(OSError):  # what was not sent yet is of no use
                    if pipe is not None:
                        pipe.close()


def serve() -> None:
    """What the process does: reads recordings that it is told of on stdin, one a line, until there are no more."""
    for root, name in _asked():
        found = None
        with suppress(Exception), warnings.catch_warnings():  # read where it is missed, and said there
            warnings.simplefilter("error")
            found = _read_recording(Path(root), name)
        data = marshal.dumps(found)
        sys.stdout.buffer.write(_SIZE.pack(len(data)) + data)
        sys.stdout.buffer.flush()


def _asked() -> Iterator[list[str]]:
    while line := sys.stdin.buffer.readline():
        yield json.loads(line)


def _read_recording(root: Path, name: str) -> tuple[Any, ...] | None:
    """The fields of a ReadRecording, as plain tuples; None if it is too long."""
    path = root / name
    stamp, notes, live = stamp_of(root, name), Notes.read(path, root), is_locked(path)
    with Recording(path) as recording:
        live |= is_locked(path)  # a writer may have come or gone meanwhile
        numbers = recording.index["episode"]
        if len(numbers) > _MOST_EPISODES:
            return None
        sidecar = notes.about(recording.metadata)
        rows = [tuple(store_row(0, row)) for row in catalog_rows(recording, sidecar, live=live)]
        ends = [int(numbers[i]) for i in (0, -1)] if len(numbers) else []
        facts = (live, recording.uuid, recording.benchmark_id, ends)
    return ((*stamp,), *facts, rows)
