"""Windows: sub-trajectories of a fixed length that never cross episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.dataset.items.items import Items
from tupli_mcap.dataset.items.steps import SamplingError, Steps, checked_count, steps_and_fields
from tupli_mcap.errors import plural
from tupli_mcap.recording.columns.fields import FIVE, GymnasiumNames, Parts

Pad = Literal["none", "repeat", "zero"]
PADS = ("none", "repeat", "zero")


@dataclass(frozen=True, repr=False)
class Window(GymnasiumNames, Parts):
    """Columns of one window, shape (T, ...), or of B windows, shape (B, T, ...); None if not requested.

    They are nested as the space is; values that differ in size are in a list (of B lists).

    Attributes:
        mask: bool (B, T), False where there was no step and the columns are padded.
        steps: number, among all steps of the dataset, of the step that the window starts at (its history lies
            before), int64 (B,).
        episodes: place of its episode in the dataset, int64 (B,).
        infos: a dict of columns by key.
        frames: the recorded pictures, uint8 (B, T, height, width, 3).
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
    infos: Any = None
    frames: Any = None


class Windows(Items[Window]):
    """Windows of `length` steps, each after `history` earlier ones, at every `stride`-th step of an episode.

    A window lies in one episode, and between the cuts of a tuple filter. With `pad="none"` all its steps exist.
    Otherwise there is a window at every `stride`-th step up to the end of the episode: missing steps repeat the
    nearest one ("repeat"), or are zero ("zero"; None in a list), and `mask` marks them.

    Raises:
        SamplingError: no episode is long enough, an argument is invalid, or a field is unknown.
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
        super().__init__(steps, (length, stride, pad, history))
        self.length = checked_count(length, 1, "a length of windows")
        self.stride = checked_count(stride, 1, "a stride")
        self.history = checked_count(history, 0, "a number of earlier steps")
        if pad not in PADS:
            raise SamplingError(f"expected pad to be one of {', '.join(map(repr, PADS))}, found {pad!r:.80}")
        self.pad = pad
        self.source, names = steps_and_fields(steps, fields, steps.fields)
        self.fields = tuple(names)
        self._lasts = steps.breaks
        self._firsts = np.concatenate([[0], self._lasts[:-1] + 1])
        sizes = self._lasts - self._firsts + 1
        total = self.length + self.history
        room = np.maximum(0, sizes - total + 1) if pad == "none" else sizes
        counts = -(-room // self.stride)
        self._ends = np.cumsum(counts)
        self._before = self._ends - counts
        if not len(self):
            longest = plural(int(sizes.max()), "step")
            raise SamplingError(
                f"expected windows of at most {longest}, which the longest episode has, found {total}; take shorter "
                "ones, or pad='repeat'"
            )

    def __len__(self) -> int:
        return int(self._ends[-1])

    def steps_of(self, items: Array) -> Array:
        return self._starts(items)[0]

    def counts(self) -> Array:
        of_pieces = self._episodes(self._lasts)
        counts = np.bincount(of_pieces, self._ends - self._before, len(self._episode_ends))
        return counts.astype(np.int64)

    def _starts(self, items: Array) -> tuple[Array, Array]:
        """The step that each window starts at, and the piece between two breaks that holds it."""
        pieces = self._ends.searchsorted(items, side="right")
        starts = self._firsts[pieces] + (items - self._before[pieces]) * self.stride
        return starts + self.history if self.pad == "none" else starts, pieces

    def _one(self, item: int) -> Window:
        found = self._read(np.array([item]))
        for name in ("mask", "steps", "episodes"):
            found[name] = found[name][0]
        return Window(**found)

    def _batch(self, items: Array) -> Window:
        found = self._read(items)
        shape = found["mask"].shape
        return Window(
            **{
                name: shaped_rows(part, shape) if name in self.fields else part
                for name, part in found.items()
            }
        )

    def _read(self, items: Array) -> dict[str, Any]:
        """The parts of a `Window`; columns have the rows of one window after the other."""
        starts, pieces = self._starts(items)
        total = self.history + self.length
        mask = np.ones((len(items), total), np.bool_)
        if self.pad == "none":
            columns = self.source.read_runs(self.fields, starts - self.history, total)
        else:
            rows = starts[:, None] + np.arange(-self.history, self.length)
            inside = np.clip(rows, self._firsts[pieces, None], self._lasts[pieces, None])
            np.equal(rows, inside, out=mask)
            columns = self.source.read(self.fields, inside.reshape(-1))
            if self.pad == "zero":
                outside = np.flatnonzero(~mask)
                columns = {name: _zeroed(column, outside) for name, column in columns.items()}
        return {"mask": mask, "steps": starts, "episodes": self._episodes(starts), **columns}

    def __repr__(self) -> str:
        return f"<{len(self)} windows of {self.history + self.length} steps>"


def _zeroed(column: Any, rows: Array) -> Any:
    """The column with some rows set to zero, to None in a list."""

    def of_array(part: Array) -> Array:
        part[rows] = 0
        return part

    def of_list(part: list[Any]) -> list[Any]:
        for row in rows.tolist():
            part[row] = None
        return part

    return map_arrays(column, of_array, of_list)


def shaped_rows(column: Any, shape: tuple[int, ...]) -> Any:
    """The column with its rows in the shape (B, T)."""

    def of_list(part: list[Any]) -> list[Any]:
        return [part[i : i + shape[1]] for i in range(0, len(part), shape[1])]

    return map_arrays(column, lambda part: part.reshape(*shape, *part.shape[1:]), of_list)
