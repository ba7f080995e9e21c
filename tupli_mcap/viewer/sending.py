"""Sends columns to Rerun: times on timelines, and a row of values for each time."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.viewer.sdk import pa, rr


class Times:
    """The positions of rows on the timelines: numbers of steps, and wall clock (ns). step_seconds: duration of a step
    in the environment (s); without one, its timeline is left out. seams: the first rows of episodes that follow another
    one."""

    def __init__(
        self, step: Array, wall: Array, step_seconds: float | None, seams: Sequence[int] = ()
    ) -> None:
        self.seams = seams
        self._step = step
        self._wall = wall
        self._step_seconds = step_seconds

    @cached_property
    def columns(self) -> list[Any]:
        columns = [
            rr.TimeColumn("step", sequence=self._step),
            rr.TimeColumn("time", timestamp=self._wall.astype("datetime64[ns]")),
        ]
        if self._step_seconds is not None:
            columns.insert(1, rr.TimeColumn("episode_time", duration=self._step * self._step_seconds))
        return columns

    def at(self, rows: Array) -> Times:
        return Times(self._step[rows], self._wall[rows], self._step_seconds)

    def moved(self, steps: int) -> Times:
        """The same rows `steps` later on the step timeline, at the same wall clock."""
        return Times(self._step + steps, self._wall, self._step_seconds)

    def inserted(self, before: Array, step: Array, wall: Array) -> Times:
        """With rows added, each before one of these."""
        return Times(
            np.insert(self._step, before, step), np.insert(self._wall, before, wall), self._step_seconds
        )

    @cached_property
    def broken(self) -> Times:
        """The times with each of the seams twice."""
        return self.at(np.insert(np.arange(len(self._step)), self.seams, self.seams)) if self.seams else self


def pooled(values: Array, most: int, axis: int = 0) -> tuple[Array, Array]:
    """Means of neighbours along an axis, at most `most` of them, and the bounds of the ranges that each one covers."""
    length = values.shape[axis]
    bounds = np.linspace(0, length, min(length, most) + 1).astype(int)
    if length <= most:
        return values, bounds
    sums = np.add.reduceat(values, bounds[:-1], axis=axis)
    shape = [1] * values.ndim
    shape[axis] = most
    return sums / np.diff(bounds).reshape(shape), bounds


class _Batch:
    """An Arrow array for a `ComponentColumn`. (The SDK's own batches copy their values.)"""

    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        return self._array


def column_of(descriptor: Any, array: Any, width: int = 1) -> Any:
    """A component's column from an Arrow array (rows * width values)."""
    offsets = np.arange(0, len(array) + 1, width, dtype=np.int32)
    return rr.ComponentColumn(descriptor, _Batch(array), offsets=offsets)


def send_scalars(stream: Any, entity: str, times: Times, values: Array) -> None:
    """Sends `values` (rows x width), one batch a row."""
    # the SDK aborts the process if an array is not contiguous or not aligned
    flat = np.require(values, np.float64, ("C", "ALIGNED")).reshape(-1)
    column = column_of(rr.Scalars.descriptor_scalars(), pa.array(flat), values.shape[1])
    stream.send_columns(entity, times.columns, [column])


def send_texts(stream: Any, entity: str, times: Times, descriptor: Any, texts: Sequence[str | None]) -> None:
    """Sends one text a row; None is an empty one."""
    array = pa.array(texts, pa.utf8())
    stream.send_columns(entity, times.columns, [column_of(descriptor, array)])


def send_blobs(stream: Any, entity: str, times: Times, descriptor: Any, values: Array) -> None:
    """Sends `values` (rows x bytes), one blob a row."""
    rows, width = values.shape
    blobs = blob_array(values.reshape(-1), np.arange(0, rows * width + 1, width))
    stream.send_columns(entity, times.columns, [column_of(descriptor, blobs)])


def blob_array(data: Array, ends: Array) -> Any:
    """Cuts bytes into blobs. They must be declared as never null, or the viewer does not show them."""
    blob = pa.list_(pa.field("item", pa.uint8(), nullable=False))
    return pa.ListArray.from_arrays(pa.array(ends.astype(np.int32)), pa.array(data), type=blob)


def send_tensors(
    stream: Any, entity: str, times: Times, values: Sequence[Array], names: Sequence[str]
) -> None:
    """Sends one tensor a row; for `values` and `names`, see `tensor_array`."""
    column = column_of(rr.Tensor.descriptor_data(), tensor_array(values, names))
    stream.send_columns(entity, times.columns, [column])


def tensor_array(values: Sequence[Array], names: Sequence[str]) -> Any:
    """Tensors: arrays of one dtype (float32, float64, int64 or uint8), and of as many dimensions as there are names.

    Made without a cast, since the first cast of a process makes pyarrow load its compute functions.
    """
    rows = len(values)
    goal = _tensor_type()
    fields = [goal.field(i) for i in range(goal.num_fields)]  # shape, names, buffer
    ends = pa.array(np.arange(0, rows * len(names) + 1, len(names), dtype=np.int32))
    shapes = pa.array(np.array([value.shape for value in values], np.uint64).reshape(-1))
    dimension_names = pa.array(list(names) * rows, pa.utf8())
    return pa.StructArray.from_arrays(
        [
            pa.ListArray.from_arrays(ends, shapes, type=fields[0].type),
            pa.ListArray.from_arrays(ends, dimension_names, type=fields[1].type),
            _tensor_buffers(values, fields[2].type),
        ],
        fields=fields,
    )


@cache
def _tensor_type() -> Any:
    return rr.components.TensorDataBatch(None).as_arrow_array().type


def _tensor_buffers(values: Sequence[Array], union: Any) -> Any:
    """The buffers of tensors, a dense union of lists with one child for each dtype."""
    kind = {"float32": "F32", "float64": "F64", "int64": "I64", "uint8": "U8"}[values[0].dtype.name]
    ends = pa.array(np.cumsum([0, *(value.size for value in values)]).astype(np.int32))
    data = pa.array(np.concatenate([value.reshape(-1) for value in values]))
    of_union = [union.field(i) for i in range(union.num_fields)]
    children = [
        pa.ListArray.from_arrays(ends, data, type=field.type)
        if field.name == kind
        else pa.array([], field.type)
        for field in of_union
    ]
    code = [field.name for field in of_union].index(kind)
    codes = pa.array(np.full(len(values), code, np.int8))
    offsets = pa.array(np.arange(len(values), dtype=np.int32))
    return pa.UnionArray.from_buffers(
        union, len(values), [None, codes.buffers()[1], offsets.buffers()[1]], children=children
    )
