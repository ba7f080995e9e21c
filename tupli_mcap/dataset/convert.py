"""Columns as what other libraries expect."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tupli_mcap.dataset.columns import pick
from tupli_mcap.dataset.loading import Selected
from tupli_mcap.dataset.parsers import BaseTupleParser
from tupli_mcap.dataset.tuples import Tuples
from tupli_mcap.errors import missing_extra
from tupli_mcap.messages.step import StepLayout

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["D4RL_NAMES", "batches", "dataframe", "import_pandas", "mark_cuts"]

D4RL_NAMES: Mapping[str, str] = {
    "observations": "states",
    "actions": "actions",
    "next_observations": "next_states",
    "rewards": "rewards",
    "terminals": "terminals",
    "timeouts": "timeouts",
}
"""D4RL's name for each field."""


def mark_cuts(columns: dict[str, Any], selected: Selected) -> None:
    """Sets, in `columns["timeouts"]`, the timeout of each step that is no terminal and not followed by its
    episode's next step."""
    timeouts = columns["timeouts"]
    if not len(timeouts):
        return
    cut = np.zeros(len(timeouts), np.bool_)
    cut[np.cumsum(selected.lengths[selected.lengths > 0]) - 1] = True
    if selected.mask is not None:
        cut[:-1] |= np.diff(np.flatnonzero(selected.mask)) > 1
    timeouts |= cut & ~columns["terminals"]


def batches(
    columns: Mapping[str, Any],
    layout: StepLayout | None,
    size: int,
    order: np.ndarray[Any, Any] | None,
    parser: type[BaseTupleParser] | None,
) -> Iterator[Any]:
    """Batches of `size` steps in the given order of rows: lists of tuples, or what `parser` makes of
    columns."""
    total = len(columns["terminals"])
    for start in range(0, total, size):
        rows: Any = slice(start, min(start + size, total)) if order is None else order[start : start + size]
        batch = {field: pick(column, rows) for field, column in columns.items()}
        if parser is None:
            yield list(Tuples(batch, layout))
        else:
            names = ("states", "actions", "rewards", "terminals", "timeouts")
            yield parser.parse_lists(*(batch[name] for name in names))


def import_pandas() -> Any:
    """The module.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import pandas
    except ImportError as err:
        raise missing_extra("a DataFrame needs pandas", "pandas") from err
    return pandas


def dataframe(columns: Mapping[str, Any], selected: Selected) -> pd.DataFrame:
    """A DataFrame of the D4RL columns, led by episode (int64) and step (int64)."""
    episodes = np.repeat(np.arange(len(selected.lengths)), selected.lengths)
    cells = {name: _cells(columns[field], len(episodes)) for name, field in D4RL_NAMES.items()}
    frame: pd.DataFrame = import_pandas().DataFrame({"episode": episodes, "step": columns["steps"], **cells})
    return frame


def _cells(column: Any, rows: int) -> Any:
    """A column as pandas can hold it: numbers as an array, everything else an object a row."""
    if isinstance(column, np.ndarray) and column.ndim == 1:
        return column
    cells = np.empty(rows, object)
    for i in range(rows):
        cells[i] = _value(column, i)
    return cells


def _value(column: Any, row: int) -> Any:
    if isinstance(column, dict):
        return {key: _value(part, row) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(_value(part, row) for part in column)
    return column[row]
