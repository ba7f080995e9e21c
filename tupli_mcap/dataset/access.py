"""Random access to the steps of a dataset: windows, transitions and delta windows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, TypeVar

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items import (
    DeltaWindows,
    MemorySteps,
    Pad,
    SamplingError,
    Steps,
    Transitions,
    Unit,
    Windows,
)
from tupli_mcap.dataset.items.beside import BESIDE, FRAMES, INFOS, FrameValues, info_columns, info_keys
from tupli_mcap.dataset.items.steps import steps_and_fields
from tupli_mcap.dataset.items.transitions import TRANSITION_FIELDS
from tupli_mcap.errors import SaysWhatIsMeant
from tupli_mcap.recording.columns.fields import FIVE
from tupli_mcap.schema import BaseFilter, EpisodeHeader, F, compile_predicate
from tupli_mcap.schema.facts import path_in
from tupli_mcap.schema.predicate import MISSING, look_up

T = TypeVar("T", Windows, Transitions, DeltaWindows)


class RandomAccess(SaysWhatIsMeant):
    """Items by number of a dataset, or of saved columns. Only requested items are read."""

    @property
    def steps(self) -> Steps:
        """The wanted steps by number, from 0, in the order of the episodes; windows and samplers read them."""
        raise NotImplementedError

    @property
    def _headers(self) -> Sequence[EpisodeHeader]:
        """The episodes of the steps."""
        raise NotImplementedError

    def _step_seconds(self) -> float | None:
        """The time that a step takes (s), if all recordings agree; else None."""
        raise NotImplementedError

    def windows(
        self,
        length: int,
        stride: int = 1,
        pad: Pad = "none",
        history: int = 0,
        *,
        fields: Sequence[str] = FIVE,
    ) -> Windows:
        """Sub-trajectories of `length` steps that never cross episodes, nor steps that a filter left out.

        See `Windows`: an index gives one window, an array of numbers gives a batch. The field "infos" gives a dict of
        columns for all keys of the infos, "info.<key>" for one key, and "info.contact.left" for a value in a dict; they
        are all read into memory. Numbers are arrays, with NaN for steps without such an info; a list if they include
        both integers from 2**53 on and floats or steps without one. The field "frames" gives the recorded pictures of
        the states. "state.arm" or "action.grip", a part of a Dict, leaves the others out of `states` and `next_states`,
        or of `actions`; images that are left out are not read.

        Raises:
            SamplingError: no episode is long enough, or an argument is invalid.
            SpaceError: one array cannot hold a field of two of the recordings, or one of them has no such part.
        """
        steps, fields = self._with_more(fields)
        return self._checked(Windows(steps, length, stride, pad, history, fields=fields))

    def transitions(
        self, n_step: int = 1, discount: float = 1.0, *, fields: Sequence[str] = TRANSITION_FIELDS
    ) -> Transitions:
        """The transition (s, a, r, s') that starts at each step, by its number; an array of numbers gives a batch.

        See `Transitions` for several steps, and `Transition` for targets of values. Fields are those of
        `Transition`; "infos", "info.<key>", "times", "frames" and "state.arm" are as for `windows`.

        Raises:
            SamplingError: the dataset is empty, or an argument is invalid.
            SpaceError: one array cannot hold a field of two of the recordings, or one of them has no such part.
        """
        steps, fields = self._with_more(fields)
        return self._checked(Transitions(steps, n_step, discount, fields=fields))

    def _with_more(self, fields: Sequence[str]) -> tuple[Steps, Sequence[str]]:
        """The steps, with infos and frames if fields name them, and the names of the fields to read."""
        steps = self.steps
        keys, given = info_keys(fields)
        steps, rest = steps_and_fields(steps, given, (*steps.fields, *BESIDE))
        if FRAMES in rest:
            steps = MemorySteps({FRAMES: self._frames()}, steps)
        if not keys:
            return steps, rest
        columns = info_columns(self._infos(), keys if all(keys) else None)
        return MemorySteps({INFOS: columns}, steps), [*rest, INFOS]

    def _infos(self) -> Sequence[Mapping[str, Any]]:
        """The info of each step."""
        raise SamplingError(
            "saved columns hold no infos; open the recordings with tupli_mcap.open, and take windows of that"
        )

    def _frames(self) -> FrameValues:
        """The frame of each step."""
        raise SamplingError(
            "saved columns hold no frames; open the recordings with tupli_mcap.open, and take windows of that"
        )

    def episode_values(self, expression: F | BaseFilter) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The number of each episode at a key, such as `F("metadata.score")`; for a filter, 1 if it is true, else 0:
        float64 (episodes,). Samplers take these as weights.

        Raises:
            SamplingError: an episode has no number there.
            FilterError: the expression names an unknown field.
        """
        return episode_values(self._headers, expression)

    def _values_now(self) -> Callable[[F | BaseFilter], np.ndarray[Any, np.dtype[np.float64]]]:
        """A function like `episode_values` for the episodes as they are listed now, even if they are listed again
        later."""
        return partial(episode_values, self._headers)

    def delta_windows(
        self,
        deltas: Mapping[str, Iterable[float]],
        unit: Unit = "steps",
        *,
        step_seconds: float | None = None,
    ) -> DeltaWindows:
        """The values around each step: `{"state": [-2, -1, 0], "action": range(16)}`, in steps or seconds.

        See `DeltaWindows`. A key may be a part of a Dict: `{"state.arm": [-2, -1, 0], "state.camera": [0]}` reads one
        image of each item, and `item["state.arm"]` is the value of that part. `step_seconds` is by default that in the
        labels of the recordings.

        Raises:
            SamplingError: the dataset is empty, a key is unknown, or the recordings do not agree on the time of a step.
            SpaceError: one array cannot hold the values at a key of two of the recordings, or one of them has no such
                part.
        """
        if unit == "seconds" and step_seconds is None:
            step_seconds = self._step_seconds()
        return self._checked(DeltaWindows(self.steps, deltas, unit, step_seconds=step_seconds))

    def _checked(self, items: T) -> T:
        """The items with their episodes' values; SpaceError now, not at the first batch, if they cannot be read."""
        _ = items[:0]
        return items.of_episodes(self._values_now())


def episode_values(headers: Sequence[EpisodeHeader], expression: F | BaseFilter) -> Array:
    """See `RandomAccess.episode_values`.

    Raises:
        SamplingError: an episode has no number there, or it is no expression.
        FilterError: the expression names an unknown field.
    """
    if isinstance(expression, BaseFilter):
        matches = compile_predicate(expression, EpisodeHeader)
        return np.array([float(matches(header)) for header in headers])
    if not isinstance(expression, F):
        raise SamplingError(f"expected an expression, such as F('metadata.score'), found {expression!r:.80}")
    path = path_in(expression.key, EpisodeHeader)
    return np.array([_number(look_up(header, path), header, expression) for header in headers])


def _number(value: object, header: EpisodeHeader, expression: F) -> float:
    if not isinstance(value, int | float):
        found = "nothing" if value is MISSING else f"{value!r:.80}"
        raise SamplingError(
            f"expected a number as {expression.key} of every episode, found {found} for {header.id}; "
            "leave such episodes out by a filter"
        )
    return float(value)
