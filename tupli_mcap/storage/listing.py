"""Finds, lists and reads the recordings of files, directories and URLs, storages or not; nothing is written."""

from __future__ import annotations

import contextlib
import errno
import glob
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError, TupliError, no_file, os_reason, warn
from tupli_mcap.files import is_directory, is_there
from tupli_mcap.journal.file import journal_name
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.messages.episodes import INTERRUPTED
from tupli_mcap.progress import progress
from tupli_mcap.recording import Recording, Run
from tupli_mcap.recording.about.success import success_of
from tupli_mcap.recording.describe.description import state_of, successes
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.remote import is_pattern, is_server, is_url, matching, path_of, shown_name
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.storage.atomic import is_missing
from tupli_mcap.storage.base import by_recording
from tupli_mcap.storage.sidecar import DELETING, Deletion, Notes, sidecar_path

_PARTS = ("benchmarks", "artifacts", "recordings", "storage.json")


def is_storage(root: Path) -> bool:
    """Whether a directory is a storage, and not only a directory with recordings."""
    return any((root / part).exists() for part in _PARTS)


class RecordingStamp(NamedTuple):
    """Identifies the contents of a recording's file and its sidecar at the time of cataloguing.

    `size` (bytes) and `mtime_ns` are those of the recording; `mixed` is a hash of other facts about both files.
    """

    size: int
    mtime_ns: int
    mixed: int


LIVE = -1
"""In place of `RecordingStamp.mixed` while somebody writes to the recording: the entry must be read again."""


class FoundRecording(NamedTuple):
    """A recording: its path below the root (with forward slashes), its stamp, whether it has a journal."""

    relative: str
    stamp: RecordingStamp
    journal: bool


_STATES = ("incomplete", "recording", "unfinished", "complete", "")
"""The states of recordings: of a run, the first of these that one of its recordings is in."""


class ListedRecording(NamedTuple):
    """Facts about a run, without its deleted episodes; `error` says why they are missing.

    Attributes:
        paths: of its recordings in their order in time.
        return_sum: over its episodes, without the `return_nan` whose return is NaN.
        size: of the files (bytes); None if unknown. A file with several runs counts as the first one's.
        state: see `tupli_mcap.recording.describe.description.state_of`.
        name, environment, split, tags: see `tupli_mcap.Run`.
        started: ISO 8601 in UTC.
        settings: its metadata.
        succeeded: how many episodes did, of the `success_known` whose metadata say it.
        run_id: empty if the recording was made of others, whose episodes it repeats.
        span: when the first of its episodes ended, and the last (ISO 8601 in UTC); empty texts without an episode.
    """

    paths: tuple[str, ...]
    episodes: int = 0
    steps: int = 0
    return_sum: float = 0.0
    return_nan: int = 0
    size: int | None = 0
    created_ns: int = 0
    benchmark_id: str = ""
    state: str = ""
    error: str | None = None
    name: str = ""
    environment: str = ""
    started: str = ""
    succeeded: int = 0
    success_known: int = 0
    split: str = ""
    tags: tuple[str, ...] = ()
    settings: dict[str, Any] | None = None
    run_id: str = ""
    span: tuple[str, str] = ("", "")

    @property
    def path(self) -> str:
        """The first of the paths."""
        return self.paths[0]

    @property
    def files(self) -> int:
        """The number of recordings."""
        return len(self.paths)

    @property
    def return_mean(self) -> float | None:
        """The mean return; None without an episode, NaN if all returns are."""
        if not self.episodes:
            return None
        known = self.episodes - self.return_nan
        return self.return_sum / known if known else math.nan

    @property
    def success(self) -> float | None:
        """The share of successes; None if no episode says it."""
        return self.succeeded / self.success_known if self.success_known else None


class Compactable(NamedTuple):
    """A recording (its path below the storage), its number of deleted episodes, and its size (bytes)."""

    recording: str
    deleted: int
    size: int


def scan(root: Path) -> Iterator[FoundRecording]:
    """Every recording below a directory; hidden files and links to directories are skipped.
    FormatError if `deleting.json` is damaged."""
    pending = [(os.fspath(root), "")]
    deleting = Deletion()
    while pending:
        directory, prefix = pending.pop()
        try:
            with os.scandir(directory) as entries:
                by_name = {entry.name: entry for entry in entries if not entry.name.startswith(".")}
        except FileNotFoundError:
            continue  # deleted after it was listed
        if not prefix and DELETING in by_name:
            deleting = Deletion.read(root)
        for name, entry in by_name.items():
            if name.endswith(".mcap"):
                try:
                    if entry.is_file():
                        journal = journal_name(name) in by_name
                        stamp = _stamp(entry, by_name, deleting.stamp(prefix + name))
                        yield FoundRecording(prefix + name, stamp, journal)
                except OSError as err:
                    if err.errno not in (errno.ENOENT, errno.ELOOP):  # deleted since, or a link in a circle
                        raise
            elif entry.is_dir(follow_symlinks=False):
                pending.append((entry.path, f"{prefix}{name}/"))


