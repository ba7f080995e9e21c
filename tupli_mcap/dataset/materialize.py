"""Materialising: the columns of a query written to a directory, block after block, and whether they are fresh."""

from __future__ import annotations

import contextlib
import itertools
import secrets
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap.dataset.loading import Selected
from tupli_mcap.dataset.selection import TupleFilter
from tupli_mcap.dataset.sources import DatasetError, Source
from tupli_mcap.dataset.writing import StepsWriter
from tupli_mcap.errors import FormatError, SpaceError, TupliError
from tupli_mcap.materialized import (
    Manifest,
    OpenedColumns,
    SourceFile,
    Stage,
    exclusive,
    open_columns,
    published,
)
from tupli_mcap.messages.common import check_layouts, common_dtype
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.progress import progress
from tupli_mcap.recording.blocks import Array
from tupli_mcap.schema import BaseFilter, EpisodeHeader

__all__ = ["Wanted", "is_current", "is_fresh", "materialized", "unchanged"]


@dataclass(frozen=True)
class Wanted:
    """What is to be materialised. `selected` finds out which steps the tuple filter is true of, `identity` names them
    (see `Steps`)."""

    source: Source
    headers: Sequence[EpisodeHeader]
    benchmark_filter: BaseFilter | None
    episode_filter: BaseFilter | None
    tuple_filter: TupleFilter | None
    selected: Callable[[], Selected]
    identity: Callable[[], str]


def materialized(wanted: Wanted, directory: Path, *, verify: bool = False) -> OpenedColumns:
    """The columns of a query in a directory; they are written unless they are there and fresh.

    Two at once: the second one waits, and finds what the first one has written.

    Raises:
        DatasetError: there is no episode.
        SpaceError: two recordings do not fit into one array.
        StorageError: the directory holds something else, the disk is full, ...
    """
    if not wanted.headers:
        raise DatasetError(
            "expected episodes to materialize, found none; see preview() for what the filters leave"
        )
    try:
        found = open_columns(directory, verify=verify)
        if found is not None and is_fresh(found, wanted):
            return found
    except FormatError as err:
        warnings.warn(f"{err}; this is done now", stacklevel=6)
    with exclusive(directory):
        with contextlib.suppress(FormatError):
            found = open_columns(directory, verify=verify)  # somebody may have written them meanwhile
            if found is not None and is_fresh(found, wanted):
                return found
        recordings, layout = _surveyed(wanted)
        with published(directory) as stage:
            _write(wanted, stage, recordings, layout)
        found = open_columns(directory)
    if found is None:
        raise FormatError(
            f"{directory}: expected the columns just written, found none; something removes them"
        )
    return found


def is_fresh(columns: OpenedColumns, wanted: Wanted) -> bool:
    """Whether columns hold the steps of a query: the same episodes with the same lengths in the same order, the same
    tuple filter, and recordings of the same size and time of change.

    Nobody can compare functions: with one as a tuple filter, columns are fresh for the dataset that wrote them only.
    A recording that was changed without any of this is not noticed.
    """
    manifest = columns.manifest
    return (
        manifest.tuple_function is None
        and not callable(wanted.tuple_filter)
        and manifest.filters.get("tuples") == _json(wanted.tuple_filter)
        and unchanged(columns, wanted.source, wanted.headers)
    )


def is_current(columns: OpenedColumns, directory: Path) -> bool:
    """Whether the columns of a directory are still these, as they were written."""
    try:
        return Manifest.read(directory).token == columns.manifest.token
    except (FileNotFoundError, TupliError):
        return False


def unchanged(columns: OpenedColumns, source: Source, headers: Sequence[EpisodeHeader]) -> bool:
    """Whether the episodes and their recordings are those that the columns were made of."""
    manifest = columns.manifest
    if len(headers) != manifest.episodes or not np.array_equal(_ids(headers), columns.episode_ids):
        return False
    listed = np.fromiter((header.n_tuples for header in headers), np.int64, len(headers))
    if not np.array_equal(listed, columns.recorded_lengths):
        return False
    names = _recordings(headers)
    if len(names) != len(manifest.recordings):
        return False
    return all(
        source.stamp(name) == file.stamp for name, file in zip(names, manifest.recordings, strict=True)
    )


def _recordings(headers: Sequence[EpisodeHeader]) -> list[str]:
    return [name for name, _ in itertools.groupby(header.recording for header in headers)]


