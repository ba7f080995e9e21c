"""Steps of a dataset at random: windows, transitions, and what is drawn from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Self

import numpy as np

from tupli_mcap.dataset.query import Query
from tupli_mcap.dataset.weights import episode_values
from tupli_mcap.sampling import DeltaWindows, Pad, Steps, Transitions, Unit, Windows
from tupli_mcap.sampling.items import checked_count
from tupli_mcap.sampling.transitions import TRANSITION_FIELDS
from tupli_mcap.schema import BaseFilter, F

__all__ = ["RandomAccess"]

FIVE = ("states", "actions", "rewards", "terminals", "timeouts")


class RandomAccess:
    """What a dataset gives by number. Only what is asked for is read; see `with_cache` for what is kept."""

    _query: Query

    def _with(self, **filters: Any) -> Self:
        raise NotImplementedError

    @property
    def steps(self) -> Steps:
        """The wanted steps by number, from 0, in the episodes' order: what windows and samplers read from."""
        return self._query.steps()

    def with_cache(self, cache_bytes: int, threads: int | None = None) -> Self:
        """The dataset with another budget (bytes, 512 MiB by default) for what random access keeps in memory.

        Args:
            threads: how many read chunks; by default as many as there are cores, at most 4.

        Raises:
            SamplingError: a number is no integer, or too small.
        """
        made = self._with()
        made._query.cache_bytes = checked_count(cache_bytes, 0, "a budget in bytes")
        if threads is not None:
            made._query.threads = checked_count(threads, 1, "a number of threads")
        return made

    def windows(
        self,
        length: int,
        stride: int = 1,
        pad: Pad = "none",
        history: int = 0,
        *,
        fields: Sequence[str] = FIVE,
    ) -> Windows:
        """Sub-trajectories of `length` steps that never cross episodes, nor the cuts of a tuple filter.

        See `Windows`: an index gives one window, an array of numbers gives a batch of them.

        Raises:
            SamplingError: no episode is long enough, or the arguments mean nothing.
        """
        made = Windows(self.steps, length, stride, pad, history, fields=fields)
        return made.of_episodes(self._values_now())

    def transitions(
        self, n_step: int = 1, discount: float = 1.0, *, fields: Sequence[str] = TRANSITION_FIELDS
    ) -> Transitions:
        """The transition (s, a, r, s') that starts at each step, by its number; an array of numbers gives a batch.

        See `Transitions` for several steps, and `Transition` for what to bootstrap with.

        Raises:
            SamplingError: the dataset is empty, or the arguments mean nothing.
        """
        return Transitions(self.steps, n_step, discount, fields=fields).of_episodes(self._values_now())

    def episode_values(self, expression: F | BaseFilter) -> np.ndarray[Any, np.dtype[np.float64]]:
        """The number that each episode has at a key, such as `F("metadata.score")`; of a filter, 1 where it is true,
        else 0. What samplers take as weights.

        Raises:
            SamplingError: an episode has no number there.
            FilterError: the expression names an unknown field.
        """
        return episode_values(self._query.headers, expression)

    def _values_now(self) -> Callable[[F | BaseFilter], np.ndarray[Any, np.dtype[np.float64]]]:
        """`episode_values` of the episodes as they are listed now, whatever is listed later."""
        return partial(episode_values, self._query.headers)

    def delta_windows(
        self,
        deltas: Mapping[str, Iterable[float]],
        unit: Unit = "steps",
        *,
        step_seconds: float | None = None,
    ) -> DeltaWindows:
        """The values around each step: `{"state": [-2, -1, 0], "action": range(16)}`, in steps or seconds.

        See `DeltaWindows`. `step_seconds` is by default what the recordings say in their labels.

        Raises:
            SamplingError: the dataset is empty, unknown keys, or seconds where the recordings do not say them alike.
        """
        if unit == "seconds" and step_seconds is None:
            step_seconds = self._step_seconds()
        made = DeltaWindows(self.steps, deltas, unit, step_seconds=step_seconds)
        return made.of_episodes(self._values_now())

    def _step_seconds(self) -> float | None:
        """How long a step takes, where all recordings say the same."""
        known = set()
        for name in dict.fromkeys(header.recording for header in self._query.headers):
            with self._query.source.open(name) as recording:
                known.add(recording.labels.step_seconds)
        return known.pop() if len(known) == 1 else None