def stamp_of(root: Path, relative: str) -> RecordingStamp:
    """The stamp of one recording below a directory; raises FileNotFoundError if it is gone."""
    return _stamp_at(root / relative, Deletion.read(root).stamp(relative))


def _stamp_at(path: Path, deleting: Sequence[int]) -> RecordingStamp:
    status = path.stat()
    try:
        return _mix(status, sidecar_path(path).stat(), deleting)
    except OSError as err:
        if not is_missing(err):
            raise
        return _mix(status, None, deleting)


def _stamp(
    entry: os.DirEntry[str], found: dict[str, os.DirEntry[str]], deleting: Sequence[int]
) -> RecordingStamp:
    if entry.is_symlink():
        return _stamp_at(Path(entry.path), deleting)
    beside = found.get(f"{entry.name}.json")
    # Not `beside.stat()`: scandir's facts about a file may be older than its name.
    return _mix(os.stat(entry.path), None if beside is None else os.stat(beside.path), deleting)  # noqa: PTH116


def _mix(status: os.stat_result, beside: os.stat_result | None, deleting: Sequence[int]) -> RecordingStamp:
    # Size and time may repeat when a file is replaced: clocks tick every few ms, and archives set the times of files.
    # Its inode or its time of change does not.
    facts = [
        (found.st_ino, found.st_ctime_ns, found.st_size) for found in (status, beside) if found is not None
    ]
    return RecordingStamp(status.st_size, status.st_mtime_ns, hash((*facts, *deleting)) & (2**63 - 1))


def running(recording: Recording) -> set[int]:
    """Positions of episodes that a live writer has not finished: each sub-environment's last, if it has no end. One
    that was interrupted has an end: by `EpisodeWriter.end`, or in an earlier session of a file that goes on."""
    index, endless = recording.index, recording.file.contents.endless
    facts = zip(index["episode"].tolist(), index["end"].tolist(), strict=True)
    growing = [end == INTERRUPTED and number in endless for number, end in facts]
    last = {env: i for i, env in enumerate(index["env"].tolist())}
    return {i for i in last.values() if growing[i]}


def list_recordings(
    sources: Iterable[Path | str], choose: Callable[[Recording], Array] | None = None
) -> Iterator[ListedRecording]:
    """The runs of each recording of files, directories and URLs; a recording that cannot be read is listed with its
    error.

    `choose` returns the positions of the episodes that count; runs without any are left out.
    """
    for source in sources:
        try:
            found = recordings_at(source)
        except TupliError as err:
            yield ListedRecording((shown_name(str(source)),), error=str(err))
            continue
        root = source if isinstance(source, Path) and source.is_dir() else None
        with progress(len(found), "reading recordings") as bar:
            for file in found:
                for item in _listed(file, root, choose):
                    if item.episodes or item.error or choose is None:
                        yield item
                bar.advance(1)


def recordings_at(place: str | os.PathLike[str]) -> list[str]:
    """The recordings at a place: a file itself, those (`.mcap`) below a directory, or the files or URLs that match a
    pattern, in which `**` matches folders; sorted.

    Raises:
        RecordingError: there is no such file or directory, nothing matches, or the directory cannot be read.
        FormatError: the directory's `deleting.json` is damaged.
    """
    name = os.fspath(place)
    if is_url(name):
        return matching(name)
    path = path_of(name)
    if is_directory(path):
        try:
            return [str(path / item.relative) for item in sorted(scan(path))]
        except OSError as err:
            raise RecordingError(f"{path} cannot be read: {os_reason(err)}") from err
    if is_there(path):
        return [str(path)]
    if not glob.has_magic(name):
        raise no_file(path)
    found = sorted(glob.glob(str(path), recursive=True))  # noqa: PTH207 - Path.glob takes no absolute pattern
    if not (files := [file for file in found if not Path(file).is_dir()]):
        raise RecordingError(f"no file matches {str(path)!r}; give the path of a recording (.mcap)")
    return files


def name_at(place: str | os.PathLike[str], file: str) -> str:
    """What `recording` is of episodes in one of `recordings_at(place)`: its path; in a storage, below the storage."""
    if is_url(name := os.fspath(place)) or not is_storage(root := path_of(name)):
        return file
    return Path(file).relative_to(root).as_posix()


def is_of_several(source: str) -> bool:
    """Whether it is a server, a directory or a pattern, and not the place of one recording."""
    if is_url(source):
        return is_server(source) or is_pattern(source)
    path = path_of(source)
    return is_directory(path) or (glob.has_magic(str(path)) and not is_there(path))


def listed_of(headers: Iterable[EpisodeHeader]) -> Iterator[ListedRecording]:
    """The runs of each recording of a storage that has some episodes, as far as their headers tell; size and state are
    unknown."""
    for name, of_file in by_recording(headers).items():
        runs: dict[Any, list[EpisodeHeader]] = {}
        for header in of_file:
            runs.setdefault((header.run.get("id"), header.run.get("name")), []).append(header)
        for same in runs.values():
            run, ends = Run.of_document(same[0].run, name), [header.created_at for header in same]
            yield _of_run(
                name,
                run,
                lengths=np.array([header.n_tuples for header in same]),
                returns=np.array([header.episode_return for header in same], np.float64),  # None becomes NaN
                said=[found for header in same if (found := success_of(header.metadata)) is not None],
                span=(min(ends), max(ends)),
                size=None,
                benchmark_id=same[0].benchmark_id,
                run_id=run.id,
            )


