"""Compares what an environment returns with what a recording holds, bit for bit.

A value agrees if recording it again would store the same bytes: in the recorded dtype, with the same sign of zero and
payload of NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array, DType
from tupli_mcap.errors import StepError
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Columns
from tupli_mcap.reexecute.reapply import Moment
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.exact import exact_array, leaf_value, shorten
from tupli_mcap.spaces.leaves import Leaf

_BITS = {2: "u2", 4: "u4", 8: "u8"}


class Difference(NamedTuple):
    """A leaf that differs at a step. `path` names the first element that differs; `largest` is the largest absolute
    difference of the elements, None if they are no numbers."""

    step: int
    leaf: str
    path: str
    expected: str
    found: str
    largest: float | None


@dataclass
class Tally:
    """The differences of one episode: the first one, the number of differing steps, and the largest difference of the
    leaf that differed first. The final state, which the last step leads to, is counted with it."""

    length: int  # steps of the episode
    first: Difference | None = None
    steps: int = 0
    largest: float | None = None
    largest_step: int = 0
    unmeasured: bool = False  # whether that leaf has a difference that is no number
    ended: int | None = None  # the step at which the environment ended before the recording did
    _last: int = field(default=-1, repr=False)

    def note(self, difference: Difference) -> None:
        """Adds a difference. Call it in the order of the steps."""
        if self.first is None:
            self.first = difference
        step = min(difference.step, self.length - 1)
        if step != self._last:
            self._last = step
            self.steps += 1
        if difference.leaf != self.first.leaf:
            return
        if difference.largest is None:
            self.unmeasured = True
        elif self.largest is None or difference.largest > self.largest:
            self.largest, self.largest_step = difference.largest, difference.step


class Checker:
    """Compares moments with the columns of a recording.

    casts: whether values were cast to the dtype of the space before they were recorded, as vector environments do; and
    rewards to float32, as `DummyVecEnv` of Stable-Baselines3 does, which a recording does not say.
    """

    def __init__(self, layout: StepLayout, *, casts: bool) -> None:
        self._layout = layout
        self._casts = casts
        self._start = 0
        self._states: list[tuple[Leaf, Any]] = []
        self._rewards: list[tuple[Leaf, Any]] = []
        self._flags: tuple[list[bool], list[bool]] = ([], [])

    def bind(self, columns: Columns, start: int) -> None:
        """Sets the columns to compare with; their first row is step `start`."""
        self._start = start
        self._states = [(leaf, leaf.get(columns.states)) for leaf in self._layout.state]
        self._rewards = [(leaf, leaf.get(columns.rewards)) for leaf in self._layout.reward]
        self._flags = (columns.terminals.tolist(), columns.timeouts.tolist())

    def state(self, step: int, state: Any, tally: Tally) -> None:
        i = step - self._start
        self._compare(step, state, ((leaf, column[i]) for leaf, column in self._states), tally)

    def result(self, step: int, moment: Moment, tally: Tally) -> bool:
        """Compares reward and flags of a step; True if the flags agree."""
        i = step - self._start
        rewards = ((leaf, column[i]) for leaf, column in self._rewards)
        self._compare(step, moment.reward, rewards, tally, are_rewards=True)
        terminals, timeouts = self._flags
        agree = True
        for name, given, recorded in (
            ("terminal", moment.terminal, terminals[i]),
            ("timeout", moment.timeout, timeouts[i]),
        ):
            if (found := bool(given)) != recorded:
                tally.note(Difference(step, name, name, str(recorded), str(found), None))
                agree = False
        return agree

    def final_state(self, step: int, recorded: Any, state: Any, tally: Tally) -> None:
        self._compare(step, state, ((leaf, leaf.get(recorded)) for leaf in self._layout.state), tally)

    def _compare(
        self,
        step: int,
        value: Any,
        leaves: Iterable[tuple[Leaf, Any]],
        tally: Tally,
        *,
        are_rewards: bool = False,
    ) -> None:
        """Compares a value with the recorded one of each leaf."""
        for leaf, recorded in leaves:
            try:
                found = leaf_value(value, leaf) if leaf.keys else value
                agrees = self._agrees(leaf, recorded, found)
                if (
                    not agrees
                    and are_rewards
                    and self._casts
                    and self._layout.dtypes.get(leaf.name) == np.float64
                ):
                    agrees = self._agrees(leaf, recorded, self._stored(leaf, np.dtype(np.float32), found))
            except StepError as err:
                tally.note(Difference(step, leaf.name, leaf.path, shorten(recorded), str(err), None))
                continue
            if not agrees:
                tally.note(self._difference(step, leaf, recorded, found))

    def _agrees(self, leaf: Leaf, recorded: Any, value: Any) -> bool:
        if leaf.kind == "variable":
            encoded = self._layout.variable[leaf.name].encoded
            return encoded(value) == encoded(recorded)
        stored = self._stored(leaf, self._layout.dtypes[leaf.name], value)
        return bool(stored.tobytes() == recorded.tobytes())

    def _stored(self, leaf: Leaf, dtype: DType, value: Any) -> Array:
        """The value as a recorder stores it. StepError if it cannot be recorded."""
        if self._casts:
            array = np.asarray(value)
            if array.shape == leaf.shape and np.can_cast(array.dtype, dtype, "same_kind"):
                with np.errstate(all="ignore"):
                    return array.astype(dtype)
        return exact_array(value, dtype, leaf.shape, leaf.path)

    def _difference(self, step: int, leaf: Leaf, expected: Any, found: Any) -> Difference:
        if leaf.kind == "variable":
            return Difference(step, leaf.name, leaf.path, shorten(expected), shorten(found), None)
        dtype = self._layout.dtypes[leaf.name]
        expected = np.asarray(expected, dtype).reshape(leaf.shape)
        array = self._stored(leaf, dtype, found)
        differs = np.asarray(_bits(expected) != _bits(array))
        first = tuple(int(i) for i in np.argwhere(differs)[0])
        path = name_within(leaf.path, first) if first else leaf.path
        recorded, rerun = _text(expected[first]), _text(array[first])
        return Difference(step, leaf.name, path, recorded, rerun, _largest(expected[differs], array[differs]))


def _bits(array: Any) -> Any:
    """The bits of a float array as integers; other arrays as they are."""
    array = np.asarray(array, order="C")
    return array.view(_BITS[array.itemsize]) if array.dtype.kind == "f" else array


def _text(value: Any) -> str:
    text = str(value.item() if value.dtype.kind in "biu" else value)
    return f"{text} (bits 0x{int(_bits(value).item()):x})" if text == "nan" else text


def _largest(expected: Any, found: Any) -> float | None:
    """The largest absolute difference; None unless it is a finite number."""
    if expected.dtype.kind in "iu" and expected.dtype.itemsize == 8:
        pairs = zip(expected.tolist(), found.tolist(), strict=True)
        return float(max((abs(a - b) for a, b in pairs), default=0))
    with np.errstate(all="ignore"):
        largest = float(np.max(np.abs(found.astype(np.float64) - expected.astype(np.float64)), initial=0.0))
    return largest if math.isfinite(largest) else None
