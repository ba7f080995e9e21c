"""Columns on their way to Rerun: timelines, and values in rows."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

__all__ = ["Times", "column_of", "send_scalars", "send_texts"]

Array = np.ndarray[Any, Any]


class Times:
    """Where rows lie on the timelines.

    Args:
        step: number of the step.
        wall: wall clock (ns).
        seconds: time in the environment (s); None if it is not known, then there is no such timeline.
    """

    def __init__(self, step: Array, wall: Array, seconds: Array | None) -> None:
        self._step = step
        self._wall = wall
        self._seconds = seconds

    @cached_property
    def columns(self) -> list[Any]:
        """The time columns, for `send_columns`."""
        import rerun as rr

        columns = [
            rr.TimeColumn("step", sequence=self._step),
            rr.TimeColumn("time", timestamp=self._wall.astype("datetime64[ns]")),
        ]
        if self._seconds is not None:
            columns.insert(1, rr.TimeColumn("episode_time", duration=self._seconds))
        return columns

    def at(self, rows: Array) -> Times:
        """Of some of the rows."""
        return Times(
            self._step[rows], self._wall[rows], None if self._seconds is None else self._seconds[rows]
        )


class _Batch:
    """An Arrow array as it is, for a `ComponentColumn`; the SDK's own batches copy what they are given."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        return self._array


def column_of(descriptor: Any, array: Any, width: int = 1) -> Any:
    """A component's column from an Arrow array (rows * width values)."""
    import rerun as rr

    offsets = np.arange(0, len(array) + 1, width, dtype=np.int32)
    return rr.ComponentColumn(descriptor, _Batch(array), offsets=offsets)


def send_scalars(stream: Any, entity: str, times: Times, values: Array) -> None:
    """Send `values` (rows x width), one batch a row."""
    import pyarrow as pa
    import rerun as rr

    flat = np.ascontiguousarray(values, np.float64).reshape(-1)
    column = column_of(rr.Scalars.descriptor_scalars(), pa.array(flat), values.shape[1])
    stream.send_columns(entity, times.columns, [column])


def send_texts(stream: Any, entity: str, times: Times, descriptor: Any, texts: Any) -> None:
    """Send one text a row (a list, or an Arrow array); None is an empty one."""
    import pyarrow as pa

    array = texts if isinstance(texts, pa.Array) else pa.array(texts, pa.utf8())
    stream.send_columns(entity, times.columns, [column_of(descriptor, array)])
