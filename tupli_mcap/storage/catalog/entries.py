"""Reads the catalog's entry of a recording from its index and the notes beside it."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from tupli_mcap import jsonvalue
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.recording import Recording
from tupli_mcap.storage.base import LOCAL_USER
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import LIVE, RecordingStamp, running, stamp_of
from tupli_mcap.storage.sidecar import Notes, Sidecar


class Entry(NamedTuple):
    """A recording to catalogue.

    Attributes:
        stamp: of the file, taken before it was read; while somebody writes to it, it says that it must be read again.
        rows: of its episodes, which are read as they are needed.
        runs: those of its episodes, as JSON of a list.
        numbers: of all its episodes, deleted ones too.
    """

    stamp: RecordingStamp
    uuid: str
    benchmark_id: str
    rows: Iterable[EpisodeRow]
    runs: str = "[{}]"
    numbers: Sequence[int] = ()


@contextlib.contextmanager
def entry_of(root: Path, relative: str) -> Iterator[Entry]:
    """The entry of a recording below a storage's root; its rows can be read inside the block.
    FormatError, RecordingError or OSError if it is damaged, or gone."""
    path = root / relative
    stamp, notes, live = stamp_of(root, relative), Notes.read(path, root), is_locked(path)
    with Recording(path) as recording:
        live |= is_locked(path)  # again, since a writer may have begun or ended in the meantime
        numbers = recording.index["episode"].tolist()
        rows = rows_of(recording, notes.about(recording.metadata), live=live)
        stamp = stamp._replace(mixed=LIVE) if live else stamp
        yield Entry(stamp, recording.uuid, recording.benchmark_id, rows, runs_of(recording), numbers)


def runs_of(recording: Recording) -> str:
    """JSON: a list of the runs of a recording's episodes."""
    known = {id(run): run for run in recording.listed_runs()}
    return jsonvalue.dumps(list(known.values()))


def rows_of(
    recording: Recording, sidecar: Sidecar, *, live: bool = False, created_by: str = LOCAL_USER
) -> Iterator[EpisodeRow]:
    """The rows of a recording, without deleted episodes and those a live writer is in the middle of."""
    index = recording.index
    columns = [index[name].tolist() for name in ("episode", "env", "length", "end", "return", "end_time")]
    growing = running(recording) if live else set()
    private = json.dumps([created_by])
    for i, (number, env, length, end, total, created_at, seed, metadata, run) in enumerate(
        zip(*columns, recording.seeds, recording.all_metadata(), _places(recording), strict=True)
    ):
        if number in sidecar.deleted or i in growing:
            continue
        groups = sidecar.published_in.get(number)
        yield EpisodeRow(
            episode=number,
            env=env,
            n_tuples=length,
            end=END_NAMES[end],
            episode_return=total,
            seed=seed,
            created_at=created_at,
            created_by=created_by,
            published_in=private if groups is None else json.dumps(groups),
            metadata=metadata,
            run=run,
        )


def _places(recording: Recording) -> list[int]:
    """The index of each episode's run among the recording's runs."""
    places: dict[int, int] = {}
    return [places.setdefault(id(run), len(places)) for run in recording.listed_runs()]
