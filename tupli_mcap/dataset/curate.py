"""A recording of some episodes: those that match a filter, or those of a dataset."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tupli_mcap.dataset.sources import DatasetError
from tupli_mcap.dataset.which import candidates
from tupli_mcap.errors import RecordingError
from tupli_mcap.mcap.container import Container
from tupli_mcap.recording import (
    Episode,
    Recording,
    relabel_recording,
    rewrite_recording,
    say_made_of,
    trim_recording,
)
from tupli_mcap.recording.edit.merge import Excerpt, merge_excerpts
from tupli_mcap.recording.edit.replacing import replacing
from tupli_mcap.schema import BaseFilter, parse_filter

if TYPE_CHECKING:
    from tupli_mcap.dataset.dataset import Dataset

__all__ = ["FilterReport", "file_path", "filter_recording", "relabel", "save", "trim"]


class FilterReport(NamedTuple):
    """What a filter kept of a recording, or would keep; `size` in bytes, 0 where nothing was written."""

    path: Path
    episodes: int
    steps: int
    left_out: int
    size: int = 0


def filter_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    filter: BaseFilter | str,
    *,
    compression: str = "zstd",
    overwrite: bool = False,
    dry_run: bool = False,
) -> FilterReport:
    """Writes the episodes that a filter (or its text, such as "metadata.score > 3") is true of to `target`.

    They keep their ids, and all that belongs to them comes along; a signature is left out.

    Raises:
        FilterError: the filter names what episodes do not have.
        RecordingError: it is true of no episode; the target exists (and not `overwrite`) or cannot be written.
        FormatError: the source is damaged.
    """
    target = Path(target)
    wanted = parse_filter(filter) if isinstance(filter, str) else filter
    with Recording(source) as recording:
        if target.exists():
            if recording.path is not None and target.samefile(recording.path):
                raise RecordingError(f"{target} is the recording itself; write to another path")
            if not overwrite:
                raise RecordingError(
                    f"{target} exists; choose another path, or pass overwrite=True (--force)"
                )
        positions = candidates(recording, wanted)
        if not len(positions):
            raise RecordingError(f"{recording.name} has no episode that matches {wanted}")
        rows = recording.index[positions]
        steps, left_out = int(rows["length"].sum()), len(recording) - len(rows)
        report = FilterReport(target, len(rows), steps, left_out)
        if dry_run:
            return report
        said = say_made_of([recording], "filter", query=str(wanted))
        numbers = rows["episode"].tolist()
        rewrite_recording(recording, target, episodes=numbers, attachments=said, compression=compression)
    return report._replace(size=target.stat().st_size)


def file_path(place: str | os.PathLike[str]) -> Path:
    """The path of a new file; DatasetError if it is that of a directory."""
    if os.fspath(place).endswith(os.sep) or Path(place).is_dir():
        raise DatasetError(f"{os.fspath(place)} is a directory; give the path of a file (.mcap)")
    return Path(place)


def save(dataset: Dataset, place: str | os.PathLike[str], *, overwrite: bool) -> Path:
    """See `Dataset.save`."""
    target = file_path(place)
    chosen = dataset._chosen
    if not chosen:
        raise DatasetError("expected episodes to save, found none")
    if target.exists() and not overwrite:
        raise DatasetError(f"{target} exists; choose another path, or pass overwrite=True (--force)")
    sources = [dataset._open(name).path for name in chosen]
    if target.exists() and any(source is not None and target.samefile(source) for source in sources):
        raise DatasetError(f"{target} is one of the recordings themselves; save to another path")
    target.parent.mkdir(parents=True, exist_ok=True)
    if len(chosen) == 1:
        ((name, numbers),) = chosen.items()
        source = dataset._open(name)
        said = say_made_of([source], "filter", **_query_of(dataset))
        rewrite_recording(source, target, episodes=sorted(numbers), attachments=said)
        return target
    excerpts = []
    for name, numbers in chosen.items():
        source = dataset._open(name)
        excerpts.append(Excerpt(source, source.index[np.isin(source.index["episode"], numbers)]))
    with replacing(target) as (fd, _):
        merge_excerpts(excerpts, Container(fd, str(target), "zstd"))
    return target


def relabel(
    dataset: Dataset,
    function: Callable[[Episode], Any],
    target: Path,
    fields: Sequence[str],
    *,
    overwrite: bool,
) -> Path:
    """See `Dataset.map`."""
    make = partial(relabel_recording, function=function, fields=fields)
    return _made_anew(dataset, target, make, overwrite=overwrite)


def trim(
    dataset: Dataset, steps: slice | Callable[[Episode], slice], target: Path, *, overwrite: bool
) -> Path:
    """See `Dataset.trim`."""

    def make(recording: Recording, target: Path, **options: Any) -> None:
        kept = {
            episode.number: steps if isinstance(steps, slice) else steps(episode)
            for episode in recording.episodes
        }
        trim_recording(recording, target, kept, overwrite=True, **options)

    return _made_anew(dataset, target, make, overwrite=overwrite)


def _made_anew(dataset: Dataset, target: Path, make: Callable[..., None], *, overwrite: bool) -> Path:
    """Has `target` made out of one recording that has all episodes of a dataset."""
    if target.exists() and not overwrite:
        raise DatasetError(f"{target} exists; choose another path, or pass overwrite=True (--force)")
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".tupli-", dir=target.parent) as folder:
        chosen = save(dataset, Path(folder) / target.name, overwrite=False)
        with Recording(chosen) as recording:
            sources = [dataset._open(name) for name in dataset._chosen]
            make(recording, target, sources=sources)
    return target


def _query_of(dataset: Dataset) -> dict[str, str]:
    return {} if dataset._filter is None else {"query": str(dataset._filter)}
