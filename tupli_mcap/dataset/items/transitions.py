"""Transitions: state, action, reward, next state; over one step or several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array, arrays_at, map_arrays
from tupli_mcap.dataset.items.beside import BESIDE
from tupli_mcap.dataset.items.items import StepItems
from tupli_mcap.dataset.items.steps import SamplingError, Steps, checked_count, steps_and_fields
from tupli_mcap.recording.columns.fields import GymnasiumNames, Parts

TRANSITION_FIELDS = ("states", "actions", "rewards", "next_states", "terminals", "timeouts")


@dataclass(frozen=True, repr=False)
class Transition(GymnasiumNames, Parts):
    """One transition, or columns of B transitions; columns are nested as the space is, None if not requested.

    Attributes:
        states, actions: of its first step.
        rewards: the reward; over several steps the discounted sum of rewards (float).
        next_states: the state after its last step.
        terminals, timeouts: the flags of its last step (bool).
        discounts: factor of the value of `next_states` (float64): 0 after a terminal, else the discount to the power
            of the number of its steps; so the target is `rewards + discounts * value(next_states)`, at timeouts too.
        mask: False if the state after the last step was not recorded, and matters: `next_states` repeats the last
            recorded state, and the transition is better left out.
        steps: number of its first step among all steps of the dataset (int64).
        episodes: place of its episode in the dataset (int64).
        times: wall clock of its first step (int64, ns).
        infos: of its first step, a dict of columns by key.
        frames: picture of its first step: uint8 (height, width, 3).
    """

    mask: Any
    discounts: Any
    steps: Any
    episodes: Any
    states: Any = None
    actions: Any = None
    rewards: Any = None
    next_states: Any = None
    terminals: Any = None
    timeouts: Any = None
    times: Any = None
    infos: Any = None
    frames: Any = None


class Transitions(StepItems[Transition]):
    """The transition that starts at each step, by the number of the step.

    With `n_step`, a transition has that many steps, or fewer if its episode (or the run of steps that a tuple
    filter leaves) ends before. If the state after an episode's last step was not recorded, the transition ends one step
    earlier.

    Raises:
        SamplingError: an argument is invalid, a field is unknown, or rewards of variable size would be summed.
    """

    def __init__(
        self,
        steps: Steps,
        n_step: int = 1,
        discount: float = 1.0,
        *,
        fields: Sequence[str] = TRANSITION_FIELDS,
    ) -> None:
        super().__init__(steps, (n_step, discount))
        self.n_step = checked_count(n_step, 1, "a number of steps")
        if not isinstance(discount, int | float | np.number) or not 0 <= discount <= 1:
            raise SamplingError(f"expected a discount from 0 to 1, found {discount!r:.80}")
        self.discount = float(discount)
        known = [field for field in steps.fields if field in (*TRANSITION_FIELDS, "times", *BESIDE)]
        self.source, names = steps_and_fields(steps, fields, known)
        self.fields = tuple(names)
        varying = steps.layout is not None and any(leaf.kind == "variable" for leaf in steps.layout.reward)
        if self.n_step > 1 and varying and "rewards" in self.fields:
            raise SamplingError(
                "expected rewards that can be summed, found some of variable size; take n_step=1"
            )

    def _one(self, item: int) -> Transition:
        return Transition(**arrays_at(self._read(np.array([item])), 0))

    def _batch(self, items: Array) -> Transition:
        return Transition(**self._read(items))

    def _read(self, rows: Array) -> dict[str, Any]:
        source = self.source
        found: dict[str, Any] = {}
        last, counts = rows, np.ones(len(rows), np.int64)
        if self.n_step > 1:
            last, counts, found = self._ahead(rows)
        at_end = ("next_states", "terminals", "timeouts")
        first = [name for name in self.fields if name not in (*at_end, *found)]
        ends = list(dict.fromkeys(["terminals", *(name for name in self.fields if name in at_end)]))
        if self.n_step == 1:
            found = source.read([*first, *ends], rows)
        else:
            found |= source.read(first, rows) | source.read(ends, last)
        terminals = found["terminals"]
        unknown = _isin(last, source.open_ends) & ~terminals
        columns = {name: found[name] for name in self.fields}
        return {
            "mask": ~unknown,
            "discounts": np.where(terminals, 0.0, self.discount**counts),
            "steps": rows,
            "episodes": self._episodes(rows),
            **columns,
        }

    def _ahead(self, rows: Array) -> tuple[Array, Array, dict[str, Any]]:
        """The last step of each transition, its number of steps, and its rewards if they are requested."""
        source = self.source
        breaks = source.breaks[source.breaks.searchsorted(rows)]
        ahead = np.arange(min(self.n_step, int((breaks - rows).max(initial=0)) + 1))
        wanted = np.minimum(rows[:, None] + ahead, breaks[:, None])
        names = ["terminals", *(["rewards"] if "rewards" in self.fields else [])]
        columns = source.read(names, wanted.reshape(-1))
        over = columns["terminals"].reshape(wanted.shape)
        earlier = np.cumsum(over, axis=1) - over > 0  # a terminal lies before
        counts = ((rows[:, None] + ahead <= breaks[:, None]) & ~earlier).sum(axis=1)
        last = rows + counts - 1
        over_last = over[np.arange(len(rows)), counts - 1]
        short = (counts > 1) & _isin(last, source.open_ends) & ~over_last
        counts, last = counts - short, last - short
        sums: dict[str, Any] = {}
        if "rewards" in columns:
            weights = np.where(ahead < counts[:, None], self.discount**ahead, 0.0)
            sums["rewards"] = map_arrays(columns["rewards"], lambda part: _sum(part, weights))
        return last, counts, sums

    def __repr__(self) -> str:
        return f"<{len(self)} transitions>"


def _sum(rewards: Array, weights: Array) -> Array:
    """Weighted sums of rewards (B * n, ...) with weights (B, n); floats keep their dtype, others become float64."""
    terms = rewards.reshape(*weights.shape, *rewards.shape[1:])
    shaped = weights.reshape(*weights.shape, *[1] * (terms.ndim - 2))
    sums = np.where(shaped > 0, terms * shaped, 0.0).sum(axis=1)
    summed: Array = sums.astype(rewards.dtype if rewards.dtype.kind == "f" else np.float64)
    return summed


def _isin(rows: Array, ascending: Array) -> Array:
    if not len(ascending):
        return np.zeros(len(rows), np.bool_)
    is_in: Array = ascending[np.minimum(ascending.searchsorted(rows), len(ascending) - 1)] == rows
    return is_in
