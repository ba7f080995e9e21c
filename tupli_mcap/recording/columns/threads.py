"""Runs many small tasks on a few threads with little contention."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

_FEW = 4  # up to this many tasks take less time than to start a thread


def do_all(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Runs all tasks on `threads` threads, the calling one included.

    After an error no further task begins; the first error is raised once running tasks have ended.
    """
    # No future for each task: a thread that waits for them wakes up at every one, and takes the interpreter lock.
    left = deque(tasks)
    if threads < 2 or len(left) <= _FEW:
        _work(left, left.popleft)
        return
    # From both ends: neighbouring tasks write to neighbouring pages, and threads that touch new pages there at the same
    # time wait for each other.
    ends = itertools.cycle((left.pop, left.popleft))
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [
            pool.submit(_work, left, take) for take in itertools.islice(ends, min(threads, len(left)) - 1)
        ]
        _work(left, left.popleft)
    for other in others:
        other.result()


def _work(left: deque[Callable[[], None]], take: Callable[[], Callable[[], None]]) -> None:
    """Runs one task after the other until none is left."""
    try:
        while True:
            try:
                task = take()
            except IndexError:
                return
            task()
    except BaseException:
        left.clear()
        raise
