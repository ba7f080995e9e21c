"""Steps and episodes as objects, made from columns on access."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar, overload

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.images.pictures import Picture
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.episode import item_getter, reward_getter
from tupli_mcap.schema import EpisodeHeader, EpisodeItem, RLTuple

_Kind = TypeVar("_Kind", bound=RLTuple)


class StepTuple(RLTuple):
    """A step as functions of `Dataset.filter_steps` see it: with its picture. Equal to the `RLTuple` of its values."""

    _see: Callable[[], Picture | None]

    @property
    def frame(self) -> Picture | None:
        """The picture of `state`: uint8 (height, width, 3), decoded at each access; None if this step has none.

        Raises:
            MissingExtraError: Pillow is not installed.
        """
        return self._see()

    def __eq__(self, other: object) -> bool:
        return RLTuple.model_construct(**self.__dict__) == other


class Tuples(Sequence[RLTuple]):
    """The steps of some columns as tuples, which are made on access.

    A tuple's state and action have the type of the space's own samples and share memory with the columns; the
    info is empty if none was recorded (or `columns` has no "infos").
    """

    def __init__(
        self, columns: Mapping[str, Any], layout: StepLayout | None, rows: range | None = None
    ) -> None:
        self._columns = columns
        self._layout = layout
        self._rows = range(len(columns["terminals"])) if rows is None else rows
        spaces: tuple[Any, Any, Any] = (None, None, None)
        if layout is not None:
            spaces = layout.observation_space, layout.action_space, layout.reward_space
        self._state = item_getter(spaces[0], columns["states"])
        self._action = item_getter(spaces[1], columns["actions"])
        self._reward = reward_getter(spaces[2], columns["rewards"])
        self._infos = columns.get("infos")

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, i: int | np.integer[Any]) -> RLTuple: ...
    @overload
    def __getitem__(self, i: slice) -> Tuples: ...
    def __getitem__(self, i: int | np.integer[Any] | slice) -> RLTuple | Tuples:
        if isinstance(i, slice):
            return Tuples(self._columns, self._layout, self._rows[i])
        try:
            return self._make(self._rows[i])
        except IndexError as err:
            raise IndexError(f"expected a tuple from 0 to {len(self) - 1}, found {i}") from err

    def __iter__(self) -> Iterator[RLTuple]:
        return map(self._make, self._rows)

    def _make(self, row: int) -> RLTuple:
        return self._filled(RLTuple, row)

    def seen(self, row: int, frame: Callable[[int], Picture | None]) -> StepTuple:
        """A tuple whose `frame` is what the function returns for its row."""
        made = self._filled(StepTuple, row)
        made._see = partial(frame, row)
        return made

    def _filled(self, kind: type[_Kind], row: int) -> _Kind:
        return kind.from_env_step(
            self._state(row),
            self._action(row),
            self._reward(row),
            self._columns["terminals"][row],
            self._columns["timeouts"][row],
            {} if self._infos is None else self._infos[row],
        )

    def __repr__(self) -> str:
        return f"<{len(self)} tuples>"


class EpisodeItems(Sequence[EpisodeItem]):
    """Episodes with their steps, or those of them at the `chosen` positions.

    `columns` returns the columns of all of them, the number of steps of each, and their layout.
    """

    def __init__(
        self,
        headers: Sequence[EpisodeHeader],
        columns: Callable[[], tuple[Mapping[str, Any], Array, StepLayout | None]],
        chosen: range | None = None,
    ) -> None:
        self._headers = headers
        self._columns = columns
        self._chosen = range(len(headers)) if chosen is None else chosen
        self._found: tuple[Tuples, Array] | None = None

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, i: int | np.integer[Any]) -> EpisodeItem: ...
    @overload
    def __getitem__(self, i: slice) -> EpisodeItems: ...
    def __getitem__(self, i: int | np.integer[Any] | slice) -> EpisodeItem | EpisodeItems:
        if isinstance(i, slice):
            return EpisodeItems(self._headers, self._columns, self._chosen[i])
        try:
            place = self._chosen[i]
        except IndexError as err:
            raise IndexError(f"expected an episode from 0 to {len(self) - 1}, found {i}") from err
        if self._found is None:
            columns, lengths, layout = self._columns()
            self._found = Tuples(columns, layout), np.concatenate([[0], np.cumsum(lengths)])
        tuples, ends = self._found
        # Header and steps are valid already.
        return EpisodeItem.model_construct(
            **dict(self._headers[place]), tuples=list(tuples[int(ends[place]) : int(ends[place + 1])])
        )

    def __repr__(self) -> str:
        return f"<{len(self)} episodes>"
