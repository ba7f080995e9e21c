"""Passes a batch from a worker to the loader: all its tensors in one piece of shared memory.

PyTorch passes a file for each tensor, which costs more than reading a small batch; this passes one for each batch.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.multiprocessing.reductions import reduce_storage

from tupli_mcap.arrays import Array
from tupli_mcap.recording.columns.fields import ColumnDict

_ALIGNED = 64  # bytes
_NUMBERS = (np.ndarray, np.generic)
_DYING = 0.5  # seconds after closing its files until a process is surely dead


class _TensorPlace(NamedTuple):
    """The place of a tensor in the shared memory."""

    start: int
    stop: int
    dtype: torch.dtype
    shape: tuple[int, ...]


class PackedBatch(ColumnDict):
    """Columns whose tensors share one buffer (uint8); once pickled, it is a plain `ColumnDict`."""

    def __init__(self, buffer: torch.Tensor, places: dict[str, Any]) -> None:
        super().__init__(_columns(buffer, places))
        self._parts = buffer, places
        self._leaves = list(_leaves(self))

    def __reduce__(self) -> tuple[Any, ...]:
        return (_columns, self._parts) if self._unchanged else (ColumnDict, (dict(self),))

    def _handed_over(self) -> tuple[Any, ...]:
        """The form in which `ForkingPickler` passes it to another process."""
        if not self._unchanged:
            return ColumnDict, (dict(self),)
        buffer, places = self._parts
        return _received, (*reduce_storage(buffer.untyped_storage()), places)  # type: ignore[no-untyped-call]

    @property
    def _unchanged(self) -> bool:
        """Whether it still has the columns that are in the buffer."""
        now = list(_leaves(self))
        return len(now) == len(self._leaves) and all(map(_same, now, self._leaves))

    def __copy__(self) -> ColumnDict:
        return ColumnDict(self)  # a changed copy would not be what is in the buffer


def _leaves(column: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(column, dict | tuple):
        for key, part in column.items() if isinstance(column, dict) else enumerate(column):
            yield from _leaves(part, (*path, key))
    else:
        yield path, column


def _same(now: tuple[Any, Any], then: tuple[Any, Any]) -> bool:
    return now[0] == then[0] and now[1] is then[1]


def packed(columns: dict[str, Any]) -> PackedBatch:
    """Columns of arrays, copied into shared memory."""
    arrays: list[Array] = []
    ends = [0]
    places = _placed(columns, arrays, ends)
    storage = torch.UntypedStorage._new_shared(max(1, ends[-1]))  # type: ignore[no-untyped-call]  # as default_collate
    buffer = torch.empty(0, dtype=torch.uint8).set_(storage)
    target = buffer.numpy()
    for array, end in zip(arrays, ends[1:], strict=True):
        target[end - array.nbytes : end] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return PackedBatch(buffer, places)


def _placed(column: Any, arrays: list[Array], ends: list[int]) -> Any:
    """The places of arrays. (Not an inner function: a recursive one is a cycle, which would keep the arrays alive.)"""
    if isinstance(column, _NUMBERS):
        array = np.asarray(column)
        start = -(-ends[-1] // _ALIGNED) * _ALIGNED
        arrays.append(array)
        ends.append(start + array.nbytes)
        return _TensorPlace(start, ends[-1], torch.from_numpy(np.empty(0, array.dtype)).dtype, array.shape)
    if isinstance(column, Mapping):
        return {key: _placed(part, arrays, ends) for key, part in column.items()}
    return tuple(_placed(part, arrays, ends) for part in column) if isinstance(column, tuple) else column


ForkingPickler.register(PackedBatch, PackedBatch._handed_over)


def _received(rebuild: Callable[..., Any], arguments: tuple[Any, ...], places: dict[str, Any]) -> ColumnDict:
    """The batch of another process, in the memory that this one shares. RuntimeError if that process is dead."""
    try:
        storage = rebuild(*arguments)
    except (EOFError, ConnectionError, FileNotFoundError) as err:
        time.sleep(_DYING)  # then the DataLoader knows, too, which one it was
        raise RuntimeError(
            "a worker of the DataLoader has died while it handed over a batch; it may have been killed, for using too "
            "much memory for example"
        ) from err
    return _columns(torch.empty(0, dtype=torch.uint8).set_(storage), places)


def _columns(buffer: torch.Tensor, places: dict[str, Any]) -> ColumnDict:
    return ColumnDict(_unpacked(buffer, places))


def _unpacked(buffer: torch.Tensor, place: Any) -> Any:
    if isinstance(place, _TensorPlace):
        return buffer[place.start : place.stop].view(place.dtype).view(place.shape)
    if isinstance(place, Mapping):
        return {key: _unpacked(buffer, part) for key, part in place.items()}
    return tuple(_unpacked(buffer, part) for part in place) if isinstance(place, tuple) else place
