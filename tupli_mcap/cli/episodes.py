"""The command episodes, which lists episodes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tupli_mcap.cli.options import (
    ColumnNames,
    Episodes,
    FilterText,
    Json,
    Limit,
    Sort,
    Sources,
    any_storage,
    chosen_ids_of,
    dataset_of,
    filter_of,
    matching_in,
)
from tupli_mcap.cli.output import (
    WHOLE_NAME,
    Column,
    number,
    numbers,
    pairs_of,
    print_json,
    print_table,
    short_ids,
    short_path,
    short_value,
    when,
)
from tupli_mcap.cli.terminal import is_roomy, is_wide
from tupli_mcap.remote import is_server

if TYPE_CHECKING:
    from tupli_mcap.dataset import Dataset
    from tupli_mcap.schema import EpisodeHeader
    from tupli_mcap.storage import TupliStorage


def episodes(
    paths: Sources,
    which: Episodes = None,
    filter_text: FilterText = None,
    sort: Sort = None,
    columns: ColumnNames = None,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """List episodes of files, directories and servers.

    A filter compares keys of episodes (steps, return, end, seed, env, ended, metadata.<name>,
    run.<name>, ...) with = != > >= < <= in, or ~ for a part of a text (run.name ~ "ppo"),
    and joins comparisons with and, or, not. Times are texts such as "2026-11-23",
    "2026-11-23 03:31:07", "yesterday", "last tuesday", "this week" or "7d ago"; a day or a
    week stands for all of it. --sort and --columns take the same keys.
    """
    from tupli_mcap.storage.listing import is_of_several, is_storage

    if which is None and len(paths) == 1 and (is_server(paths[0]) or is_storage(Path(paths[0]))):
        with any_storage(paths[0]) as storage:
            list_stored(storage, filter_text, sort, columns, limit, as_json)
        return
    several, wanted = len(paths) > 1 or is_of_several(paths[0]), filter_of(filter_text)
    dataset = dataset_of(paths)
    found = headers = _sorted(dataset if wanted is None else matching_in(dataset, wanted), sort).headers
    if (ids := chosen_ids_of(paths, which, wanted)) is not None:
        headers = [header for header in found if header.id in ids]
    _print_headers(headers[:limit], columns, among=found, several=several, as_json=as_json)


def list_stored(
    storage: TupliStorage,
    filter_text: str | None,
    sort: str | None,
    columns: str | None,
    limit: int | None,
    as_json: bool,
) -> None:
    from tupli_mcap import open as open_dataset

    wanted = filter_of(filter_text)
    dataset = open_dataset(storage)
    found = _sorted(dataset if wanted is None else dataset.filter(wanted), sort)
    found = found if limit is None else found.head(limit)
    if wanted is not None and not found and limit != 0:
        matching_in(dataset, wanted)
    _print_headers(found.headers, columns, among=found.headers, several=True, as_json=as_json)


def _sorted(dataset: Dataset, sort: str | None) -> Dataset:
    if sort is None:
        return dataset
    return dataset.sort(sort.removeprefix("-"), descending=sort.startswith("-"))


def _print_headers(
    headers: Sequence[EpisodeHeader],
    columns: str | None,
    *,
    among: Sequence[EpisodeHeader],
    several: bool,
    as_json: bool,
) -> None:
    """Prints some of the episodes that were found; `several`: in a place that may have several recordings."""
    if columns is None:
        print_episodes(headers, among, several=several, as_json=as_json)
    else:
        _print_keys(headers, [key.strip() for key in columns.split(",")], as_json=as_json)


def _print_keys(headers: Sequence[EpisodeHeader], keys: Sequence[str], *, as_json: bool) -> None:
    """A column for each key that a filter may name."""
    from tupli_mcap.dataset.keys import check_metadata
    from tupli_mcap.schema import EpisodeHeader, FilterEQ
    from tupli_mcap.schema.facts import path_in
    from tupli_mcap.schema.predicate import MISSING, look_up
    from tupli_mcap.schema.times import TIME_PATHS

    # a run is shown by its name, as in other tables
    paths = [path_in("run.name" if key == "run" else key, EpisodeHeader) for key in keys]
    found = [[look_up(header, path) for path in paths] for header in headers]
    for key, column in zip(keys, zip(*found, strict=True), strict=False):
        if all(value is MISSING for value in column):
            check_metadata(FilterEQ(key=key, value=True), headers)  # may know what is meant
            raise typer.BadParameter(f"no episode has {key}")
    rows = [[None if value is MISSING else value for value in row] for row in found]
    if as_json:
        print_json([dict(zip(keys, row, strict=True)) for row in rows])
        return
    rows = [
        [
            when(value) if path in TIME_PATHS and isinstance(value, str) else value
            for path, value in zip(paths, row, strict=True)
        ]
        for row in rows
    ]
    numeric = [any(isinstance(value, int | float) for value in column) for column in zip(*rows, strict=True)]
    aligned = zip(keys, numeric or [False] * len(keys), strict=True)
    print_table(
        [Column(key.upper(), "right" if is_numeric else "left", shrink="end") for key, is_numeric in aligned],
        [["" if value is None else short_value(value) for value in row] for row in rows],
        empty="no episodes",
        named=True,
    )


def print_episodes(
    headers: Sequence[EpisodeHeader], among: Sequence[EpisodeHeader], *, several: bool, as_json: bool
) -> None:
    if as_json:
        from tupli_mcap.schema import EpisodeHeader, filter_keys
        from tupli_mcap.schema.facts import path_in

        fields = {key: path_in(key, EpisodeHeader)[0] for key in filter_keys(EpisodeHeader)}
        print_json([{key: getattr(header, field) for key, field in fields.items()} for header in headers])
        return
    names = {(header.recording, header.run.get("name", "")) for header in among}
    by_run = len({name for _, name in names}) == len(names) > 0
    roomy = is_roomy()
    least = WHOLE_NAME if roomy else 8
    source = (
        Column("RUN", shrink="end", least=least)
        if by_run
        else Column("RECORDING", shrink="start", least=least)
    )

    def source_of(header: EpisodeHeader) -> str:
        return str(header.run.get("name", "")) if by_run else short_path(header.recording)

    several_envs = any(header.env for header in headers)
    with_times = is_wide() or (roomy and not any(header.metadata for header in headers))
    returns = numbers([header.episode_return for header in headers])
    columns = (
        Column("ID") if several else Column("EPISODE", "right"),
        source,
        Column("ENV", "right"),
        Column("STEPS", "right"),
        Column("RETURN", "right"),
        Column("END"),
        Column("SEED", "right"),
        Column("ENDED"),
        Column("METADATA", shrink="end"),
    )
    rows = [  # a column without any value is not shown
        (
            short_ids(h.id) if several else str(h.episode),
            "" if not several and len(names) == 1 else source_of(h),
            str(h.env) if several_envs else "",
            number(h.n_tuples),
            total,
            h.end,
            "" if h.seed is None else str(h.seed),
            when(h.created_at) if with_times else "",
            pairs_of(h.metadata),
        )
        for h, total in zip(headers, returns, strict=True)
    ]
    print_table(columns, rows, empty="no episodes")
