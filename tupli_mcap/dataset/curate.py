"""Writes a recording of some episodes, or of what can be saved; deletes episodes, and brings them back."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from tupli_mcap import files
from tupli_mcap.dataset.items import ListedEpisodes
from tupli_mcap.dataset.items.index import positions_of
from tupli_mcap.dataset.sources import DatasetError, Episodes, EpisodeSource, numbers_by_recording
from tupli_mcap.dataset.which import bounds_of, candidates, range_text
from tupli_mcap.errors import FormatError, RecordingError, taken
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.source import OpenFiles
from tupli_mcap.recording import (
    Episode,
    MergeReport,
    Part,
    Recording,
    RecoveryReport,
    rewrite_recording,
    say_made_of,
)
from tupli_mcap.recording.columns.fields import field_names
from tupli_mcap.recording.edit import merge, split
from tupli_mcap.recording.edit.annotate import change_all
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.merge import Excerpt, check_mergeable, merge_excerpts
from tupli_mcap.recording.edit.relabel import FIELDS, relabel_excerpts
from tupli_mcap.recording.edit.repair import recover
from tupli_mcap.recording.edit.rewrite import warn_of_signatures
from tupli_mcap.recording.edit.trim import bounds_of_slice, trims_of
from tupli_mcap.recording.index import whole_numbers
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.recording.write.options import check_name
from tupli_mcap.remote import path_of
from tupli_mcap.schema import BaseFilter
from tupli_mcap.storage.base import by_recording
from tupli_mcap.storage.listing import recordings_at
from tupli_mcap.storage.sidecar import Notes, Sidecar, home_of

if TYPE_CHECKING:
    from tupli_mcap.recording.about.annotations import Annotation
    from tupli_mcap.storage import FileStorage, TupliStorage


_MAX_QUERY: Final = 10_000  # characters


class FilterReport(NamedTuple):
    """The result of filtering a dataset, or of a dry run; `size` of the file in bytes, 0 if none was written."""

    path: Path
    episodes: int
    steps: int
    left_out: int
    size: int = 0


class TrimReport(NamedTuple):
    """The result of a trim, or of a dry run: `left_out` steps; `size` of the file in bytes, 0 if none was written."""

    path: Path
    episodes: int
    steps: int
    left_out: int
    size: int = 0


class RelabelReport(NamedTuple):
    """The result of `relabel`, or of a dry run; `size` of the file in bytes, 0 if none was written."""

    path: Path
    episodes: int
    steps: int
    size: int = 0


def merge_recordings(
    sources: Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    *,
    compression: str = "zstd",
    overwrite: bool = False,
    dry_run: bool = False,
) -> MergeReport:
    """`tupli_mcap.recording.merge_recordings` without the episodes that a storage has deleted.

    Args:
        sources: paths of the recordings.
        target: path of the new one.
        compression: "zstd", "lz4" or "none".
        overwrite: replace a target that exists.
        dry_run: only check and report.
    """
    return merge.merge_recordings(
        sources, target, compression=compression, overwrite=overwrite, dry_run=dry_run, positions=candidates
    )


def split_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    episodes: int | None = None,
    max_bytes: int | None = None,
    compression: str = "zstd",
    dry_run: bool = False,
) -> list[Part]:
    """`tupli_mcap.recording.split_recording` without the episodes that a storage has deleted.

    Args:
        source: path of the recording.
        target: path of the first file; target_0001, … are beside it.
        episodes: number of episodes in each file.
        max_bytes: or the size of each file, which has at least one episode.
        compression: "zstd", "lz4" or "none".
        dry_run: only report.
    """
    return split.split_recording(
        source, target, episodes=episodes, max_bytes=max_bytes, compression=compression, dry_run=dry_run,
        positions=candidates,
    )  # fmt: skip


def recover_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str] | None = None,
    *,
    overwrite: bool = False,
    dry_run: bool = False,
    compression: str = "zstd",
) -> RecoveryReport:
    """`tupli_mcap.recording.recover_recording`; episodes that a storage has deleted are deleted in the new file, too.

    `restore_episodes` brings them back there, as in the source. Raises StorageError, too, if the notes beside the new
    file cannot be written.

    Args:
        source: path of the damaged recording, which is only read.
        target: path of the new one; by default `<name>.recovered.mcap` beside the source.
        overwrite: replace a target that exists.
        dry_run: only report.
        compression: "zstd", "lz4" or "none".
    """
    notes = Notes.read(path_of(source))
    report = recover.recover_recording(
        source, target, overwrite=overwrite, dry_run=dry_run, compression=compression
    )
    if report.target is None:
        return report
    try:
        deleted = notes.about(metadata_at(Path(source))).deleted
    except FormatError:  # what the notes are about is lost
        deleted = notes.deleted
    with Recording(report.target) as made:
        parts = {cut.becomes for cut in report.cut if cut.episode in deleted}
        kept = (deleted | parts).intersection(made.index["episode"].tolist())
        Sidecar(uuid=made.uuid, deleted=kept).write(Path(report.target))
    return report


def filter_dataset(
    dataset: Episodes,
    target: str | os.PathLike[str],
    filter: BaseFilter | str | None,
    *,
    query: str = "",
    sort: str = "",
    limit: int | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> FilterReport:
    """Writes the episodes of a dataset that a filter is true of, or all, to `target`, as `Dataset.save` does.

    Args:
        query: what `made_of.json` and errors say in place of the filter.
        sort, limit: only the first `limit` of them in the order of a key; of "-return", the highest returns come first.

    Raises:
        FilterError: the filter names what episodes do not have.
        RecordingError: it is true of no episode, or as `Dataset.save`.
        DatasetError: as `Dataset.save`.
    """
    target, count = file_path(target), len(dataset)
    kept = dataset if filter is None else dataset.filter(filter)
    if not len(kept):
        which = "an episode" if filter is None else f"an episode that matches {query or str(filter)}"
        raise RecordingError(f"expected {which}, found none among {count:,}")
    if query:
        kept.chosen_by = (*dataset.chosen_by, query)
    if sort:
        kept = kept.sort(sort.removeprefix("-"), descending=sort.startswith("-"))
    if limit is not None:
        kept = kept.head(limit)
    _check_new(kept, target, overwrite=overwrite)
    report = FilterReport(target, len(kept), kept.n_steps, count - len(kept))
    if dry_run:
        check_mergeable(_excerpts(kept))
        return report
    return report._replace(size=save(kept, target, overwrite=overwrite).stat().st_size)


def trim(
    dataset: Episodes,
    steps: slice | Callable[[Episode], slice],
    target: str | os.PathLike[str],
    *,
    chosen: Collection[str] | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
) -> TrimReport:
    """See `Dataset.trim`; raises as that does. `chosen`: the ids of the episodes that lose `steps`, which is a slice
    then; the others stay whole."""
    target = file_path(target)
    _check_new(dataset, target, overwrite=overwrite)
    kept: dict[str, dict[int, slice]] = {name: {} for name in by_recording(dataset.headers)}
    excerpts = _excerpts(dataset)
    lengths = {  # as they are now: one that was still being recorded may have grown since it was listed
        (name, int(row["episode"])): int(row["length"])
        for name, excerpt in zip(kept, excerpts, strict=True)
        for row in excerpt.rows
    }
    episodes, left_out = iter(dataset), 0
    for header in dataset.headers:
        if chosen is not None and header.id not in chosen:
            continue
        part = steps(next(episodes)) if callable(steps) else steps
        if not isinstance(part, slice):
            raise DatasetError(f"expected a slice of the steps of episode {header.id}, found {part!r:.80}")
        length = lengths[header.recording, header.episode]
        left = len(range(*bounds_of_slice(part, length)))
        if not left:
            raise RecordingError(
                f"{header.recording}: expected a step of episode {header.episode} to stay, found none of its "
                f"{length}; choose other steps, or other episodes"
            )
        kept[header.recording][header.episode] = part
        left_out += length - left
    report = TrimReport(target, len(dataset), sum(lengths.values()) - left_out, left_out)
    if dry_run:
        check_mergeable(excerpts)
        return report
    trimmed = [
        excerpt._replace(trims=trims_of(excerpt.recording, kept[name]))
        for name, excerpt in zip(kept, excerpts, strict=True)
    ]
    with replacing(target, overwrite=overwrite) as (fd, _):
        made = {"how": "trim", **_chosen_by(dataset)}
        merge_excerpts(trimmed, Container(fd, str(target), "zstd"), made=made)
    return report._replace(size=target.stat().st_size)


def _excerpts(dataset: Episodes) -> list[Excerpt]:
    """The episodes of a dataset, by recording, to make another one of; warns if one is signed. NotFoundError if a
    recording has not all of them any more."""
    found, listed = [], by_recording(dataset.headers)
    some_open = OpenFiles(copies=True)  # they may be more than can be open at once
    for name, recording in dataset.opened():
        if recording.path is not None:
            recording = Recording(some_open.file(recording.file.source))
        positions = positions_of(recording, ListedEpisodes.of(name, listed[name]))
        found.append(Excerpt(recording, recording.index[np.sort(positions)]))
    warn_of_signatures(excerpt.recording for excerpt in found)
    return found


def _chosen_by(dataset: Episodes) -> dict[str, str]:
    """How the episodes were chosen, for `made_of.json`; empty if they are all."""
    query = "; ".join(dataset.chosen_by)
    return {"query": query if len(query) <= _MAX_QUERY else f"{query[:_MAX_QUERY]}…"} if query else {}


def file_path(place: str | os.PathLike[str]) -> Path:
    """The path of a new file. DatasetError if it is a directory, RecordingError if its name does not end in .mcap."""
    if os.fspath(place).endswith(os.sep) or files.is_directory(place):
        raise DatasetError(f"{os.fspath(place)} is a directory; give the path of a file (.mcap)")
    check_name(place)
    return Path(place)


def _check_new(dataset: Episodes, target: Path, *, overwrite: bool) -> None:
    """Raises DatasetError if there is no episode, one occurs twice, or the target exists: one of the sources, or not to
    be replaced."""
    if not len(dataset):
        raise DatasetError("expected episodes to save, found none")
    ((header, times),) = Counter(header.id for header in dataset.headers).most_common(1)
    if times > 1:
        raise DatasetError(
            f"expected each episode once, as a recording holds it, found {header} {times} times; "
            "leave out repeated ones to save the others"
        )
    if not target.exists():
        return
    if any(files.is_same(target, recording.path) for _, recording in dataset.opened()):
        raise DatasetError(f"{target} is one of the recordings themselves; save to another path")
    if not overwrite:
        raise DatasetError(taken(target))


def save(dataset: Episodes, place: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """See `Dataset.save`."""
    target = file_path(place)
    _check_new(dataset, target, overwrite=overwrite)
    facts: dict[str, Any] = _chosen_by(dataset)
    excerpts = _excerpts(dataset)
    if len(excerpts) == 1:
        ((source, rows, *_),) = excerpts
        said = say_made_of([source], "filter", **facts)
        numbers = rows["episode"].tolist()
        rewrite_recording(source, target, episodes=numbers, attachments=said, overwrite=overwrite)
        if Notes.read(target).deleted:  # the episodes keep their ids, and were deleted in an earlier file
            restore_episodes(target)
        return target
    made = {"how": "filter" if facts else "merge", **facts}
    with replacing(target, overwrite=overwrite) as (fd, _):
        merge_excerpts(excerpts, Container(fd, str(target), "zstd"), made=made)
    return target


def relabel(
    dataset: Episodes,
    function: Callable[[Episode], Any],
    target: Path,
    fields: Sequence[str],
    *,
    overwrite: bool,
    dry_run: bool = False,
) -> RelabelReport:
    """See `Dataset.map`. A dry run does not call the function."""
    _check_new(dataset, target, overwrite=overwrite)
    report = RelabelReport(target, len(dataset), sum(header.n_tuples for header in dataset.headers))
    made, excerpts = _chosen_by(dataset), _excerpts(dataset)
    if dry_run:
        field_names(fields, FIELDS)
        check_mergeable(excerpts)
        return report
    relabel_excerpts(excerpts, target, function, fields, made, overwrite=overwrite)
    return report._replace(size=target.stat().st_size)


def annotate(dataset: Episodes, values: Mapping[str, Any]) -> None:
    """See `Dataset.annotate`."""
    for key, value in values.items():
        if isinstance(value, np.ndarray) and value.shape[:1] == (len(dataset),) and len(dataset) > 1:
            raise RecordingError(
                f"{key}: expected one value for all episodes, found an array of {len(dataset)}, as there are episodes; "
                "give each its own by episode.annotate, or all of them the whole list by .tolist()"
            )
    numbers, recordings = numbers_by_recording(dataset.headers), _recordings_of(dataset)

    def change(name: str, dry: bool) -> None:
        recordings[name].annotate_numbers(numbers[name], values, dry_run=dry)

    change_all(recordings, change, dry_run=False)
    _read_metadata_again(dataset, recordings)


def undo_annotation(dataset: Episodes) -> list[Annotation]:
    """See `Dataset.undo_annotation`."""
    noted = {name: one for name, one in _recordings_of(dataset).items() if one.annotations.said}
    if not noted:
        raise RecordingError(
            "expected an annotation to take back, found none in the recordings of the dataset"
        )
    found = change_all(noted, lambda name, dry: noted[name].undo_annotation(dry_run=dry), dry_run=False)
    _read_metadata_again(dataset, noted)
    return found


def _recordings_of(dataset: Episodes) -> dict[str, Recording]:
    """The recordings to change, by name. NotFoundError if one has not all of the listed episodes any more, as one that
    has taken the place of another."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # to list the episodes gave the same ones
        found = dict(dataset.opened())
    listed = by_recording(dataset.headers)
    for name, recording in found.items():
        positions_of(recording, ListedEpisodes.of(name, listed[name]))
    return found


