"""Steps of materialised columns: rows of arrays that are mapped into memory."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.errors import StorageError
from tupli_mcap.materialized import OpenedColumns, open_columns
from tupli_mcap.materialized.opened import VariableColumn
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.sampling.steps import FIELDS, checked_fields, following, pick, pick_runs, rows_of_runs

__all__ = ["MAPPED_FIELDS", "MappedSteps"]

MAPPED_FIELDS = (*FIELDS, "steps")
_BLOCK = 4096  # steps

Array = np.ndarray[Any, Any]


class _Runs(NamedTuple):
    """`length` rows from each of `starts` on."""

    starts: Array
    length: int

    @property
    def rows(self) -> Array:
        return rows_of_runs(self.starts, self.length)


class MappedSteps:
    """The steps of a directory that `TupliDataset.materialize` has written.

    Whether they are still those of the recordings is not looked at; `materialize` does that. Safe from several threads,
    in forked children, and when it is pickled: a copy in another process maps the same files.

    Args:
        columns: the directory, or what `open_columns` gave of it.

    Raises:
        StorageError: there are no columns, or the system refuses.
        FormatError: they are damaged.
    """

    def __init__(self, columns: OpenedColumns | str | os.PathLike[str]) -> None:
        self.opened = columns if isinstance(columns, OpenedColumns) else _open(Path(columns))
        self.layout: StepLayout | None = self.opened.layout
        self.episode_lengths = self.opened.episode_lengths
        self.breaks = self.opened.breaks
        self.open_ends = self.breaks[~self.opened.next_known]
        self.identity = self.opened.manifest.identity

    def __len__(self) -> int:
        return self.opened.manifest.steps

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        """Columns of some steps, by field, as of any `Steps`; also "steps" (int64, counted from 0 in each episode).

        Raises:
            SamplingError: there is no such field.
        """
        where = following(rows, len(self))
        return {field: self._field(field, where) for field in checked_fields(fields, MAPPED_FIELDS)}

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        """Columns of runs of steps, as of any `Steps`."""
        return {
            field: self._field(field, _Runs(starts, length))
            for field in checked_fields(fields, MAPPED_FIELDS)
        }

    def blocks(self, rows: Array) -> Array:
        """int64: rows of one block are close to each other."""
        return rows // _BLOCK

    def whole(self, field: str) -> Any:
        """The column of all steps: the mapped arrays themselves, read-only, but for `next_states` and values of
        variable size, which are made anew."""
        return self._field(field, None)

    def _field(self, field: str, rows: Array | slice | _Runs | None) -> Any:
        opened, layout = self.opened, self.opened.layout
        if field == "states":
            return layout.nest_state([_taken(opened.leaves[leaf.name], rows) for leaf in layout.state])
        if field == "actions":
            return layout.nest_action([_taken(opened.leaves[leaf.name], rows) for leaf in layout.action])
        if field == "rewards":
            return layout.nest_reward([_taken(opened.leaves[leaf.name], rows) for leaf in layout.reward])
        if field == "next_states":
            return self._next_states(rows.rows if isinstance(rows, _Runs) else rows)
        plain = {
            "terminals": opened.terminal, "timeouts": opened.timeout, "times": opened.time, "steps": opened.step,
        }  # fmt: skip
        return _taken(plain[field], rows)

    def _next_states(self, rows: Array | slice | None) -> Any:
        if rows is None or isinstance(rows, slice):
            rows = np.arange(len(self))[slice(None) if rows is None else rows]
        places = np.searchsorted(self.breaks, rows)
        broken = (
            np.flatnonzero(self.breaks[np.minimum(places, len(self.breaks) - 1)] == rows)
            if len(rows)
            else rows
        )
        after = np.minimum(rows + 1, len(self) - 1)
        return self.opened.layout.nest_state(
            [self._next_leaf(leaf, after, broken, places[broken]) for leaf in self.opened.layout.state]
        )

    def _next_leaf(self, leaf: Leaf, after: Array, broken: Array, places: Array) -> Any:
        column = _taken(self.opened.leaves[leaf.name], after)
        following = _taken(self.opened.next_leaves[leaf.name], places)
        if isinstance(column, list):
            for at, value in zip(broken.tolist(), following, strict=True):
                column[at] = value
        else:
            column[broken] = following
        return column

    def __reduce__(self) -> tuple[Callable[..., MappedSteps], tuple[str, str]]:
        return _opened_again, (str(self.opened.path.absolute()), self.opened.manifest.token)

    def __repr__(self) -> str:
        return f"<MappedSteps {self.opened.path}: {len(self)} steps of {len(self.episode_lengths)} episodes>"


def _taken(column: Any, rows: Array | slice | _Runs | None) -> Any:
    if isinstance(rows, _Runs):
        if isinstance(column, np.ndarray):
            return pick_runs(column, rows.starts, rows.length)
        rows = rows.rows
    if isinstance(column, VariableColumn):
        rows = slice(None) if rows is None else rows
        return column[rows] if isinstance(rows, slice) else column.take(rows.tolist())
    return column if rows is None else pick(column, rows)


def _open(directory: Path) -> OpenedColumns:
    opened = open_columns(directory)
    if opened is None:
        raise StorageError(f"{directory} holds no columns; write them with dataset.materialize(...)")
    return opened


def _opened_again(directory: str, token: str) -> MappedSteps:
    steps = MappedSteps(directory)
    if steps.opened.manifest.token != token:
        raise StorageError(
            f"the columns in {directory} have been written anew since; materialize the dataset again"
        )
    return steps
