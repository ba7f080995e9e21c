"""Episodes with their steps, made of columns when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, overload

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.tuples import Tuples
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.schema import EpisodeHeader, EpisodeItem

__all__ = ["EpisodeItems", "items_of"]

Columns = tuple[Mapping[str, Any], Array, StepLayout | None]


class EpisodeItems(Sequence[EpisodeItem]):
    """Episodes with their steps.

    Args:
        headers: the episodes.
        columns: gives the columns of all of them, the number of steps of each, and their layout.
        chosen: places in `headers`.
    """

    def __init__(
        self, headers: Sequence[EpisodeHeader], columns: Callable[[], Columns], chosen: range | None = None
    ) -> None:
        self._headers = headers
        self._columns = columns
        self._chosen = range(len(headers)) if chosen is None else chosen
        self._found: tuple[Tuples, Array] | None = None

    def __len__(self) -> int:
        return len(self._chosen)

    @overload
    def __getitem__(self, i: int) -> EpisodeItem: ...
    @overload
    def __getitem__(self, i: slice) -> EpisodeItems: ...
    def __getitem__(self, i: int | slice) -> EpisodeItem | EpisodeItems:
        if isinstance(i, slice):
            return EpisodeItems(self._headers, self._columns, self._chosen[i])
        try:
            place = self._chosen[i]
        except IndexError as err:
            raise IndexError(f"expected an episode from 0 to {len(self) - 1}, found {i}") from err
        if self._found is None:
            columns, lengths, layout = self._columns()
            self._found = Tuples(columns, layout), np.concatenate([[0], np.cumsum(lengths)])
        tuples, ends = self._found
        # Both are valid already; validating each step again would cost more than reading it.
        return EpisodeItem.model_construct(
            **dict(self._headers[place]), tuples=list(tuples[int(ends[place]) : int(ends[place + 1])])
        )

    def __repr__(self) -> str:
        return f"<{len(self)} episodes>"


def items_of(
    headers: Sequence[EpisodeHeader], columns: Mapping[str, Any], lengths: Array, layout: StepLayout | None
) -> EpisodeItems:
    """The episodes whose columns are there."""
    return EpisodeItems(headers, lambda: (columns, lengths, layout))
