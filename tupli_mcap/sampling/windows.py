"""Windows: sub-trajectories of a fixed length that never cross episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from tupli_mcap.sampling.steps import SamplingError, Steps, checked_fields, map_arrays

__all__ = ["Pad", "Window", "Windows"]

Array = np.ndarray[Any, Any]
Pad = Literal["none", "repeat", "zero"]
FIVE = ("states", "actions", "rewards", "terminals", "timeouts")


@dataclass(frozen=True)
class Window:
    """Columns of one window, of shape (T, ...), or of B windows, of shape (B, T, ...); None where not asked for.

    They are nested as the space is; values that differ in size are in a list (of B lists). `mask` (bool, (B, T)) is
    False where there was no step and the columns are filled up. `steps` (int64, (B,)) is the number of the step the
    window starts at (its history lies before), `episodes` (int64, (B,)) the place of its episode in the query.
    """

    mask: Array
    steps: Any
    episodes: Any
    states: Any = None
    actions: Any = None
    rewards: Any = None
    terminals: Any = None
    timeouts: Any = None
    next_states: Any = None
    times: Any = None

    def asdict(self) -> dict[str, Any]:
        """What there is, by name, without what was not asked for."""
        named = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: value for name, value in named if value is not None}


class Windows:
    """Windows of `length` steps, each after `history` earlier ones, at every `stride`-th step of an episode.

    A window lies in one episode, and between the cuts of a tuple filter. With `pad="none"` all its steps exist.
    Otherwise there is a window at every `stride`-th step, whatever is left of the episode: what is missing is the
    nearest step again ("repeat"), or zero ("zero"; None in a list), and `mask` says so.

    An index gives a `Window`; a slice, or an array of numbers, gives one of several, read together. Raises
    SamplingError: no episode is long enough; arguments that mean nothing; an unknown field.
    """

    def __init__(
        self,
        steps: Steps,
        length: int,
        stride: int = 1,
        pad: Pad = "none",
        history: int = 0,
        *,
        fields: Sequence[str] = FIVE,
    ) -> None:
        self.source = steps
        self.length, self.stride, self.pad, self.history = length, stride, pad, history
        self.fields = checked_fields(fields)
        ends = steps.breaks + 1
        self._firsts = np.concatenate([[0], ends[:-1]]).astype(np.int64) if len(ends) else ends
        self._lasts = steps.breaks
        sizes = self._lasts - self._firsts + 1
        room = sizes - (length + history) + 1 if pad == "none" else sizes
        counts = np.maximum(0, -(-room // stride))
        self._ends = np.cumsum(counts)
        self._episode_ends = np.cumsum(steps.episode_lengths)
        if not len(self):
            raise SamplingError(
                f"expected an episode of at least {length + history} steps, found at most {sizes.max(initial=0)}; "
                'take shorter windows, or pad="repeat"'
            )

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int | slice | Sequence[int] | Array) -> Window:
        single = isinstance(index, int | np.integer)
        chosen = self._chosen(index)
        pieces = np.searchsorted(self._ends, chosen, side="right")
        before = np.where(pieces > 0, self._ends[pieces - 1], 0)
        starts = self._firsts[pieces] + (chosen - before) * self.stride
        if self.pad == "none":
            starts += self.history
        return self._read(starts, self._firsts[pieces], self._lasts[pieces], single)

    def _chosen(self, index: Any) -> Array:
        n = len(self)
        if isinstance(index, slice):
            return np.arange(*index.indices(n))
        chosen = np.atleast_1d(np.asarray(index))
        if chosen.dtype.kind not in "iu" or chosen.ndim != 1:
            raise SamplingError(f"expected numbers of windows, found {index!r:.80}")
        chosen = chosen.astype(np.int64)
        chosen = np.where(chosen < 0, chosen + n, chosen)
        if len(chosen) and (chosen.min() < 0 or chosen.max() >= n):
            raise IndexError(f"expected windows from 0 to {n - 1}, found {index!r:.80}")
        return chosen

    def _read(self, starts: Array, firsts: Array, lasts: Array, single: bool) -> Window:
        rows = starts[:, None] + np.arange(-self.history, self.length)
        mask = np.ones(rows.shape, np.bool_)
        if self.pad != "none":
            inside = np.clip(rows, firsts[:, None], lasts[:, None])
            mask, rows = inside == rows, inside
        columns = self.source.read(self.fields, rows.reshape(-1))
        if self.pad == "zero" and not mask.all():
            outside = np.flatnonzero(~mask.reshape(-1))
            columns = {name: _zeroed(column, outside) for name, column in columns.items()}
        shape = rows.shape[1:] if single else rows.shape
        columns = {name: _shaped(column, shape) for name, column in columns.items()}
        episodes = np.searchsorted(self._episode_ends, starts, side="right")
        if single:
            return Window(mask[0], starts[0], episodes[0], **columns)
        return Window(mask, starts, episodes, **columns)

    def __iter__(self) -> Iterator[Window]:
        for i in range(len(self)):
            yield self[i]

    def __repr__(self) -> str:
        return f"<{len(self)} windows of {self.length + self.history} steps>"


def _zeroed(column: Any, rows: Array) -> Any:
    """The column with zero in some rows, None in a list."""

    def of_array(part: Array) -> Array:
        part[rows] = 0
        return part

    def of_list(part: list[Any]) -> list[Any]:
        for row in rows.tolist():
            part[row] = None
        return part

    return map_arrays(of_array, column, of_list)


def _shaped(column: Any, shape: tuple[int, ...]) -> Any:
    """The column with its rows in another shape: of one window (T), or of several (B, T)."""

    def of_list(part: list[Any]) -> list[Any]:
        if len(shape) == 1:
            return part
        return [part[i : i + shape[1]] for i in range(0, len(part), max(1, shape[1]))]

    return map_arrays(lambda part: part.reshape(*shape, *part.shape[1:]), column, of_list)
