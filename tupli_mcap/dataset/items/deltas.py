"""Delta windows: for each step, the values some steps or seconds before and after it."""

from __future__ import annotations

import functools
import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.items import StepItems
from tupli_mcap.dataset.items.steps import FIELDS, SamplingError, Steps, steps_and_fields
from tupli_mcap.dataset.items.windows import shaped_rows
from tupli_mcap.errors import did_you_mean
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.recording.columns.fields import (
    FIELD_OF,
    ColumnDict,
    Parts,
    fields_and_parts,
    split_name,
    step_name,
)
from tupli_mcap.spaces.leaves import keys_to

Unit = Literal["steps", "seconds", "clock"]
UNITS = ("steps", "seconds", "clock")
KEYS = tuple(map(step_name, FIELDS))
_CLOSEST = 1e-4  # seconds by which a delta may miss a step
_FARTHEST = 1 << 48  # steps: beyond every episode
_LONGEST = 1e9  # seconds, 31 years: beyond every episode


@dataclass(frozen=True, repr=False)
class DeltaWindow(Parts):
    """Values around one step, or around B steps, by key ("state", "action.grip", …). `window["state"]` is
    `window.values["state"]`; `window["action.grip"]` is the value of that part alone.

    Attributes:
        values: by key, a column of shape (K, ...), or (B, K, ...), where K is the number of the key's deltas; nested as
            the space is; lists if values differ in size.
        masks: by key, bool (B, K): False if the episode has no such step, and the value is that of the nearest one.
        steps: number of the step among all steps of the dataset, int64 (B,).
        episodes: place of its episode in the dataset, int64 (B,).
    """

    values: dict[str, Any]
    masks: dict[str, Array]
    steps: Any
    episodes: Any

    def __getitem__(self, key: str) -> Any:
        return ColumnDict(self.values)[key]


