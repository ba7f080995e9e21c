"""Windows: sub-trajectories of a fixed length that never cross episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np

from tupli_mcap.sampling.steps import FIELDS, SamplingError, Steps, checked_fields, map_arrays

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
        self.fields = tuple(checked_fields(fields))
        ends = steps.breaks + 1
        self._firsts = np.concatenate([[0], ends[:-1]]).astype(np.int64) if len(ends) else ends
        self._lasts = steps.breaks
        sizes = self._lasts - self._firsts + 1
        room = sizes - (length + history) + 1 if pad == "none" else sizes
        counts = np.maximum(0, -(-room // stride))
        self._ends = np.cumsum(counts)
        self._before = self._ends - counts
        self._episode_ends = np.cumsum(steps.episode_lengths)
        if not len(self):
            raise SamplingError(
                f"expected an episode of at least {length + history} steps, found at most {sizes.max(initial=0)}; "
                'take shorter windows, or pad="repeat"'
            )

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int | slice | Sequence[int] | Array) -> Window:
        if isinstance(index, int | np.integer):
            found = self._read(np.array([self._checked(int(index))]))
            for name in ("mask", "steps", "episodes"):
                found[name] = found[name][0]
            return Window(**found)
        found = self._read(self._chosen(index))
        shape = found["mask"].shape
        return Window(
            **{name: _shaped(part, shape) if name in FIELDS else part for name, part in found.items()}
        )

    def _checked(self, index: int) -> int:
        n = len(self)
        if not -n <= index < n:
            raise IndexError(f"expected a window from 0 to {n - 1}, found {index}")
        return index % n

    def _chosen(self, index: Any) -> Array:
        n = len(self)
        if isinstance(index, slice):
            return np.arange(*index.indices(n))
        chosen = np.asarray(index)
        if chosen.ndim != 1 or (chosen.dtype.kind not in "iu" and len(chosen)):
            raise SamplingError(f"expected numbers of windows, found {index!r:.80}")
        chosen = chosen.astype(np.int64)
        if len(chosen) and (chosen.min() < -n or chosen.max() >= n):
            raise IndexError(f"expected windows from 0 to {n - 1}, found {index!r:.80}")
        return np.where(chosen < 0, chosen + n, chosen)

    def _read(self, chosen: Array) -> dict[str, Any]:
        """The parts of a `Window`, of columns whose rows are those of one window after the other."""
        pieces = self._ends.searchsorted(chosen, side="right")
        starts = self._firsts[pieces] + (chosen - self._before[pieces]) * self.stride
        total = self.history + self.length
        mask = np.ones((len(chosen), total), np.bool_)
        if self.pad == "none":
            columns = self.source.read_runs(self.fields, starts, total)
            starts = starts + self.history
        else:
            rows = starts[:, None] + np.arange(-self.history, self.length)
            inside = np.clip(rows, self._firsts[pieces, None], self._lasts[pieces, None])
            np.equal(rows, inside, out=mask)
            columns = self.source.read(self.fields, inside.reshape(-1))
            if self.pad == "zero":
                outside = np.flatnonzero(~mask)
                columns = {name: _zeroed(column, outside) for name, column in columns.items()}
        episodes = self._episode_ends.searchsorted(starts, side="right")
        return {"mask": mask, "steps": starts, "episodes": episodes, **columns}

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
    """The column with its rows in the shape (B, T)."""

    def of_list(part: list[Any]) -> list[Any]:
        return [part[i : i + shape[1]] for i in range(0, len(part), shape[1])]

    return map_arrays(lambda part: part.reshape(*shape, *part.shape[1:]), column, of_list)
