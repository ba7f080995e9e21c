"""Reads the catalog's entry of a recording from its index and the notes beside it; with several processes if there are
many recordings.

Such a process does not run the caller's script again, as one of `multiprocessing` would. It ends with its parent, which
alone handles Ctrl-C. If it fails to read a recording, this process reads it.
"""

from __future__ import annotations

import contextlib
import functools
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from multiprocessing.context import SpawnContext, SpawnProcess
from pathlib import Path
from typing import NamedTuple

from tupli_mcap import jsonvalue
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.messages.episodes import END_NAMES, INTERRUPTED
from tupli_mcap.recording import Recording
from tupli_mcap.storage.base import LOCAL_USER
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import LIVE, RecordingStamp, stamp_of
from tupli_mcap.storage.sidecar import Notes, Sidecar

__all__ = ["Entry", "entry_of", "put_entry", "read_ahead", "rows_of", "runs_of"]

_MOST_EPISODES = 50_000  # of a recording that another process reads, since its rows are in memory twice
_TRIAL = 1.0  # seconds of reading in this process, to estimate whether more processes pay
_WORTH = 3.0  # estimated seconds that must be left for them
_MOST_WORKERS = 8


class Entry(NamedTuple):
    """A recording to catalogue.

    Attributes:
        stamp: of the file, taken before it was read.
        live: somebody writes to it.
        runs: JSON of a list.
        numbers: of all its episodes, deleted ones too.
    """

    stamp: RecordingStamp
    live: bool
    uuid: str
    benchmark_id: str
    runs: str
    numbers: Sequence[int]
    rows: Iterable[EpisodeRow]


@contextlib.contextmanager
def entry_of(root: Path, relative: str) -> Iterator[Entry]:
    """The entry of a recording below a storage's root; its rows can be read inside the block.

    Raises:
        FormatError, RecordingError, OSError: It is damaged, or gone.
    """
    path = root / relative
    stamp, notes, live = stamp_of(root, relative), Notes.read(path, root), is_locked(path)
    with Recording(path) as recording:
        live |= is_locked(path)  # again, since a writer may have begun or ended in the meantime
        numbers = recording.index["episode"].tolist()
        rows = rows_of(recording, notes.about(recording.metadata), live=live)
        yield Entry(stamp, live, recording.uuid, recording.benchmark_id, runs_of(recording), numbers, rows)


def put_entry(catalog: Catalog, relative: str, entry: Entry) -> None:
    """Catalogues a recording; while somebody writes to it, its stamp says that it must be read again."""
    catalog.put_recording(
        relative,
        entry.stamp._replace(mixed=LIVE) if entry.live else entry.stamp,
        uuid=entry.uuid,
        benchmark_id=entry.benchmark_id,
        runs=entry.runs,
        rows=entry.rows,
    )


def runs_of(recording: Recording) -> str:
    """JSON: a list of the runs of a recording's episodes."""
    known = {id(run): run for run in recording.listed_runs()}
    return jsonvalue.dumps(list(known.values()))


def read_ahead(root: Path, names: Sequence[str]) -> Generator[Entry | None]:
    """An entry for each recording that another process has read; None for each that the caller has to read, as long as
    more processes do not pay."""
    begun, workers = time.monotonic(), min(len(os.sched_getaffinity(0)), _MOST_WORKERS)
    if workers == 1 or multiprocessing.current_process().daemon:  # which may start none
        workers = 0
    for done in range(len(names)):
        taken = time.monotonic() - begun
        if workers and taken > _TRIAL and taken / max(1, done) * (len(names) - done) > _WORTH:
            yield from _read_elsewhere(root, names[done:], workers)
            return
        yield None


def _read_elsewhere(root: Path, names: Sequence[str], workers: int) -> Generator[Entry | None]:
    pool = ProcessPoolExecutor(workers, _Context(), initializer=_end_with_parent)
    done = 0
    try:
        for start in range(0, len(names), 8 * workers):
            block = names[start : start + 8 * workers]
            for entry in pool.map(functools.partial(_read, root), block):
                yield entry
                done += 1
    except (BrokenExecutor, OSError):  # one was killed, or cannot be started
        yield from [None] * (len(names) - done)
    finally:
        pool.shutdown(cancel_futures=True)


class _Process(SpawnProcess):
    def start(self) -> None:
        main = vars(sys.modules["__main__"])
        kept: dict[str, object] = {name: main[name] for name in ("__spec__", "__file__") if name in main}
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])  # as it is in the process then
        main.update(dict.fromkeys(kept))  # with which it would be found
        try:
            super().start()
        finally:
            main.update(kept)
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


class _Context(SpawnContext):
    Process = _Process


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _read(root: Path, relative: str) -> Entry | None:
    """In another process: a recording's entry with its rows; None if it is too long, fails, or causes a warning."""
    with contextlib.suppress(Exception), warnings.catch_warnings():
        warnings.simplefilter("error")
        with entry_of(root, relative) as entry:
            if len(entry.numbers) <= _MOST_EPISODES:
                return entry._replace(rows=list(entry.rows))
    return None


def rows_of(
    recording: Recording, sidecar: Sidecar, *, live: bool = False, created_by: str = LOCAL_USER
) -> Iterator[EpisodeRow]:
    """The rows of a recording, without deleted episodes and those a live writer is in the middle of."""
    index = recording.index
    columns = [index[name].tolist() for name in ("episode", "env", "length", "end", "return", "end_time")]
    running = _running(columns[1], columns[3]) if live else set()
    private = json.dumps([created_by])
    for i, (number, env, length, end, total, created_at, seed, metadata, run) in enumerate(
        zip(*columns, recording.seeds, recording.all_metadata(), _places(recording), strict=True)
    ):
        if number in sidecar.deleted or i in running:
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


def _running(envs: Sequence[int], ends: Sequence[int]) -> set[int]:
    """Positions of episodes that a live writer has not finished: each sub-environment's last, if it has no
    end."""
    last = {env: i for i, env in enumerate(envs)}
    return {i for i in last.values() if ends[i] == INTERRUPTED}