class DeltaWindows(StepItems[DeltaWindow]):
    """The values around each step, by the number of the step, like LeRobot's delta_timestamps.

    Values come from the step's own episode, and from between the cuts of a tuple filter.

    Args:
        deltas: by key ("state", "action", "reward", "terminal", "timeout", "next_state", "time", the name of the
            column, or a part of a Dict, such as "state.arm"), the distances from the step:
            `{"state.arm": [-2, -1, 0], "state.camera": [0], "action": range(16)}`.
        unit: "steps"; "seconds", where each step takes `step_seconds`; or "clock", seconds by the recorded times: the
            step with the nearest time is taken.
        step_seconds: time that a step takes (s).

    Raises:
        SamplingError: a key is unknown; a delta is no number, or no whole number of steps (seconds: within 0.1 ms); or
            the time of a step is not known.
        SpaceError: there is no such part.
    """

    def __init__(
        self,
        steps: Steps,
        deltas: Mapping[str, Iterable[float]],
        unit: Unit = "steps",
        *,
        step_seconds: float | None = None,
    ) -> None:
        if unit not in UNITS:
            raise SamplingError(
                f"expected unit to be one of {', '.join(map(repr, UNITS))}, found {unit!r:.80}"
            )
        given = {key: _numbers(key, values) for key, values in _checked_keys(deltas).items()}
        super().__init__(steps, (unit, step_seconds, {key: values.tolist() for key, values in given.items()}))
        self.unit = unit
        self.deltas = given if unit == "clock" else _in_steps(given, unit, step_seconds)
        self._lasts = steps.breaks
        self._firsts = np.concatenate([[0], self._lasts[:-1] + 1])
        self.source = _with_parts(steps, list(given))
        alike: dict[bytes, list[str]] = {}
        for key, values in self.deltas.items():
            alike.setdefault(values.tobytes(), []).append(key)
        self._together = [_Together.of(steps, self.deltas[keys[0]], keys) for keys in alike.values()]

    def limit(self, cache_bytes: int, threads: int) -> None:
        sources = {id(source): source for source in (self.source, *(one.source for one in self._together))}
        for source in sources.values():
            source.limit(cache_bytes // len(sources), threads)

    def _one(self, item: int) -> DeltaWindow:
        return self._read(np.array([item]), single=True)

    def _batch(self, items: Array) -> DeltaWindow:
        return self._read(items, single=False)

    def _read(self, steps: Array, *, single: bool) -> DeltaWindow:
        pieces = self._lasts.searchsorted(steps)
        firsts, lasts = self._firsts[pieces], self._lasts[pieces]
        values: dict[str, Any] = {}
        masks: dict[str, Array] = {}
        for together in self._together:
            rows, mask = self._rows(steps, together.deltas, firsts, lasts)
            for key, column in together.read(rows.reshape(-1)).items():
                values[key] = column if single else shaped_rows(column, rows.shape)
                masks[key] = mask[0] if single else mask
        episodes = self._episodes(steps)
        ordered = {key: values[key] for key in self.deltas}
        return DeltaWindow(ordered, masks, *((steps[0], episodes[0]) if single else (steps, episodes)))

    def _rows(self, steps: Array, deltas: Array, firsts: Array, lasts: Array) -> tuple[Array, Array]:
        """The step of each delta, shape (B, K), and whether it exists."""
        if self.unit == "clock":
            return self._nearest(steps, deltas, firsts, lasts)
        wanted = steps[:, None] + deltas
        rows = np.clip(wanted, firsts[:, None], lasts[:, None])
        return rows, rows == wanted

    def _nearest(self, steps: Array, deltas: Array, firsts: Array, lasts: Array) -> tuple[Array, Array]:
        """The steps with the nearest times, found by bisection: times grow within an episode."""
        shape = (len(steps), len(deltas))
        target = self._times(steps)[:, None] + np.round(deltas.clip(-_LONGEST, _LONGEST) * 1e9).astype(
            np.int64
        )
        low, high = (np.broadcast_to(ends[:, None], shape).copy() for ends in (firsts, lasts))
        slack = round(_CLOSEST * 1e9)
        mask = (target >= self._times(low) - slack) & (target <= self._times(high) + slack)
        while (low < high).any():  # the last step not after the target, or the first one of all
            middle = (low + high + 1) // 2
            before = self._times(middle) <= target
            low, high = np.where(before, middle, low), np.where(before, high, np.maximum(middle - 1, low))
        after = np.minimum(low + 1, lasts[:, None])
        nearer = np.abs(self._times(after) - target) < np.abs(self._times(low) - target)
        return np.where(nearer, after, low), mask

    def _times(self, rows: Array) -> Array:
        found: Array = self.source.read(["times"], rows.reshape(-1))["times"]
        return found.reshape(rows.shape)

    def __repr__(self) -> str:
        return f"<{len(self)} delta windows of {', '.join(self.deltas)}>"


class _Together(NamedTuple):
    """Keys with the same deltas, which are read at once: no image that belongs only to other keys."""

    deltas: Array
    source: Steps
    places: dict[str, tuple[str, tuple[Any, ...]]]  # key -> column, and the keys that lead to a part of it

    @classmethod
    def of(cls, steps: Steps, deltas: Array, keys: Sequence[str]) -> _Together:
        source, places = _with_parts(steps, keys), {}
        for key in keys:
            (field,), parts = fields_and_parts(key, FIELDS, SamplingError)
            leaves = [] if source.layout is None else field_leaves(field, source.layout) or []
            places[key] = field, keys_to(parts[0], leaves) if parts else ()
        return cls(deltas, source, places)

    def read(self, rows: Array) -> dict[str, Any]:
        columns = self.source.read(list(dict.fromkeys(field for field, _ in self.places.values())), rows)
        return {
            key: functools.reduce(operator.getitem, inside, columns[field])
            for key, (field, inside) in self.places.items()
        }


def _with_parts(steps: Steps, keys: Sequence[str]) -> Steps:
    """The steps with only those parts of states and actions that keys name. Next states have the parts of states."""
    named = [split_name(key) for key in keys]
    fields = [f"{FIELD_OF[word].removeprefix('next_')}{part}" for word, part in named]
    return steps_and_fields(steps, fields, FIELDS)[0]


def _checked_keys(deltas: Mapping[str, Iterable[float]]) -> Mapping[str, Iterable[float]]:
    if not isinstance(deltas, Mapping) or not deltas:
        raise SamplingError(f"expected deltas such as {{'state': [-1, 0]}}, found {deltas!r:.80}")
    unknown = [key for key in deltas if FIELD_OF.get(split_name(str(key))[0]) not in FIELDS]
    if unknown:
        found = f"{', '.join(map(repr, unknown))}{did_you_mean(unknown[0], KEYS)}"
        raise SamplingError(f"expected deltas of {', '.join(KEYS)}, found {found}")
    for key in deltas:
        fields_and_parts(key, FIELDS, SamplingError)
    return deltas


def _numbers(key: str, deltas: Iterable[float]) -> Array:
    try:
        numbers = np.array(list(deltas))
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if (
        numbers.ndim != 1
        or not len(numbers)
        or numbers.dtype.kind not in "iuf"
        or not np.isfinite(numbers).all()
    ):
        raise SamplingError(f"expected numbers, at least one, as deltas of {key!r}, found {deltas!r:.80}")
    return numbers


def _in_steps(given: Mapping[str, Array], unit: str, step_seconds: float | None) -> dict[str, Array]:
    """The deltas as numbers of steps (int64)."""
    scale: float = 1
    if unit == "seconds":
        if not isinstance(step_seconds, int | float | np.number) or not 0 < step_seconds < np.inf:
            raise SamplingError(
                f"expected a known time of a step, found {step_seconds!r}; give step_seconds=, or take unit='clock' "
                "for the recorded times"
            )
        scale = step_seconds
    in_steps = {}
    for key, deltas in given.items():
        steps = np.round(deltas / scale)
        away = np.abs(steps * scale - deltas)
        if (away > (0 if unit == "steps" else _CLOSEST)).any():
            wrong = deltas[np.argmax(away)]
            raise SamplingError(
                f"expected deltas of {key!r} that are whole steps{f' of {scale} s' if unit == 'seconds' else ''}, "
                f"found {wrong}"
            )
        in_steps[key] = steps.clip(-_FARTHEST, _FARTHEST).astype(np.int64)
    return in_steps
