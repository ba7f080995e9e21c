"""Reads columns of one recording: one array for each leaf, filled chunk by chunk, with several threads if asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, plural
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.fields import FIELDS, GymnasiumNames, Parts, described
from tupli_mcap.recording.columns.gather import (
    EPISODE,
    Files,
    GatheredRows,
    Plan,
    do_all,
    final_rows,
    image_rows,
    step_rows,
)
from tupli_mcap.recording.columns.runs import Runs, final_runs, parts_of
from tupli_mcap.spaces.leaves import Leaf


@dataclass(repr=False)
class Columns(GymnasiumNames, Parts):
    """Columns of the requested fields, None for the others; `columns["states"]` is `columns.states`.

    A leaf of constant size is an array of shape (steps, *leaf shape), one of variable size a list; both are nested as
    the space is.

    Attributes:
        episode_lengths: steps of each episode, int64 (episodes,).
        rewards: float64 (steps,), or as the reward space says.
        terminals, timeouts: bool (steps,).
        times: wall clock when each step returned, int64 (steps,), ns.
        infos: a dict for each step, empty if none was recorded.
        frames: the pictures of the states, uint8 (steps, height, width, 3).
    """

    episode_lengths: Array
    states: Any = None
    actions: Any = None
    rewards: Any = None
    terminals: Any = None
    timeouts: Any = None
    next_states: Any = None
    times: Any = None
    infos: Any = None
    frames: Any = None

    def __len__(self) -> int:
        return int(self.episode_lengths.sum())

    def __repr__(self) -> str:
        columns = [(field, getattr(self, field)) for field in FIELDS]
        told = [f"{field}: {described(column)}" for field, column in columns if column is not None]
        counts = f"{plural(len(self), 'step')} of {plural(len(self.episode_lengths), 'episode')}"
        return f"<Columns of {counts}: {'; '.join(told)}>"


class ColumnReader:
    """Reads columns of a recording's layout."""

    def __init__(self, layout: StepLayout, store: ChunkStore, images: dict[str, dict[int, int]]) -> None:
        self._layout = layout
        self._files = Files([layout], [0], [store])
        self._store = store
        self._images = images  # leaf name -> step channel -> image channel
        self._plans: dict[tuple[str, ...], Plan] = {}

    def read(
        self,
        runs: Runs,
        total: int,
        fields: Sequence[str],
        threads: int,
        keep: bool,
        images: bool = True,
        parts: Sequence[str] = (),
    ) -> dict[str, Any]:
        """`fields` nested as their spaces are; `keep` puts the chunks read into the cache.

        Without `images`, the columns of image leaves are empty. parts: see `StepLayout.only`.
        """
        plan = self._plans.get((*fields, *parts))
        if plan is None:
            kinds = (rows.columns for rows in self._kinds)
            plan = self._plans[*fields, *parts] = Plan.of(fields, self._layout.only(parts), kinds)
        columns: dict[str, Any] = {}
        tasks, checks, chunks = [], [], []
        for i, names in plan.sources:
            rows, leaf, moved = self._kinds[i], self._leaves[i], runs
            if leaf is not None and not images:
                columns |= {name: rows.columns[name].empty(0) for name in names}
                continue
            if leaf is not None:
                moved = runs._replace(channels=self._image_channels(leaf, runs.channels))
            own = {name: rows.columns[name].empty(total) for name in names}
            of_chunks = parts_of(moved, self._store)
            columns |= own
            tasks += rows.tasks(own, of_chunks, keep)
            chunks += [part.chunk for part in of_chunks]
            checks.append(partial(rows.check, own, of_chunks, whole=True))
        self._store.fetch(chunks)
        do_all(tasks, threads)
        for check in checks:
            check()
        return plan.nest(columns)

    @cached_property
    def _leaves(self) -> list[str | None]:
        """The image leaf of each kind of rows; None for steps."""
        return [None, *(leaf.name for leaf in self._layout.images)]

    @cached_property
    def _kinds(self) -> list[GatheredRows]:
        return [
            step_rows(self._files) if leaf is None else image_rows(self._files, leaf) for leaf in self._leaves
        ]

    @cached_property
    def _finals(self) -> GatheredRows:
        return final_rows(self._files)

    def _image_channels(self, name: str, channels: Array | Sequence[int]) -> Array:
        found, places = np.unique(channels, return_inverse=True)
        images = [self._images[name][channel] for channel in found.tolist()]
        return np.array(images, np.int64)[places]

    def final_columns(self, channel: int, episodes: Array, leaves: Sequence[Leaf]) -> list[Any]:
        """Final states of episodes (index rows that all have one): a column for each of some leaves of the state."""
        names = [leaf.name for leaf in leaves]
        parts = parts_of(final_runs(episodes, channel), self._store)
        columns = self._finals.read([*names, EPISODE], parts, len(episodes), 1)
        wrong = np.flatnonzero(columns[EPISODE] != episodes["episode"])
        if len(wrong):
            first = int(wrong[0])
            raise FormatError(
                f"expected the final state of episode {episodes['episode'][first]}, "
                f"found that of {columns[EPISODE][first]}"
            )
        return [columns[name] for name in names]


class StoredSteps(NamedTuple):
    """The steps of a recording, by channel and row.

    Attributes:
        channels: the step channels by sub-environment.
        images: for each image leaf (ROS name), step channel -> image channel.
        final_channel: None if there is no final state.
        where: the path or the URL that opens the file again; None if there is none.
        source: the file, while the recording is open.
    """

    layout: StepLayout
    store: ChunkStore
    channels: list[int]
    images: dict[str, dict[int, int]]
    final_channel: int | None
    where: str | None
    source: Source

    def channels_of(self, envs: Array, leaf: str | None) -> Array:
        """The step channel, or the channel of an image leaf, of each sub-environment in `envs`."""
        if len(envs) and int(envs.max()) >= len(self.channels):
            raise FormatError(
                f"an episode names sub-environment {envs.max()}, but there are {len(self.channels)}"
            )
        found = [self.images[leaf][channel] if leaf else channel for channel in self.channels]
        return np.array(found, np.int64)[envs]