def _read_metadata_again(dataset: Episodes, recordings: Mapping[str, Recording]) -> None:
    """Gives the dataset's episodes of these recordings the metadata that they have now."""
    listed = by_recording(dataset.headers)
    for name, recording in recordings.items():
        positions = positions_of(recording, ListedEpisodes.of(name, listed[name]))
        for header, position in zip(listed[name], positions.tolist(), strict=True):
            header.metadata = recording.episode_metadata(position)


def delete(
    source: EpisodeSource, by_recording: Mapping[tuple[str, str], Collection[int]], *, dry_run: bool = False
) -> int:
    """Deletes episodes by their numbers; returns how many were still there, or would be deleted.

    Args:
        by_recording: numbers of episodes, by the recording's name in the source, and its UUID.

    Raises as `Dataset.delete`.
    """
    by_storage: dict[TupliStorage, dict[tuple[str, str], Collection[int]]] = {}
    for (name, uuid), numbers in by_recording.items():
        storage, known_as = source.home_of(name)
        by_storage.setdefault(storage, {})[known_as, uuid] = numbers
    if dry_run or len(by_storage) > 1:  # if one refuses, none deletes
        count = sum(storage.delete_numbers(d, dry_run=True) for storage, d in by_storage.items())
    if dry_run:
        return count
    return sum(storage.delete_numbers(doomed) for storage, doomed in by_storage.items())


