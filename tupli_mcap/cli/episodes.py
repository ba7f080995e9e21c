"""The command episodes, which lists episodes."""

from __future__ import annotations

from collections.abc import Sequence
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

if TYPE_CHECKING:
    from tupli_mcap.dataset import Dataset
    from tupli_mcap.schema import BaseFilter, EpisodeHeader


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
    from tupli_mcap.storage.listing import is_of_several

    several, wanted = len(paths) > 1 or is_of_several(paths[0]), filter_of(filter_text)
    ids = chosen_ids_of(paths, which, wanted)
    list_chosen(dataset_of(paths), wanted, ids, sort, columns, limit, several=several, as_json=as_json)


def list_chosen(
    dataset: Dataset,
    wanted: BaseFilter | None,
    ids: set[str] | None,
    sort: str | None,
    columns: str | None,
    limit: int | None,
    *,
    several: bool,
    as_json: bool,
) -> None:
    """Prints the episodes that match and have one of the `ids`; `several`: of a place that may have several
    recordings."""
    found = dataset if wanted is None else dataset.filter(wanted)
    if sort is not None:
        found = found.sort(sort.removeprefix("-"), descending=sort.startswith("-"))
    if ids is not None:
        found = found[[header.id in ids for header in found.headers]]
    if limit is not None:
        found = found.head(limit)
    if wanted is not None and not found and limit != 0:
        matching_in(dataset, wanted)
    if columns is None:
        print_episodes(found.headers, several=several, as_json=as_json)
    else:
        _print_keys(found.headers, [key.strip() for key in columns.split(",")], as_json=as_json)


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


def print_episodes(headers: Sequence[EpisodeHeader], *, several: bool, as_json: bool) -> None:
    if as_json:
        from tupli_mcap.schema import EpisodeHeader, filter_keys
        from tupli_mcap.schema.facts import path_in

        fields = {key: path_in(key, EpisodeHeader)[0] for key in filter_keys(EpisodeHeader)}
        print_json([{key: getattr(header, field) for key, field in fields.items()} for header in headers])
        return
    names = {(header.recording, header.run.get("name", "")) for header in headers}
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
