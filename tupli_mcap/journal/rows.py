"""Rows of constant size: how many make a chunk, and what is filled in when they go to the file."""

from __future__ import annotations

from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.mcap.container import Rows

LAST_ROW = 2**32 - 2  # `sequence` has 32 bits, and the last value marks a hole


def rows_per_half(row_size: int, chunk_size: int) -> int:
    """Rows that make a chunk of about `chunk_size` bytes, at least one."""
    return max(1, chunk_size // row_size)


class RowDeriver:
    """Fills what `step()` left out: `step`, a `log_time` that never decreases, `publish_time`.

    It carries the running episode from one batch of rows of a channel to the next.
    """

    def __init__(self, episode: int = -1, step: int = -1, time_ns: int = 0) -> None:
        self._episode = episode
        self._step = step
        self._time = time_ns

    def fill(self, rows: Array) -> None:
        """Completes consecutive rows in place."""
        n = len(rows)
        if not n:
            return
        times = rows["#log_time"].astype(np.uint64)
        times[0] = max(int(times[0]), self._time)
        np.maximum.accumulate(times, out=times)
        rows["#log_time"] = times
        rows["#publish_time"] = times
        episodes = rows["episode"].astype(np.int64)
        index = np.arange(n)
        starts = np.zeros(n, dtype=np.int64)
        starts[1:] = np.where(episodes[1:] != episodes[:-1], index[1:], 0)
        np.maximum.accumulate(starts, out=starts)
        steps = index - starts
        if episodes[0] == self._episode:
            first = int(np.searchsorted(starts, 1))
            steps[:first] += self._step + 1
        rows["step"] = steps
        self._episode, self._step, self._time = int(episodes[-1]), int(steps[-1]), int(times[-1])


def even_rows(channel: int, first: int, data: Any, rows: Array) -> Rows:
    """`Rows` of constant size: `rows` is the structured view of `data`."""
    offsets = np.arange(len(rows), dtype=np.uint64) * np.uint64(rows.dtype.itemsize)
    return Rows(channel, first, data, offsets, rows["#log_time"].astype(np.uint64))
