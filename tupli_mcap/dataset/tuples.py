"""Steps and episodes as objects, made of columns when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, overload

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.messages.step import StepLayout
from tupli_mcap.schema import RLTuple

__all__ = ["Tuples"]


class Tuples(Sequence[RLTuple]):
    """The steps of some columns, as tuples that are made when they are asked for.

    A tuple's state and action have the type of the space's own samples and share memory with the columns; the
    info is empty where none was recorded (or `columns` has no "infos").
    """

    def __init__(
        self, columns: Mapping[str, Any], layout: StepLayout | None, rows: range | None = None
    ) -> None:
        self._columns = columns
        self._layout = layout
        self._rows = range(len(columns["terminals"])) if rows is None else rows
        self._state = _item(None if layout is None else layout.observation_space, columns["states"])
        self._action = _item(None if layout is None else layout.action_space, columns["actions"])
        self._reward = _reward(columns["rewards"])
        self._infos = columns.get("infos")

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> RLTuple: ...
    @overload
    def __getitem__(self, i: slice) -> Tuples: ...
    def __getitem__(self, i: int | slice) -> RLTuple | Tuples:
        if isinstance(i, slice):
            return Tuples(self._columns, self._layout, self._rows[i])
        try:
            return self._make(self._rows[i])
        except IndexError as err:
            raise IndexError(f"expected a tuple from 0 to {len(self) - 1}, found {i}") from err

    def __iter__(self) -> Iterator[RLTuple]:
        return map(self._make, self._rows)

    def _make(self, row: int) -> RLTuple:
        return RLTuple.from_env_step(
            self._state(row),
            self._action(row),
            self._reward(row),
            self._columns["terminals"][row],
            self._columns["timeouts"][row],
            {} if self._infos is None else self._infos[row],
        )

    def __repr__(self) -> str:
        return f"<{len(self)} tuples>"


def _item(space: gym.Space[Any] | None, column: Any) -> Callable[[int], Any]:
    """A function from a row to its value, of the type the space's own samples have."""
    if isinstance(column, dict):
        inner = space.spaces if isinstance(space, spaces.Dict) else {}
        parts = {key: _item(inner.get(key), part) for key, part in column.items()}
        return lambda i: {key: part(i) for key, part in parts.items()}
    if isinstance(column, tuple):
        given = space.spaces if isinstance(space, spaces.Tuple) else [None] * len(column)
        items = [_item(sub, part) for sub, part in zip(given, column, strict=True)]
        return lambda i: tuple(item(i) for item in items)
    if isinstance(space, spaces.Box) and space.shape == () and column.dtype.kind == "f":
        return lambda i: np.asarray(column[i])  # Gymnasium samples an array here, but a scalar of integers
    return lambda i: column[i]


def _reward(column: Any) -> Callable[[int], Any]:
    if isinstance(column, np.ndarray) and column.ndim == 1:
        return lambda i: column[i].item()
    return _item(None, column)
