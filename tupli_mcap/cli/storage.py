"""Commands on storages: list-benchmarks, list-artifacts, list-episodes, compact, reindex."""

from __future__ import annotations

from typing import Annotated

import typer

from tupli_mcap.cli.lists import episodes
from tupli_mcap.cli.options import (
    DEFAULT_STORAGE,
    ColumnNames,
    FilterText,
    Json,
    Limit,
    Sort,
    StoragePath,
    filter_of,
    open_storage,
)
from tupli_mcap.cli.output import (
    Column,
    bytes_of,
    counted,
    number,
    print_json,
    print_table,
    short_ids,
    when,
)
from tupli_mcap.cli.terminal import say, terminal_width

__all__ = ["compact", "list_artifacts", "list_benchmarks", "list_episodes", "reindex"]

_ROOMY = 100  # columns of a terminal on which benchmarks and their environments fit side by side


def list_benchmarks(
    storage_path: StoragePath = DEFAULT_STORAGE, filter_text: FilterText = None, as_json: Json = False
) -> None:
    """List the benchmarks of a storage.

    Filters compare id, environment, created_at, metadata.name, metadata.difficulty, metadata.extra.<name>, ...
    """
    with open_storage(storage_path) as storage:
        headers = storage.list_benchmarks(filter_of(filter_text))
    if as_json:
        print_json([header.model_dump() for header in headers])
        return
    roomy = (terminal_width() or _ROOMY) >= _ROOMY
    columns = (
        Column("ID"),
        Column("NAME", shrink="end"),
        *([Column("ENVIRONMENT", shrink="end")] if roomy else []),
        Column("VERSION"),
        Column("CREATED"),
        Column("DESCRIPTION", shrink="end"),
    )
    rows = [
        (
            short_ids(h.id),
            h.metadata.name,
            *([h.environment] if roomy else []),
            h.metadata.version or "",
            when(h.created_at),
            h.metadata.description,
        )
        for h in headers
    ]
    print_table(columns, rows, empty="no benchmarks")


def list_artifacts(
    storage_path: StoragePath = DEFAULT_STORAGE, filter_text: FilterText = None, as_json: Json = False
) -> None:
    """List the artifacts of a storage.

    Filters compare id, name, description, created_at, extra.<name>, ...
    """
    with open_storage(storage_path) as storage:
        items = storage.list_artifacts(filter_of(filter_text))
    if as_json:
        print_json([item.model_dump() for item in items])
        return
    columns = (
        Column("ID"),
        Column("NAME", shrink="end"),
        Column("CREATED"),
        Column("DESCRIPTION", shrink="end"),
    )
    rows = [(short_ids(item.id), item.name, when(item.created_at), item.description) for item in items]
    print_table(columns, rows, empty="no artifacts")


def list_episodes(
    storage_path: StoragePath = DEFAULT_STORAGE,
    filter_text: FilterText = None,
    sort: Sort = None,
    columns: ColumnNames = None,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """List the episodes of a storage.

    Filters compare id, benchmark_id, recording, steps, return, end, seed, env, ended,
    metadata.<name>, ... with = != > >= < <= in, and join with and, or, not. Times are "2026-11-23",
    "2026-11-23 03:31:07", "yesterday", "7d ago", ...: a text means all of the time that it names.
    """
    with open_storage(storage_path):  # which says where to look, if it is missing
        episodes([storage_path], filter_text, sort, columns, limit, as_json)


def compact(
    storage_path: StoragePath = DEFAULT_STORAGE,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be rewritten.")] = False,
    as_json: Json = False,
) -> None:
    """Free the space of deleted episodes.

    Recordings that hold deleted episodes are rewritten without them, and temporary files that killed processes
    have left are removed.
    Episodes that stay keep their ids. Recordings that are being written are left alone.
    """
    from tupli_mcap.files import left_below
    from tupli_mcap.storage.listing import compactable

    with open_storage(storage_path) as storage:
        recordings = compactable(storage_path)
        left = list(left_below(storage_path))
        freed = 0 if dry_run else storage.compact()
    if as_json:
        print_json({"dry_run": dry_run, "recordings": recordings, "left_over": left, "bytes_freed": freed})
        return
    if dry_run:
        columns = (Column("RECORDING", shrink="start"), Column("DELETED", "right"), Column("SIZE", "right"))
        rows = [(short_ids(i.recording), number(i.deleted), bytes_of(i.size)) for i in recordings]
        if recordings or not left:
            print_table(columns, rows, empty="nothing to compact")
        if left:
            say(f"would remove {counted(len(left), 'temporary file')} of killed processes")
        return
    say(
        f"rewrote {counted(len(recordings), 'recording')}, freed {bytes_of(freed)}"
        if recordings or left
        else "nothing to compact"
    )


def reindex(storage_path: StoragePath = DEFAULT_STORAGE, as_json: Json = False) -> None:
    """Make the catalog of a storage anew.

    The catalog is an index of the recordings, which are the only truth.
    """
    with open_storage(storage_path) as storage:
        storage.reindex()
        count = storage.count_episodes()
    if as_json:
        print_json({"storage": storage_path, "episodes": count})
    else:
        say(f"{storage_path}: {counted(count, 'episode')}")
