"""Samples episodes and steps of a dataset, in a time that does not grow with the number of its episodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from sqlalchemy import Connection, func, select

from tupli_mcap.arrays import Array
from tupli_mcap.errors import TupliError
from tupli_mcap.page.copies import have_same_spaces
from tupli_mcap.page.datasets import Dataset, of_dataset
from tupli_mcap.page.shelf import Shelf
from tupli_mcap.plots.measure import read_numbers
from tupli_mcap.plots.statistics import LeafValues
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.storage.catalog.tables import EPISODE, RECORDING, episodes_of, in_order, of_one_recording
from tupli_mcap.storage.catalog.tallies import Tally
from tupli_mcap.storage.texts import escape_text, unescape_text

_EPISODES: Final = 2_000
_RECORDINGS: Final = 250  # most recordings that episodes are taken from
_IDS_AT_ONCE: Final = 500
_OPENED: Final = 5  # most recordings whose steps are read
_OF_EACH: Final = 12  # about as many episodes of each of them are chosen
_STEP_BYTES: Final = 2 << 20  # most bytes read of each of them


@dataclass(frozen=True)
class SampledEpisodes:
    """Facts of sampled episodes, in the order in which they ended.

    recordings: the name of the recording of each. ended: ns since 1970 (int64). returns, steps, success, seeds:
    float64, NaN if unknown. of: the number of episodes that the sample was taken from.
    """

    recordings: Sequence[str]
    ended: Array
    returns: Array
    steps: Array
    success: Array
    seeds: Array
    of: int

    @property
    def is_all(self) -> bool:
        """Whether the sample holds every episode."""
        return len(self.ended) >= self.of


@dataclass(frozen=True)
class SampledValues:
    """Values of sampled steps by leaf. steps, episodes: how many were read. notes: sentences about what is left out."""

    states: Sequence[LeafValues]
    actions: Sequence[LeafValues]
    rewards: Sequence[LeafValues]
    steps: int
    episodes: int
    notes: Sequence[str]


def sample_episodes(shelf: Shelf, connection: Connection, dataset: Dataset) -> SampledEpisodes:
    """All episodes of a dataset; of a large one, episodes at even distances in its recordings."""
    facts = (EPISODE.c[name] for name in ("created_at", "episode_return", "n_tuples", "success", "seed"))
    query = select(RECORDING.c.path, *facts).select_from(EPISODE.join(RECORDING, of_one_recording()))
    seen = shelf.seen_episodes(connection)
    if dataset.episodes <= _EPISODES:
        rows = list(connection.execute(query.where(seen, of_dataset(dataset.key))))
    else:
        recordings = _evenly(dataset.recordings, _RECORDINGS)
        share = _EPISODES / sum(item.episodes for item in recordings)
        rows = []
        for ids in _batches(_ids(shelf, connection, recordings, share)):
            rows += connection.execute(query.where(seen, EPISODE.c.id.in_(ids))).all()
    rows.sort(key=lambda row: row[1])
    returns, steps, success, seeds = (np.array([row[i] for row in rows], np.float64) for i in range(2, 6))
    names, ended = [unescape_text(row[0]) for row in rows], np.array([row[1] for row in rows], np.int64)
    return SampledEpisodes(names, ended, returns, steps, success, seeds, dataset.episodes)


def sample_values(shelf: Shelf, seen: Sequence[tuple[str, Sequence[int]]]) -> SampledValues:
    """Values of steps of some episodes: (recording, numbers of episodes that may be read)."""
    parts: list[tuple[Recording, dict[str, Array]]] = []
    steps = episodes = 0
    for name, numbers in seen:
        try:
            recording = shelf.open(name)
            if recording.num_envs and (not parts or have_same_spaces([recording, parts[0][0]])):
                positions = np.flatnonzero(np.isin(recording.index["episode"], list(numbers)))
                most = max(1, _STEP_BYTES // step_bytes(recording.layout, images=False))
                columns, read, count = read_numbers(recording, positions, most)
                parts.append((recording, columns))
                steps, episodes = steps + read, episodes + count
        except TupliError:  # gone, or damaged: the others are a sample too
            continue
    if not parts:
        return SampledValues((), (), (), 0, 0, ())
    layout, labels = parts[0][0].layout, parts[0][0].labels
    pooled = [
        [
            LeafValues.pooled([LeafValues(leaf, labels, columns[leaf.name]) for _, columns in parts])
            for leaf in leaves
            if leaf.name in parts[0][1]
        ]
        for leaves in (layout.state, layout.action, layout.reward)
    ]
    notes = [note for group in pooled for values in group for note in values.notes()]
    return SampledValues(pooled[0], pooled[1], pooled[2], steps, episodes, notes)


def sample_numbers(shelf: Shelf, connection: Connection, dataset: Dataset) -> list[tuple[str, list[int]]]:
    """The numbers of a few episodes of a few recordings of a dataset, by recording."""
    found = []
    for item in _evenly(dataset.recordings, _OPENED):
        ids = _ids(shelf, connection, [item], min(1.0, _OF_EACH / max(1, item.episodes)))
        chosen = shelf.seen_episodes(connection), EPISODE.c.id.in_(list(ids))
        joined = EPISODE.join(RECORDING, of_one_recording())
        numbers = connection.execute(select(EPISODE.c.episode).select_from(joined).where(*chosen)).scalars()
        found.append((item.recording, list(numbers)))
    return found


def _evenly(recordings: Sequence[Tally], most: int) -> list[Tally]:
    """At most `most` recordings at even distances in time, among them the first and the last."""
    ordered = sorted(recordings, key=lambda item: (item.last, item.recording))
    chosen = np.unique(np.linspace(0, len(ordered) - 1, min(most, len(ordered))).round().astype(int))
    return [ordered[i] for i in chosen.tolist()]


def _ids(shelf: Shelf, connection: Connection, recordings: Sequence[Tally], share: float) -> Iterator[int]:
    """The row ids of about a `share` of the episodes of some recordings, at even distances in each."""
    counts = {escape_text(item.recording): item.episodes for item in recordings}
    seen = shelf.seen_episodes(connection)
    # Of one of them alone, SQLite reads an end of the index; of both in one query, all between them.
    ends = (select(of(EPISODE.c.id)).where(seen, in_order()).scalar_subquery() for of in (func.min, func.max))
    query = select(RECORDING.c.id, RECORDING.c.path, *ends)
    for paths in _batches(counts):
        found = connection.execute(query.where(RECORDING.c.path.in_(paths)))
        for recording_id, path, low, high in found.all():
            if low is None:
                continue
            there: Any = range(low, high + 1)
            if len(there) != counts[path]:  # some are deleted, or the reader may not see them
                these = seen, episodes_of(recording_id, EPISODE.c.id)
                ids = connection.execute(select(EPISODE.c.id).where(*these).order_by(EPISODE.c.id))
                there = ids.scalars().all()
            count = max(1, round(len(there) * share))
            yield from (
                there[i] for i in np.unique(np.linspace(0, len(there) - 1, count).round().astype(int))
            )


def _batches(items: Any) -> Iterator[list[Any]]:
    given = list(items)
    for first in range(0, len(given), _IDS_AT_ONCE):
        yield given[first : first + _IDS_AT_ONCE]
