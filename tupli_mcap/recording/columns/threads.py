"""Runs many small tasks on a few threads with little contention."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

_FEW = 4  # so many are done before a thread has started


def do_all(tasks: Sequence[Callable[[], None]], threads: int) -> None:
    """Does all of the tasks, in `threads` threads, of which the calling one is the first.

    The first error of a task is raised when the tasks at work have ended; the others are left out.
    """
    # Not a future for each task: who waits for them wakes up at every one, and takes the interpreter from the workers.
    left = deque(tasks)
    if threads < 2 or len(left) <= _FEW:
        _work(left, left.popleft)
        return
    # From both ends: neighbouring tasks write to neighbouring pages, and threads that need a new one at once wait for
    # each other.
    ends = itertools.cycle((left.pop, left.popleft))
    with ThreadPoolExecutor(threads - 1) as pool:
        others = [
            pool.submit(_work, left, take) for take in itertools.islice(ends, min(threads, len(left)) - 1)
        ]
        _work(left, left.popleft)
    for other in others:
        other.result()


def _work(left: deque[Callable[[], None]], take: Callable[[], Callable[[], None]]) -> None:
    """Takes one task after the other, as long as there are some."""
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
