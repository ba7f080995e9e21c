"""Parsers: columns of steps as the arrays of a library.

A column is an array of shape (steps, ...), a list of one value a step where values differ in size (texts,
graphs), or dicts and tuples of those, nested as the environment's space is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tupli_mcap.errors import MissingExtraError, missing_extra

__all__ = ["BaseTupleParser", "NumpyTupleParser", "TensorflowTupleParser", "TorchTupleParser", "map_columns"]

Columns = tuple[Any, Any, Any, Any, Any]


def map_columns(function: Callable[[Any], Any], column: Any) -> Any:
    """The column with `function` applied to each array in it; lists stay as they are."""
    if isinstance(column, dict):
        return {key: map_columns(function, part) for key, part in column.items()}
    if isinstance(column, tuple):
        return tuple(map_columns(function, part) for part in column)
    return function(column) if isinstance(column, np.ndarray) else column


class BaseTupleParser:
    """To be subclassed: `parse_lists` makes what a library wants out of five columns."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> tuple[Any, ...]:
        """The five columns (states, actions, rewards, terminals, timeouts) in another form.

        The arrays are the parser's own: it may change them.
        """
        raise NotImplementedError(f"{cls.__name__} has no parse_lists")


class NumpyTupleParser(BaseTupleParser):
    """NumPy arrays, in the dtypes that were recorded."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Columns:
        """The five columns, as arrays."""
        return _as_arrays(obs), _as_arrays(act), _as_arrays(rew), _as_arrays(term), _as_arrays(trunc)


class TorchTupleParser(BaseTupleParser):
    """PyTorch tensors on the CPU, of the dtypes that were recorded; they share the arrays' memory."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Columns:
        """The five columns, as tensors.

        Raises:
            MissingExtraError: PyTorch is not installed.
        """
        try:
            import torch  # type: ignore[import-not-found, unused-ignore]
        except ImportError as err:
            raise missing_extra("tensors need PyTorch", "torch") from err
        obs, act, rew, term, trunc = NumpyTupleParser.parse_lists(obs, act, rew, term, trunc)
        return (
            map_columns(torch.from_numpy, obs),
            map_columns(torch.from_numpy, act),
            map_columns(torch.from_numpy, rew),
            map_columns(torch.from_numpy, term),
            map_columns(torch.from_numpy, trunc),
        )


class TensorflowTupleParser(BaseTupleParser):
    """TensorFlow tensors, of the dtypes that were recorded."""

    @classmethod
    def parse_lists(cls, obs: Any, act: Any, rew: Any, term: Any, trunc: Any) -> Columns:
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
        obs, act, rew, term, trunc = NumpyTupleParser.parse_lists(obs, act, rew, term, trunc)
        return (
            map_columns(tf.convert_to_tensor, obs),
            map_columns(tf.convert_to_tensor, act),
            map_columns(tf.convert_to_tensor, rew),
            map_columns(tf.convert_to_tensor, term),
            map_columns(tf.convert_to_tensor, trunc),
        )


def _as_arrays(column: Any) -> Any:
    """Lists of numbers, as subclasses may pass them on, become arrays; values that differ in size stay a
    list."""
    if (
        isinstance(column, list)
        and column
        and isinstance(column[0], bool | int | float | list | np.number | np.bool_)
    ):
        return np.asarray(column)
    return column
