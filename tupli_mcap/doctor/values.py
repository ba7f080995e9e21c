"""Checks of values: NaN, infinities, values outside of their space, dimensions that never change, unused actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Severity, dimension_text, dimensions
from tupli_mcap.doctor.measurements import Measurements, Statistic, StepPlace, value_bytes
from tupli_mcap.errors import plural
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.blocks import Block
from tupli_mcap.recording.describe.description import describe_space
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.spaces.statistics import ElementStatistics, columns_of

Locate = Callable[[int], StepPlace]
Role = Literal["state", "action", "reward"]
_KINDS = ("nan", "infinite", "outside")
_ROUNDING = 8  # so many units in the last place outside of the space are a rounding error
_NAMED = 8  # most choices that a message names


class LeafValues(Statistic):
    """Counts bad values of a leaf, in steps and final states.

    seen: the number of values. counts: for each of `_KINDS`, how many values of each element are bad (int64, C order);
    a value of variable size is one element. places: the first of each kind. of_elements: further statistics, only for
    a leaf of constant size.
    """

    of_elements: ElementStatistics | None = None

    def __init__(self, leaf: Leaf, role: Role) -> None:
        self.leaf = leaf
        self.role = role
        self.seen = 0
        self.counts = {kind: np.zeros(leaf.size, np.int64) for kind in _KINDS}
        self.places: dict[str, list[StepPlace]] = {kind: [] for kind in _KINDS}

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[LeafValues]:
        roles: tuple[Role, ...] = ("state", "action", "reward")
        return [
            (_VariableValues if leaf.kind == "variable" else _ArrayValues)(leaf, role, measured.layout)
            for role in roles
            for leaf in getattr(measured.layout, role)
        ]

    def put(self, block: Block) -> None:
        name = self.leaf.name
        self._add(block.leaves[name], block.place)
        if name in block.finals:
            self._add(block.finals[name], partial(_final_place, block))

    @property
    def constant(self) -> Array:
        """Whether each element had only one finite value (bool), although the space allows others."""
        raise NotImplementedError

    def _add(self, values: Any, locate: Locate) -> None:
        """Add values; `locate(i)` gives the place of value i."""
        raise NotImplementedError

    def _note(self, kind: str, bad: Array, locate: Locate) -> None:
        """Notes the first places. `bad[element, i]`: whether that element of value i is of this kind."""
        missing = MAX_PLACES - len(self.places[kind])
        if missing:
            self.places[kind] += [locate(int(i)) for i in np.flatnonzero(bad.any(axis=0))[:missing]]


def _final_place(block: Block, i: int) -> StepPlace:
    row = block.rows[block.finals_of[i]]
    return int(row["episode"]), int(row["length"])


class _ArrayValues(LeafValues):
    """A leaf of constant size."""

    of_elements: ElementStatistics

    def __init__(self, leaf: Leaf, role: Role, layout: StepLayout) -> None:
        super().__init__(leaf, role)
        self.of_elements = found = ElementStatistics(leaf, layout.dtypes[leaf.name], moments=False)
        self.counts |= {"nan": found.nan, "infinite": found.infinite}
        self._lowest, self._highest = found.low, found.high
        if leaf.dtype is not None and leaf.dtype.kind == "f":
            ends = (found.low, found.high)
            sizes = [np.where(np.isfinite(b), np.abs(b.astype(np.float64)), 0) for b in ends]
            slack = _ROUNDING * float(np.finfo(leaf.dtype).eps) * np.maximum(*sizes)
            self._lowest, self._highest = found.low - slack, found.high + slack

    @property
    def constant(self) -> Array:
        found = self.of_elements
        constant: Array = (
            (found.finite == found.seen) & (found.least == found.most) & (found.low < found.high)
        )
        return constant

    def _add(self, values: Any, locate: Locate) -> None:
        self.seen += len(values)
        if not self.leaf.size:
            return
        elements, columns = self.of_elements, columns_of(values)
        before = elements.finite.sum() - elements.seen * self.leaf.size
        elements.add(columns)
        if elements.finite.sum() - elements.seen * self.leaf.size != before:
            self._note("nan", np.isnan(columns), locate)
            self._note("infinite", np.isinf(columns), locate)
        if (elements.least < elements.low).any() or (elements.most > elements.high).any():
            with np.errstate(invalid="ignore"):  # signalling NaN
                outside = (columns < self._lowest[:, None]) | (columns > self._highest[:, None])
            outside &= np.isfinite(columns)
            self.counts["outside"] += outside.sum(axis=1)
            self._note("outside", outside, locate)


class _VariableValues(LeafValues):
    """A leaf of variable size."""

    def __init__(self, leaf: Leaf, role: Role, layout: StepLayout) -> None:
        super().__init__(leaf, role)
        self._layout = layout
        # If values were recorded in wider dtypes than the space declares, no value is in the space.
        self._in_space = leaf.name not in layout.inner_dtypes
        self._first: bytes | None = None
        self._changes = False

    @property
    def constant(self) -> Array:
        return np.array([not self._changes])

    def _add(self, values: Any, locate: Locate) -> None:
        self.seen += len(values)
        bad = {kind: np.zeros((1, len(values)), np.bool_) for kind in _KINDS}
        for i, value in enumerate(values):
            bad["outside"][0, i] = self._in_space and not self.leaf.space.contains(value)
            for array in _floats(value):
                bad["nan"][0, i] |= np.isnan(array).any()
                bad["infinite"][0, i] |= np.isinf(array).any()
            if not self._changes:
                encoded = value_bytes(self._layout, self.leaf, value)
                self._first = encoded if self._first is None else self._first
                self._changes = encoded != self._first
        for kind, flags in bad.items():
            self.counts[kind] += flags.sum(axis=1)
            self._note(kind, flags, locate)


def _floats(value: Any) -> Iterator[Array]:
    """The arrays of floats in a nested value."""
    if isinstance(value, dict | tuple | list):  # a GraphInstance is a tuple, too
        for part in value.values() if isinstance(value, dict) else value:
            yield from _floats(part)
    elif isinstance(value, np.ndarray | np.generic | float) and np.asarray(value).dtype.kind == "f":
        yield np.asarray(value)


def nan(measured: Measurements) -> Iterator[Finding]:
    """NaN in a state, a final state, an action or a reward. A single NaN in a batch makes all weights NaN."""
    advice = "drop these episodes, and find the division or sensor that made NaN"
    yield from _not_finite(measured, "nan", "nan", "NaN", advice)


def infinity(measured: Measurements) -> Iterator[Finding]:
    """An infinite state, final state, action or reward."""
    advice = "clip the values, or drop these episodes: they make means and normalisation infinite"
    yield from _not_finite(measured, "infinity", "infinite", "infinite", advice)


def _not_finite(measured: Measurements, check: str, kind: str, word: str, advice: str) -> Iterator[Finding]:
    for values in measured.statistics(LeafValues):
        mask = values.counts[kind] > 0
        part = " in part" if values.leaf.kind == "variable" else dimension_text(values.leaf, mask)
        if mask.any():
            yield _bad_values(measured, values, check, kind, Severity.ERROR, word + part, advice)


def outside_space(measured: Measurements) -> Iterator[Finding]:
    """Values outside of their space: bounds of a Box, choices of a Discrete, letters of a Text, ...

    An error for spaces of choices: an index out of range crashes an embedding. A warning for a Text, in which Gymnasium
    takes only letters and digits by default, and for a Box: learners that scale by its bounds get wrong values. Up to 8
    units in the last place of the larger bound count as a rounding error. Infinite values and NaN have checks of their
    own.
    """
    for values in measured.statistics(LeafValues):
        leaf, mask = values.leaf, values.counts["outside"] > 0
        if not mask.any():
            continue
        what, elements = f"outside of {describe_space(leaf.space):.80}", values.of_elements
        if elements is not None:
            least, most = elements.least[mask].min(), elements.most[mask].max()
            low, high = elements.low[mask].min(), elements.high[mask].max()
            what = (
                f"outside the space{dimension_text(leaf, mask)}: they reach from {least:g} to {most:g}, "
                f"the space from {low:g} to {high:g}"
            )
        severity = Severity.WARNING
        if isinstance(leaf.space, spaces.Text):
            advice = "give the space the length and the characters of the texts: Text(200, charset=string.printable)"
        elif not isinstance(leaf.space, spaces.Box):
            severity = Severity.ERROR
            advice = "correct the space, or what the environment returns; an index out of range crashes an embedding"
        elif values.role == "action":
            advice = "clip actions before env.step, so that the recorded action is the one that was taken"
        else:
            advice = "widen the bounds of the space, or clip what the environment returns"
        yield _bad_values(measured, values, "outside-space", "outside", severity, what, advice)


def _bad_values(
    measured: Measurements,
    values: LeafValues,
    check: str,
    kind: str,
    severity: Severity,
    what: str,
    advice: str,
) -> Finding:
    """A finding that so many values are `what`."""
    counts = values.counts[kind]
    count, total = int(counts.sum()), values.seen * len(counts)
    message = f"{count:,} of {total:,} values are {what}"
    places = measured.places(values.places[kind])
    return measured.finding(check, severity, message, advice, count, total, places, values.leaf, counts > 0)


def constant_dimension(measured: Measurements, *, min_steps: int = 100) -> Iterator[Finding]:
    """Dimensions of states and of continuous actions that never change, judged from `min_steps` steps on.

    A warning if a whole leaf never changes, or a dimension of floats: normalising would divide by a standard deviation
    of 0. An info for some of many integers. Not judged are dimensions whose Box allows one value only, single pixels,
    and discrete actions (see "unused-action").
    """
    if measured.steps < min_steps:
        return
    for values in measured.statistics(LeafValues):
        leaf, mask, elements = values.leaf, values.constant, values.of_elements
        count, whole = int(mask.sum()), bool(mask.all())
        of_choices = values.role == "action" and not isinstance(leaf.space, spaces.Box)
        if values.role == "reward" or of_choices or not count or (leaf.apart and not whole):
            continue
        if whole:
            message = f"all {values.seen:,} {'frames' if leaf.apart else 'values'} are the same"
            advice = "check whether this sensor, camera or actuator works; leave it out of training"
        else:
            what = (
                "never change" if elements is None or count > 1 else f"is always {elements.least[mask][0]:g}"
            )
            message = f"{dimensions(leaf, mask)} {what} in {values.seen:,} values"
            advice = "leave it out of training, or do not divide by its standard deviation of 0"
        floats = elements is not None and elements.dtype.kind == "f"
        severity = Severity.WARNING if whole or floats else Severity.INFO
        yield measured.finding(
            "constant-dimension", severity, message, advice, count, leaf.size, (), leaf, mask
        )


def unused_action(measured: Measurements, *, steps_each: int = 20) -> Iterator[Finding]:
    """Choices of a Discrete, MultiDiscrete or MultiBinary action that never occur.

    Judged from `steps_each` steps per choice on: a uniform policy then misses a choice with a probability below e^-20.
    """
    for values in measured.statistics(LeafValues):
        elements = values.of_elements
        if elements is None or values.role != "action":
            continue
        for i, counts in enumerate(elements.choices):
            unused = np.flatnonzero(counts == 0)
            if not len(unused) or values.seen < steps_each * len(counts):
                continue
            leaf, element = values.leaf, np.arange(values.leaf.size) == i
            names = ", ".join(str(int(elements.low[i]) + int(choice)) for choice in unused[:_NAMED])
            count, total = len(unused), len(counts)
            message = (
                f"{count:,} of {total:,} choices{dimension_text(leaf, element)} never "
                f"{'occurs' if count == 1 else 'occur'} in {plural(values.seen, 'step')}: {names}"
                f"{', ...' if count > _NAMED else ''}"
            )
            advice = "a policy learns nothing about these: record with more exploration, or mask them"
            yield measured.finding(
                "unused-action", Severity.WARNING, message, advice, count, total, (), leaf, element
            )
