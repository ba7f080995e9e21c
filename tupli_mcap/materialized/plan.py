"""Which files hold the columns of a query: their names, dtypes and shapes, from the layout and three counts alone.

Writer and reader both ask this, so that nothing a manifest says of a shape is believed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout

__all__ = ["Array", "ColumnPlan", "LeafFiles"]

Array = np.ndarray[Any, Any]
_LONGEST_STEM = 200  # bytes, of the 255 a file's name may have
_INT64, _BOOL = np.dtype("<i8"), np.dtype(np.bool_)


@dataclass(frozen=True)
class LeafFiles:
    """The files of one leaf: an array, or offsets (rows + 1 of them) into the bytes of values of variable size."""

    leaf: Leaf
    stem: str
    dtype: np.dtype[Any]
    rows: int

    @property
    def variable(self) -> bool:
        return self.leaf.kind == "variable"

    @property
    def array(self) -> str:
        """The file of the array, or of the offsets."""
        return f"{self.stem}.offsets.npy" if self.variable else f"{self.stem}.npy"

    @property
    def values(self) -> str:
        """The file of the values of variable size."""
        return f"{self.stem}.values.bin"

    @property
    def shape(self) -> tuple[int, ...]:
        return (self.rows + 1,) if self.variable else (self.rows, *self.leaf.shape)


@dataclass(frozen=True)
class ColumnPlan:
    """The columns of `steps` steps of `episodes` episodes, after `breaks` of which comes no next step."""

    layout: StepLayout
    steps: int
    episodes: int
    breaks: int

    @cached_property
    def leaves(self) -> dict[str, LeafFiles]:
        """A file for each leaf of a step, by the leaf's name."""
        return {leaf.name: self._files(leaf, "", i, self.steps) for i, leaf in enumerate(self.layout.leaves)}

    @cached_property
    def next_leaves(self) -> dict[str, LeafFiles]:
        """The states that follow the breaks, by the leaf's name."""
        return {
            leaf.name: self._files(leaf, "next_", i, self.breaks) for i, leaf in enumerate(self.layout.state)
        }

    @property
    def plain(self) -> dict[str, tuple[np.dtype[Any], tuple[int, ...]]]:
        """The arrays that belong to no leaf, by their names without `.npy`; the ids of the episodes left out."""
        return {
            "terminal": (_BOOL, (self.steps,)),
            "timeout": (_BOOL, (self.steps,)),
            "time": (_INT64, (self.steps,)),
            "step": (_INT64, (self.steps,)),
            "break": (_INT64, (self.breaks,)),
            "next_state_known": (_BOOL, (self.breaks,)),
            "episode_length": (_INT64, (self.episodes,)),
            "episode_recorded": (_INT64, (self.episodes,)),
        }

    def _files(self, leaf: Leaf, prefix: str, i: int, rows: int) -> LeafFiles:
        stem = leaf.name if len(leaf.name) <= _LONGEST_STEM else f"{leaf.name[:_LONGEST_STEM]}_{i}"
        dtype = _INT64 if leaf.kind == "variable" else self.layout.dtypes[leaf.name].newbyteorder("<")
        return LeafFiles(leaf, prefix + stem, dtype, rows)
