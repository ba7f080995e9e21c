"""The steps of a dataset by number, which windows, transitions and samplers read."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.errors import TupliError
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.fields import FIVE, field_names, fields_and_parts
from tupli_mcap.schema import BaseFilter, F

FIELDS = (*FIVE, "next_states", "times")
_MAX_ITEM = 1 << 30  # bytes of an item of an array
_BLOCK = 4096  # steps in memory that are close to each other


class SamplingError(TupliError, ValueError):
    """An invalid request for steps: a window longer than every episode, negative weights."""


class Steps(Protocol):
    """The wanted steps of a dataset, numbered 0 to n - 1, episode after episode in its order.

    Attributes:
        fields: the fields that `read` knows.
        layout: the leaves of columns and their nesting; None without a step.
        episode_lengths: int64, the number of wanted steps of each episode; may be 0.
        breaks: int64, ascending: steps that are not followed by their episode's next step: the last one of each
            episode, and the one before steps that a tuple filter left out.
        open_ends: int64, ascending: steps whose next state was not recorded; `next_states` repeats their own state.
        identity: a digest of these steps, independent of how they are read.
    """

    fields: tuple[str, ...]
    layout: StepLayout | None
    episode_lengths: Array
    breaks: Array
    open_ends: Array
    identity: str

    def __len__(self) -> int: ...

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        """Columns of the steps `rows` (int64, any order, repeats allowed), by field.

        A column has the shape (len(rows), ...), is a list if values differ in size, and is nested as the space
        is; the caller may change arrays. Fields are those of `Recording.read`.

        Raises:
            SamplingError: there is no such field.
            SpaceError: one array cannot hold a field of two of the recordings.
        """
        ...

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        """Columns of the steps `start` to `start + length - 1` for each of `starts` (int64), one run after the other.

        The same as `read` for all those len(starts) * length rows; `length` is at least 1.
        """
        ...

    def only(self, parts: Sequence[str]) -> Steps:
        """The same steps with only some parts of the state or the action, as `StepLayout.only` has them.

        Raises:
            SpaceError: there is no such part.
        """
        ...

    def blocks(self, rows: Array) -> Array:
        """The block of the storage of each of `rows`, int64; rows of one block are cheap to read together."""
        ...

    def limit(self, cache_bytes: int, threads: int) -> None:
        """Empties what is kept of steps that were read, and sets its budget and the number of threads that read."""
        ...


class Numbered(Protocol):
    """What an order or a sampler asks of `Items`, where it is documented."""

    source: Steps
    identity: str

    def __len__(self) -> int: ...
    def counts(self) -> Array: ...
    def episode_values(self, expression: F | BaseFilter) -> Array: ...
    def block_runs(self) -> tuple[Array, Array, Array]: ...


class MemorySteps:
    """Steps with some columns in memory; the other fields are read from `rest`.

    A pickled copy, as in a spawned worker, reads all that `rest` has from there: such columns are not sent to other
    processes.

    Args:
        columns: by field; in place of a column, a function that returns its rows (int64) and can be pickled.
    """

    def __init__(self, columns: Mapping[str, Any], rest: Steps) -> None:
        self._columns = dict(columns)
        self._rest = rest
        self._more = {field: column for field, column in columns.items() if field not in rest.fields}
        self.fields = (*rest.fields, *self._more)
        self.layout = rest.layout
        self.episode_lengths, self.breaks = rest.episode_lengths, rest.breaks
        self.open_ends, self.identity = rest.open_ends, rest.identity

    def __len__(self) -> int:
        return len(self._rest)

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        """As `Steps.read`."""
        fields = checked_fields(fields, self.fields)
        missing = [field for field in fields if field not in self._columns]
        found = self._rest.read(missing, rows) if missing else {}
        return {field: found[field] if field in found else self._rows(field, rows) for field in fields}

    def _rows(self, field: str, rows: Array) -> Any:
        column = self._columns[field]
        return column(rows) if callable(column) else own(pick(column, rows))

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        """As `Steps.read_runs`."""
        fields = checked_fields(fields, self.fields)
        missing = [field for field in fields if field not in self._columns]
        found = self._rest.read_runs(missing, starts, length) if missing else {}
        return {
            field: found[field] if field in found else self._runs(field, starts, length) for field in fields
        }

    def _runs(self, field: str, starts: Array, length: int) -> Any:
        column = self._columns[field]
        if callable(column):
            return column(rows_of_runs(starts, length))
        return own(pick_runs(column, starts, length))

    def only(self, parts: Sequence[str]) -> Steps:
        """As `Steps.only`."""
        rest = self._rest.only(parts)
        columns = {
            field: _part_of_column(field, column, rest.layout) for field, column in self._columns.items()
        }
        return MemorySteps(columns, rest)

    def blocks(self, rows: Array) -> Array:
        """As `Steps.blocks`; if columns of `rest` are in memory, any rows near each other."""
        return self._rest.blocks(rows) if len(self._more) == len(self._columns) else rows // _BLOCK

    def limit(self, cache_bytes: int, threads: int) -> None:
        """As `Steps.limit`, of the steps that are not in memory."""
        self._rest.limit(cache_bytes, threads)

    def __reduce__(self) -> tuple[Callable[..., Steps], tuple[Mapping[str, Any], Steps]]:
        return _with, (self._more, self._rest)


def _part_of_column(field: str, column: Any, layout: StepLayout | None) -> Any:
    """Those leaves of a column that a layout has, which is that of the column or has only parts of it."""
    leaves = None if layout is None else field_leaves(field, layout)
    if layout is None or leaves is None or field == "rewards":
        return column
    nest = layout.nest_action if field == "actions" else layout.nest_state
    return nest([leaf.get(column) for leaf in leaves])


def _with(columns: Mapping[str, Any], rest: Steps) -> Steps:
    return MemorySteps(columns, rest) if columns else rest


def checked_fields(fields: Sequence[str], known: Sequence[str] = FIELDS) -> list[str]:
    """The fields as a list; one name becomes a list of one. SamplingError if a field is unknown, or is no text."""
    return field_names(fields, known, SamplingError)


def steps_and_fields(steps: Steps, fields: Sequence[str], known: Sequence[str]) -> tuple[Steps, list[str]]:
    """The steps, with only those parts of states and actions that fields name ("state.arm"), and the columns to read.
    SamplingError if a field is unknown; SpaceError if there is no such part."""
    names, parts = fields_and_parts(fields, known, SamplingError)
    return steps.only(parts) if parts else steps, names


def pick(column: Any, rows: Array) -> Any:
    """Rows of a column, as a copy; values in a list are the same ones: see `own`."""
    if isinstance(column, list):
        return [column[row] for row in rows.tolist()]
    return map_arrays(column, lambda part: part.take(rows, axis=0), lambda part: pick(part, rows))


def pick_runs(column: Any, starts: Array, length: int) -> Any:
    """The rows `start` to `start + length - 1` of a column for each of `starts`, one run after the other, as a copy."""
    return map_arrays(
        column,
        lambda part: _copy_runs(part, starts, length),
        lambda part: pick(part, rows_of_runs(starts, length)),
    )


def own(picked: Any) -> Any:
    """Picked rows of a column that is kept, with copies of the values in lists, so that the caller may change them."""
    return map_arrays(picked, lambda part: part, lambda part: [copy.deepcopy(value) for value in part])


def rows_of_runs(starts: Array, length: int) -> Array:
    """The rows of all runs, one run after the other."""
    rows: Array = starts[:, None] + np.arange(length)
    return rows.reshape(-1)


def _copy_runs(array: Array, starts: Array, length: int) -> Array:
    width = array.strides[0] * length if array.size and array.flags.c_contiguous else 0
    if not 0 < width < _MAX_ITEM:
        return array.take(rows_of_runs(starts, length), axis=0)
    # each run is one item, which NumPy copies at once
    runs = np.ndarray(len(array) - length + 1, f"V{width}", array, 0, array.strides[:1])
    return runs[starts].view(array.dtype).reshape(-1, *array.shape[1:])


_MOST = 1 << 48  # largest count; sums of a few such numbers fit 64 bits


def checked_count(value: object, least: int, what: str, most: int = _MOST) -> int:
    """The value, if it is an integer from `least` to `most`. SamplingError if it is something else."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise SamplingError(f"expected {what} that is an integer from {least}, found {value!r:.80}")
    if value > most:
        raise SamplingError(f"expected {what} of at most {most}, found {value!r:.80}")
    return int(value)


def checked_numbers(value: Any, what: str) -> Array:
    """The value as int64, if it is integers in one dimension. SamplingError if it is something else."""
    try:
        numbers = np.asarray(value)
    except (TypeError, ValueError, OverflowError):  # lists of different lengths, for example
        numbers = np.empty(())
    if numbers.ndim != 1 or (numbers.dtype.kind not in "iu" and len(numbers)):
        raise SamplingError(f"expected {what} in one dimension, found {value!r:.80}")
    if numbers.dtype == np.uint64:
        # large enough to be refused later, and does not become negative
        numbers = np.minimum(numbers, np.uint64(_MOST))
    return numbers.astype(np.int64)