def by_run(items: Iterable[ListedRecording]) -> list[ListedRecording]:
    """One item for each run, in the order of their first recordings; what has no `run_id` stays as it is.

    A run records into one file after the other, so recordings of it that overlap in time are copies: they are joined
    with other rows, for no row may count an episode twice.
    """
    rows: list[list[ListedRecording]] = []
    runs: dict[str, list[list[ListedRecording]]] = {}
    for item in items:
        same = runs.setdefault(item.run_id, []) if item.run_id else []
        row = next((row for row in same if not any(_overlap(item.span, part.span) for part in row)), [])
        if not row:
            rows.append(row)
            same.append(row)
        row.append(item)
    return [_joined(row) for row in rows]


def _overlap(a: tuple[str, str], b: tuple[str, str]) -> bool:
    return "" < a[0] <= b[1] and b[0] <= a[1]


def _joined(parts: Sequence[ListedRecording]) -> ListedRecording:
    parts = sorted(parts, key=lambda part: (not part.episodes, part.span))  # those without an episode last
    sizes = [part.size for part in parts if part.size is not None]
    counts = ("episodes", "steps", "return_sum", "return_nan", "succeeded", "success_known")
    sums: dict[str, Any] = {name: sum(map(attrgetter(name), parts)) for name in counts}
    return parts[0]._replace(
        paths=tuple(part.path for part in parts),
        size=sum(sizes) if len(sizes) == len(parts) else None,
        state=min((part.state for part in parts), key=_STATES.index),
        started=min((part.started for part in parts if part.started), default=""),
        **sums,
    )


def compactable(root: Path, only: Collection[str] | None = None) -> list[Compactable]:
    """The recordings of a storage, or those of them in `only`, that `FileStorage.compact` would rewrite. Warns of those
    with deleted episodes that are being recorded, which it leaves alone.
    FormatError if a recording with deleted episodes, or its sidecar, is damaged."""
    compactables = []
    for item in sorted(scan(root)):
        path = root / item.relative
        notes = Notes.read(path, root)
        if notes.deleted and (only is None or item.relative in only):
            with contextlib.suppress(RecordingError):  # gone meanwhile
                deleted = notes.about(metadata_at(path)).deleted
                if deleted and is_locked(path):
                    warn(
                        f"{path} is being recorded: its deleted episodes stay in it; compact it when its writer has "
                        "closed it"
                    )
                elif deleted:
                    compactables.append(Compactable(item.relative, len(deleted), item.stamp.size))
    return compactables


def _listed(
    file: str, root: Path | None, choose: Callable[[Recording], Array] | None
) -> list[ListedRecording]:
    """The runs of a recording; without episodes, all of them."""
    name = shown_name(file)
    try:
        notes = None if is_url(file) else Notes.read(Path(file), root)
        with Recording(file) as recording:
            if choose is not None:
                kept = choose(recording)
            else:
                deleted = set() if notes is None else notes.about(recording.metadata).deleted
                kept = np.flatnonzero(~np.isin(recording.index["episode"], list(deleted)))
            runs, places = recording.readable_runs, recording.readable_places[kept]
            listed: list[ListedRecording] = []
            for i in dict.fromkeys(places.tolist()) or range(len(runs)):
                positions = kept[places == i]
                rows = recording.index[positions]
                ends = rows["end_time"]
                listed.append(
                    _of_run(
                        name,
                        runs[i],
                        lengths=rows["length"],
                        returns=rows["return"],
                        said=successes(recording, positions),
                        span=(iso_utc(int(ends.min())), iso_utc(int(ends.max()))) if len(ends) else ("", ""),
                        size=None if listed else recording.size,
                        created_ns=recording.created_ns,
                        benchmark_id=recording.benchmark_id,
                        state=state_of(recording),
                        run_id=runs[i].id if recording.is_recorded else "",
                    )
                )
            return listed
    except (TupliError, OSError) as err:
        return [ListedRecording((name,), error=str(err))]


def _of_run(
    path: str, run: Run, *, lengths: Array, returns: Array, said: Sequence[bool], **more: Any
) -> ListedRecording:
    """What one recording has of a run, from facts about the episodes: steps, returns (float64, NaN if unknown), and
    for those that tell it, whether they succeeded."""
    known = returns[~np.isnan(returns)]
    with np.errstate(invalid="ignore", over="ignore"):  # of infinite returns
        return_sum = float(known.sum())
    return ListedRecording(
        paths=(path,),
        episodes=len(returns),
        steps=int(lengths.sum()),
        return_sum=return_sum,
        return_nan=len(returns) - len(known),
        name=run.name,
        environment=run.environment,
        started=run.started,
        succeeded=sum(said),
        success_known=len(said),
        split=run.split,
        tags=run.tags,
        settings=run.metadata,
        **more,
    )
