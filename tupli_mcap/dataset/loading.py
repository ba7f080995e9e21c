"""Reading: from listed episodes to columns, a block of episodes at a time."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.columns import FieldBuilder, pick
from tupli_mcap.dataset.items import ListedEpisodes
from tupli_mcap.dataset.items.index import positions_of
from tupli_mcap.dataset.selection import TupleSelector
from tupli_mcap.dataset.sources import Source
from tupli_mcap.errors import memory_for
from tupli_mcap.messages.shared_dtypes import check_layouts
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.progress import Progress, progress
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import step_bytes, whole_episodes
from tupli_mcap.schema import EpisodeHeader

__all__ = ["Selected", "read_columns"]

_BLOCK_BYTES = 64 << 20
_RECORDED = ("states", "actions", "rewards", "terminals", "timeouts", "next_states")


@dataclass(frozen=True)
class Selected:
    """Which steps of the listed episodes are wanted: a bool mask over all of them, None for all of them.

    `steps` counts the wanted ones; `lengths` (int64) those of each episode.
    """

    lengths: Array
    mask: Array | None = None

    @property
    def steps(self) -> int:
        return int(self.lengths.sum())


def read_columns(
    source: Source,
    headers: Sequence[EpisodeHeader],
    fields: Sequence[str],
    selector: TupleSelector | None = None,
    known: Selected | None = None,
) -> tuple[dict[str, Any], Selected, StepLayout | None]:
    """Columns of the wanted steps, by field; which steps those are; and the layout they share.

    Fields are those of `Recording.read`, "infos" (a list of dicts) and "steps" (int64, from 0 in each
    episode).
    No more is held at any time than the result, one block of episodes (64 MiB, or one episode) and the cache
    of one recording.

    Args:
        selector: the tuple filter; `known` is its result if it has been evaluated before.

    Raises:
        SpaceError: two recordings do not fit into one array.
        NotFoundError: an episode is not in its recording any more.
    """
    total = sum(header.n_tuples for header in headers)
    with (
        memory_for(lambda: f"loading {', '.join(fields)} of {total} steps"),
        progress(total, "Loading") as bar,
    ):
        reader = _Reader(fields, selector, known, total)
        for name, group in itertools.groupby(headers, key=lambda header: header.recording):
            with source.open(name) as recording:
                reader.read(recording, list(group), bar)
        return reader.finish(headers)


class _Reader:
    """The columns that are being read."""

    def __init__(
        self, fields: Sequence[str], selector: TupleSelector | None, known: Selected | None, total: int
    ) -> None:
        self._fields = list(dict.fromkeys(fields))
        self._known = known
        self._selector = selector if known is None else None
        extra = [] if self._selector is None else list(self._selector.fields)
        self._needed = list(dict.fromkeys([*self._fields, *extra]))
        self._capacity = total if known is None else known.steps
        self._total = total
        self._done = 0  # listed steps
        self._builders: dict[str, FieldBuilder] = {}
        self._layout: StepLayout | None = None
        self._first_name = ""
        self._mask = None if self._selector is None else np.empty(total, np.bool_)

    def read(self, recording: Recording, headers: Sequence[EpisodeHeader], bar: Progress) -> None:
        layout = recording.layout
        if self._layout is None:
            self._layout, self._first_name = layout, recording.name
            self._builders = {field: FieldBuilder(field, self._capacity, layout) for field in self._fields}
        else:
            check_layouts(self._layout, self._first_name, layout, recording.name)
        listed = ListedEpisodes.of(recording.name, headers)
        positions, lengths = positions_of(recording, listed), listed.lengths
        for block in whole_episodes(lengths, max(1, _BLOCK_BYTES // step_bytes(layout))):
            columns = _read_block(recording, positions[block], lengths[block], self._needed)
            steps = int(lengths[block].sum())
            keep = self._keep(columns, steps, layout)
            for field, builder in self._builders.items():
                builder.put(columns[field], keep)
            self._done += steps
            bar.advance(steps)

    def _keep(self, columns: dict[str, Any], steps: int, layout: StepLayout) -> Array | None:
        here = slice(self._done, self._done + steps)
        if self._known is not None:
            return None if self._known.mask is None else self._known.mask[here]
        if self._selector is None or self._mask is None:
            return None
        self._mask[here] = self._selector.mask(columns, layout)
        return self._mask[here]

    def finish(self, headers: Sequence[EpisodeHeader]) -> tuple[dict[str, Any], Selected, StepLayout | None]:
        selected = self._known
        if selected is None:
            lengths = np.array([header.n_tuples for header in headers], np.int64)
            if self._mask is not None:
                ends = np.concatenate([[0], np.cumsum(lengths)])
                wanted = np.concatenate([[0], np.cumsum(self._mask)])
                lengths = np.diff(wanted[ends])
            selected = Selected(lengths, self._mask)
        columns = {field: builder.finish() for field, builder in self._builders.items()}
        if self._layout is None:
            columns = {field: _empty_column(field) for field in self._fields}
        return columns, selected, self._layout


def _empty_column(field: str) -> Any:
    """The column of no episodes at all, whose spaces nobody knows."""
    if field == "infos":
        return []
    dtypes: dict[str, Any] = {"terminals": np.bool_, "timeouts": np.bool_, "steps": np.int64}
    return np.empty(0, dtypes.get(field, np.float64))


def _read_block(
    recording: Recording, positions: Array, lengths: Array, fields: Sequence[str]
) -> dict[str, Any]:
    """The fields of some whole episodes; a recording that has grown since it was listed is cut to what
    was."""
    recorded = [field for field in fields if field in _RECORDED]
    # "All of it" is cheaper than a list of all: it leaves the cache alone.
    everything = len(positions) == len(recording) and (np.diff(positions) == 1).all()
    found = recording.read(None if everything else positions, fields=recorded)
    columns = {field: getattr(found, field) for field in recorded}
    now = found.episode_lengths
    if "steps" in fields:
        columns["steps"] = _steps_within(now)
    if "infos" in fields:
        columns["infos"] = [info for i in positions.tolist() for info in _infos(recording, i)]
    if (now > lengths).any():
        listed = _steps_within(now) < np.repeat(lengths, now)
        columns = {field: pick(column, listed) for field, column in columns.items()}
    return columns


def _infos(recording: Recording, position: int) -> list[dict[str, Any]]:
    infos = recording.infos(position)
    if infos is None:
        return [{} for _ in range(int(recording.index["length"][position]))]
    return [info or {} for info in infos]


def _steps_within(lengths: Array) -> Array:
    starts: Array = np.repeat(np.cumsum(lengths) - lengths, lengths)
    return np.arange(int(lengths.sum())) - starts