def restore_episodes(
    places: str | os.PathLike[str] | Iterable[str | os.PathLike[str]],
    episodes: str | Collection[int] | None = None,
    *,
    dry_run: bool = False,
) -> list[str]:
    """Brings deleted episodes back, and returns their ids.

    Those whose space `compact` has freed, and those on a server cannot be restored.

    Args:
        places: the paths of recordings, directories and storages.
        episodes: their numbers, such as `[3, 7]` or "3,7-9"; by default, or if "all", all that are deleted.
        dry_run: only return the ids.

    Raises:
        RecordingError: there is no such path, a path has no such deleted episode, or one is no number; then none is
            restored.
        FilterError: the text is something else.
        StorageError: the notes beside a recording cannot be written.
    """
    if not isinstance(episodes, str | None):
        numbers = whole_numbers(episodes)
        if not numbers:
            return []
        episodes = ",".join(map(str, numbers))
    items = [] if episodes is None or episodes == "all" else episodes.split(",")
    bounds = {item.strip(): bounds_of(item.strip(), str(episodes), ["all"]) for item in items}
    found = [
        part
        for place in ([places] if isinstance(places, str | os.PathLike) else places)
        for part in _deleted_at(place, bounds)
    ]
    if not dry_run:
        for storage, recordings, ids in found:
            storage.restore_episodes(ids, recordings)
    return list(dict.fromkeys(one for _, _, ids in found for one in ids))


