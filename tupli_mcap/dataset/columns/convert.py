"""Columns in the forms of other libraries: D4RL, pandas, batches, and those of parsers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tupli_mcap.arrays import Array, arrays_at, map_arrays
from tupli_mcap.dataset.columns.load import Selected
from tupli_mcap.dataset.columns.tuples import TupleMaker
from tupli_mcap.dataset.items.steps import own, pick
from tupli_mcap.errors import MissingExtraError, missing_extra
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.fields import FIVE

if TYPE_CHECKING:
    import pandas as pd

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
    """Sets the flag in `columns["timeouts"]` of each step that is no terminal and is not followed by its
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
    order: Array | None,
    parser: type[BaseTupleParser] | None,
) -> Iterator[Any]:
    """Batches of `size` steps in the given order of rows: lists of tuples, or the result of `parser`."""
    order = np.arange(len(columns["terminals"])) if order is None else order
    for start in range(0, len(order), size):
        rows = order[start : start + size]
        batch = {field: own(pick(column, rows)) for field, column in columns.items()}
        if parser is None:
            yield list(TupleMaker(batch, layout).all())
        else:
            yield parser.parse_lists(*(batch[name] for name in FIVE))


def import_pandas() -> Any:
    """The module pandas. MissingExtraError if it is not installed."""
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
    """A column for pandas: numbers as an array, everything else as one object for each row."""
    if isinstance(column, np.ndarray) and column.ndim == 1:
        return column
    cells = np.empty(rows, object)
    for i in range(rows):
        cells[i] = arrays_at(column, i)
    return cells


# ---- parsers: columns of steps as the arrays of a library
#
# A column is an array of shape (steps, ...), a list with a value for each step if values differ in size (texts,
# graphs), or dicts and tuples of those, nested as the environment's space is.

Five = tuple[Any, Any, Any, Any, Any]


class BaseTupleParser:
    """Base class of parsers: `parse_lists` turns five columns into the form of a library."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> tuple[Any, ...]:
        """The five columns (states, actions, rewards, terminals, timeouts) in another form.

        The parser may change the arrays.
        """
        raise NotImplementedError(f"{cls.__name__} has no parse_lists")


class NumpyTupleParser(BaseTupleParser):
    """NumPy arrays in the recorded dtypes."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Five:
        """The five columns, as arrays."""
        return _as_arrays(obs), _as_arrays(act), _as_arrays(rew), _as_arrays(term), _as_arrays(trunc)


class TorchTupleParser(BaseTupleParser):
    """PyTorch tensors on the CPU in the recorded dtypes; they share the arrays' memory."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Five:
        """The five columns, as tensors.

        Raises:
            MissingExtraError: PyTorch is not installed.
        """
        try:
            import torch  # type: ignore[import-not-found, unused-ignore]
        except ImportError as err:
            raise missing_extra("tensors need PyTorch", "torch") from err
        return _convert_each(torch.from_numpy, NumpyTupleParser.parse_lists(obs, act, rew, term, trunc))


class TensorflowTupleParser(BaseTupleParser):
    """TensorFlow tensors in the recorded dtypes."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Five:
        """The five columns, as tensors.

        Raises:
            MissingExtraError: TensorFlow is not installed.
        """
        try:
            import tensorflow as tf  # type: ignore[import-not-found, import-untyped, unused-ignore]
        except ImportError as err:
            raise MissingExtraError(
                "tensors need TensorFlow, which is not installed; pip install tensorflow"
            ) from err
        return _convert_each(tf.convert_to_tensor, NumpyTupleParser.parse_lists(obs, act, rew, term, trunc))


def _convert_each(convert: Callable[[Any], Any], columns: Five) -> Five:
    obs, act, rew, term, trunc = (map_arrays(column, convert, list) for column in columns)
    return obs, act, rew, term, trunc


def _as_arrays(column: Any) -> Any:
    """Turns lists of numbers, which subclasses may return, into arrays; values that differ in size stay a list."""
    if (
        isinstance(column, list)
        and column
        and isinstance(column[0], bool | int | float | list | np.number | np.bool_)
    ):
        return np.asarray(column)
    return column
