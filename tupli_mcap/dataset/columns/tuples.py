"""Steps and episodes as objects, made from columns on access."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, TypeVar, overload

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.images.pictures import Picture
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.episode import item_getter, reward_getter
from tupli_mcap.schema import EpisodeHeader, EpisodeItem, RLTuple

T = TypeVar("T")
Kind = TypeVar("Kind", bound=RLTuple)


class StepTuple(RLTuple):
    """A step as functions of `Dataset.filter_steps` see it: it answers to the words that their texts have.

    Equal to the `RLTuple` of its values. Its next state and its frame are read while the function runs, not later.
    """

    _maker: StepMaker
    _row: int

    @property
    def step(self) -> int:
        """Its number in the episode, from 0."""
        return int(self._maker.columns["steps"][self._row])

    @property
    def time(self) -> int:
        """The wall clock when it was recorded (ns since 1970)."""
        return int(self._maker.columns["times"][self._row])

    @property
    def next_state(self) -> Any:
        """The state after it; that of the step itself if it is the last one, and the final state is not known."""
        return self._maker.next_state(self._row)

    @property
    def next_observation(self) -> Any:
        """`next_state`."""
        return self.next_state

    @property
    def frame(self) -> Picture | None:
        """The picture of `state`: uint8 (height, width, 3), decoded at each access; None if this step has none.

        Raises:
            MissingExtraError: Pillow is not installed.
        """
        return self._maker.frame(self._row)

    def __eq__(self, other: object) -> bool:
        return RLTuple.model_construct(**self.__dict__) == other


class Made(Sequence[T]):
    """Values that a function makes on access, each of a place; `what` one of them is called."""

    def __init__(self, make: Callable[[int], T], places: range, what: str) -> None:
        self._make, self._places, self._what = make, places, what

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, i: int | np.integer[Any]) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> Made[T]: ...
    def __getitem__(self, i: int | np.integer[Any] | slice) -> T | Made[T]:
        if isinstance(i, slice):
            return Made(self._make, self._places[i], self._what)
        try:
            place = self._places[i]
        except IndexError as err:
            raise IndexError(
                f"expected an index of {self._what}s from 0 to {len(self) - 1}, found {i}"
            ) from err
        return self._make(place)

    def __iter__(self) -> Iterator[T]:
        return map(self._make, self._places)

    def __repr__(self) -> str:
        return f"<{len(self)} {self._what}s>"


class TupleMaker:
    """Makes the step in a row of some columns a tuple.

    Its state and action have the type of the space's own samples and share memory with the columns; the info is empty
    if none was recorded (or `columns` has no "infos").
    """

    def __init__(self, columns: Mapping[str, Any], layout: StepLayout | None) -> None:
        self.columns = columns
        spaces: tuple[Any, Any, Any] = (None, None, None)
        if layout is not None:
            spaces = layout.observation_space, layout.action_space, layout.reward_space
        self._state = item_getter(spaces[0], columns["states"])
        self._action = item_getter(spaces[1], columns["actions"])
        self._reward = reward_getter(spaces[2], columns["rewards"])
        self._infos = columns.get("infos")

    def all(self) -> Made[RLTuple]:
        return Made(self.of_row, range(len(self.columns["terminals"])), "tuple")

    def of_row(self, row: int) -> RLTuple:
        return self._made(RLTuple, row)

    def _made(self, kind: type[Kind], row: int) -> Kind:
        return kind.from_env_step(
            self._state(row),
            self._action(row),
            self._reward(row),
            self.columns["terminals"][row],
            self.columns["timeouts"][row],
            {} if self._infos is None else self._infos[row],
        )


class StepMaker(TupleMaker):
    """Makes the steps that functions see, of columns with "steps" and "times", too.

    Pictures, and the column of next states, are read when a function asks for the first one.

    Args:
        frame: returns the picture of a row; None if it has none.
        after: returns a mapping with the column "next_states".
    """

    def __init__(
        self,
        columns: Mapping[str, Any],
        layout: StepLayout,
        frame: Callable[[int], Picture | None],
        after: Callable[[], Mapping[str, Any]],
    ) -> None:
        super().__init__(columns, layout)
        self.frame = frame
        self._layout, self._after = layout, after

    def step_of_row(self, row: int) -> StepTuple:
        made = self._made(StepTuple, row)
        made._maker, made._row = self, row
        return made

    @cached_property
    def next_state(self) -> Callable[[int], Any]:
        """Returns the state after the step of a row, with the type of the space's own samples."""
        found: Callable[[int], Any] = item_getter(
            self._layout.observation_space, self._after()["next_states"]
        )
        return found


def episode_items(
    headers: Sequence[EpisodeHeader],
    columns: Callable[[], tuple[Mapping[str, Any], Array, StepLayout | None]],
) -> Made[EpisodeItem]:
    """Episodes with their steps. `columns` is called at the first access; it returns the columns of all of them, the
    number of steps of each, and their layout."""

    @cache
    def found() -> tuple[Made[RLTuple], Array]:
        steps, lengths, layout = columns()
        return TupleMaker(steps, layout).all(), np.concatenate([[0], np.cumsum(lengths)])

    def make(place: int) -> EpisodeItem:
        tuples, ends = found()
        own = list(tuples[int(ends[place]) : int(ends[place + 1])])
        return EpisodeItem.model_construct(**dict(headers[place]), tuples=own)  # which are valid already

    return Made(make, range(len(headers)), "episode")