def _deleted_at(
    place: str | os.PathLike[str], bounds: Mapping[str, tuple[int, int]]
) -> list[tuple[FileStorage, set[str], list[str]]]:
    """The storages of the recordings at a path, the names of these, and the ids of their deleted episodes.

    `bounds`: if there are any, only episodes whose number is within one of them. RecordingError if a path has none that
    is within one of them; the key names it.
    """
    from tupli_mcap.storage import FileStorage

    by_root: dict[Path, set[str]] = {}
    for root, name in map(home_of, map(Path, recordings_at(place))):
        by_root.setdefault(root, set()).add(name)
    found = []
    numbers: set[int] = set()
    for root, recordings in by_root.items():
        storage = FileStorage(root)
        deleted = {one: int(one.rpartition("-")[2]) for one in storage.deleted_episodes(recordings)}
        numbers.update(deleted.values())
        chosen = [
            one
            for one, number in deleted.items()
            if not bounds or any(low <= number <= high for low, high in bounds.values())
        ]
        found.append((storage, recordings, chosen))
    for item, (low, high) in bounds.items():
        if not any(low <= number <= high for number in numbers):
            known = f"choose from {range_text(sorted(numbers))}" if numbers else "none can be restored"
            raise RecordingError(f"{place} has no deleted episode {item}; {known}")
    return found