def _ids(headers: Sequence[EpisodeHeader]) -> Array:
    return np.array([header.id.encode() for header in headers])


def _json(filter: TupleFilter | None) -> Any:
    return filter.model_dump(mode="json") if isinstance(filter, BaseFilter) else None


# --- what there is ---


def _surveyed(wanted: Wanted) -> tuple[list[SourceFile], StepLayout]:
    """The recordings as they are now, and one layout that holds the steps of all of them."""
    files, layouts = [], []
    for name in _recordings(wanted.headers):
        size, mtime_ns = wanted.source.stamp(name)  # first: what changes from now on makes the columns stale
        with wanted.source.open(name) as recording:
            files.append(SourceFile(name=name, uuid=recording.uuid, size=size, mtime_ns=mtime_ns))
            layouts.append((recording.name, recording.layout))
    return files, _common_layout(layouts)


def _common_layout(layouts: Sequence[tuple[str, StepLayout]]) -> StepLayout:
    (first_name, merged), *others = layouts
    for name, other in others:
        if other.to_metadata() == merged.to_metadata():
            continue
        check_layouts(merged, first_name, other, name)
        spaces = merged.observation_space, merged.action_space, merged.reward_space
        merged = StepLayout(*spaces, *_merged_dtypes(merged, other, name))
    return merged


def _merged_dtypes(
    ours: StepLayout, theirs: StepLayout, name: str
) -> tuple[dict[str, Any], dict[str, dict[str, str]]]:
    """Dtypes, and those inside values of variable size, that hold the numbers of both layouts."""
    dtypes, inner = dict(ours.dtypes), {leaf: dict(found) for leaf, found in ours.inner_dtypes.items()}
    for leaf, other in _pairs(ours, theirs):
        if leaf.name in dtypes:
            dtypes[leaf.name] = _wider(dtypes[leaf.name], theirs.dtypes[other.name], leaf.path, name)
        for path, dtype in theirs.inner_dtypes.get(other.name, {}).items():
            mine = inner.setdefault(leaf.name, {})
            wide = _wider(np.dtype(mine.get(path, dtype)), np.dtype(dtype), leaf.path + path, name)
            mine[path] = wide.name
    return dtypes, inner


def _pairs(ours: StepLayout, theirs: StepLayout) -> list[tuple[Leaf, Leaf]]:
    groups = ((ours.state, theirs.state), (ours.action, theirs.action), (ours.reward, theirs.reward))
    found = []
    for mine, others in groups:
        by_keys = {leaf.keys: leaf for leaf in others}
        found += [(leaf, by_keys[leaf.keys]) for leaf in mine]
    return found


def _wider(a: np.dtype[Any], b: np.dtype[Any], path: str, name: str) -> np.dtype[Any]:
    common = common_dtype(a, b)
    if common is None:
        raise SpaceError(
            f"{path}: expected values that fit into {a.name}, found {b.name} in {name}, which cannot be put into one "
            "array; choose recordings of one kind, with_benchmark_filter(...) for example"
        )
    return common


def _write(wanted: Wanted, stage: Stage, recordings: list[SourceFile], layout: StepLayout) -> None:
    headers = wanted.headers
    total = sum(header.n_tuples for header in headers)
    selected = wanted.selected()
    with (
        StepsWriter(stage.path, layout, headers, selected) as writer,
        progress(total, "Materializing") as bar,
    ):
        for name, group in itertools.groupby(headers, key=lambda header: header.recording):
            with wanted.source.open(name) as recording:
                writer.put(recording, list(group), bar.advance)
        plan, files = writer.finish()
    function = wanted.tuple_filter if callable(wanted.tuple_filter) else None
    stage.manifest = Manifest(
        library=f"tupli-mcap {version('tupli-mcap')}",
        token=secrets.token_hex(16),
        identity=wanted.identity(),
        steps=plan.steps,
        episodes=plan.episodes,
        breaks=plan.breaks,
        spaces=layout.to_metadata(),
        message=None if layout.constant else layout.step_schema,
        filters={
            "benchmarks": _json(wanted.benchmark_filter),
            "episodes": _json(wanted.episode_filter),
            "tuples": _json(wanted.tuple_filter),
        },
        tuple_function=None if function is None else getattr(function, "__qualname__", repr(function)),
        recordings=recordings,
        files=files,
    )
