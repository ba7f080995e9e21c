"""The commands ls (lists runs) and episodes (lists episodes)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

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
    check_there,
    dataset_of,
    filter_of,
    hinting,
    matching_in,
)
from tupli_mcap.cli.output import (
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
from tupli_mcap.cli.terminal import fail, is_roomy, is_wide, terminal_width
from tupli_mcap.errors import bytes_of, did_you_mean
from tupli_mcap.remote import is_server, is_url, path_of

if TYPE_CHECKING:
    from tupli_mcap.dataset import Dataset
    from tupli_mcap.dataset.which import Positions
    from tupli_mcap.recording import Recording
    from tupli_mcap.schema import BaseFilter, EpisodeHeader
    from tupli_mcap.storage import TupliStorage
    from tupli_mcap.storage.listing import ListedRecording


class _Listed(NamedTuple):
    """A column of `ls`: the value that it is sorted by, and how its cells are made."""

    value: Callable[[ListedRecording], Any]
    column: Column
    cells: Callable[[Sequence[ListedRecording]], list[str]]


def _listed_by(
    value: Callable[[ListedRecording], Any], column: Column, text: Callable[[Any], str] = str
) -> _Listed:
    return _Listed(value, column, lambda items: [text(value(item)) for item in items])


def _means(items: Sequence[ListedRecording]) -> list[str]:
    return numbers([None if r.return_nan == r.episodes else r.return_mean for r in items])


def _success(item: ListedRecording) -> str:
    """The share of successes; with the count of episodes that say it, unless all do."""
    if item.success is None:
        return ""
    known = "" if item.success_known == item.episodes else f" of {number(item.success_known)}"
    return f"{item.success:.0%}{known}"


_COLUMNS = {
    "recording": _listed_by(attrgetter("path"), Column("RECORDING", shrink="start"), short_path),
    "files": _listed_by(attrgetter("files"), Column("FILES", "right"), number),
    "run": _listed_by(attrgetter("name"), Column("RUN", shrink="end")),
    "environment": _listed_by(attrgetter("environment"), Column("ENVIRONMENT", shrink="end")),
    "episodes": _listed_by(attrgetter("episodes"), Column("EPISODES", "right"), number),
    "steps": _listed_by(attrgetter("steps"), Column("STEPS", "right"), number),
    "return": _Listed(attrgetter("return_mean"), Column("RETURN", "right"), _means),
    "success": _Listed(
        attrgetter("success"), Column("SUCCESS", "right"), lambda items: [*map(_success, items)]
    ),
    "started": _listed_by(attrgetter("started"), Column("STARTED"), when),
    "size": _listed_by(
        attrgetter("size"), Column("SIZE", "right"), lambda n: "" if n is None else bytes_of(n)
    ),
    "state": _listed_by(attrgetter("state"), Column("STATE")),
    "split": _listed_by(attrgetter("split"), Column("SPLIT")),
    "tags": _listed_by(attrgetter("tags"), Column("TAGS", shrink="end"), ", ".join),
    "settings": _listed_by(
        attrgetter("settings"), Column("SETTINGS", shrink="end"), lambda s: pairs_of(s or {})
    ),
    "paths": _listed_by(attrgetter("paths"), Column("PATHS", shrink="end"), ", ".join),
}
_IN_TABLE: Final = [name for name in _COLUMNS if name not in ("split", "tags", "settings", "paths")]
_BY_NEED: Final = (
    "run", "episodes", "return", "recording", "state", "success", "steps", "started", "environment", "files", "size"
)  # fmt: skip
"""The columns in the order in which they get room."""
_STARTED_IN_SHORT: Final = _listed_by(  # to the minute, in local time
    attrgetter("started"), Column("STARTED"), lambda text: when(text)[:16]
)
_MEANT = {
    "date": "started",
    "time": "started",
    "created": "started",
    "length": "steps",
    "name": "run",
    "file": "recording",
    "path": "recording",
    "metadata": "settings",
}
"""Other names for columns, for a hint."""
_SETTING = "run.metadata."
_WHOLE_NAME: Final = 32  # characters of a run's name that are not cut where there is room
_LEAST: Final = {"run": 16, "recording": 40, "environment": 16}
"""To how many characters columns may shrink; that of a recording is whole in most cases, to be given to a command."""


def ls(
    paths: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="PATH|URL",
            help="Recordings, directories, patterns, storages, URLs; by default, this directory.",
        ),
    ] = None,
    which: Episodes = None,
    filter_text: FilterText = None,
    sort: Sort = None,
    columns: ColumnNames = None,
    as_json: Json = False,
) -> None:
    """List runs in files, directories and servers.

    A run that was recorded into several files is one row; a file with several runs has one for
    each, and its size is told with the first. Columns are recording, files, run, environment,
    episodes, steps, return, success, started, size, state, split, tags, settings, paths.
    RECORDING is the first file of the run, in a storage without its folders, which PATHS and
    --json show; FILES is how many there are, if a run has several.
    A narrow terminal shows those that there is room for, RUN first, SIZE last.
    The last four appear only with --columns; settings are the metadata of the run, and
    `run.metadata.lr` is one of them. RETURN is the mean over all episodes, also interrupted
    ones. STATE is `complete`; `recording` while a process writes a file; `recovered` if its
    writer was killed or failed: all finished steps are there; `incomplete` if its journal is
    missing, too. A server does not tell SIZE and STATE. Deleted episodes are not counted.
    With --episodes or --filter, only those episodes are counted.
    """
    from tupli_mcap.storage.listing import by_run

    sources, wanted = paths or ["."], filter_of(filter_text)
    ids = _chosen_ids(sources, which, wanted)
    listed = by_run(item for source in sources for item in _listed(source, wanted, ids))
    if wanted is not None and not listed:
        check_there(sources, wanted)
    if sort is not None:
        listed = _sorted(listed, _column(sort.removeprefix("-")).value, descending=sort.startswith("-"))
    good = [item for item in listed if item.error is None]
    if as_json:
        print_json(_json_of_runs(listed, columns))
    elif good or not listed:
        _print_runs(good, columns, "no recordings" if wanted is None else "no recording matches")
    bad = [item for item in listed if item.error is not None]
    for item in bad:
        fail(item.error or "")
    if bad:
        raise typer.Exit(1)


def _chosen_ids(sources: Sequence[str], which: str | None, wanted: BaseFilter | None) -> set[str] | None:
    """The ids of the episodes that --episodes names; None without it."""
    if which is None:
        return None
    from tupli_mcap.dataset.chosen import chosen_ids

    with hinting(sources, wanted):
        return chosen_ids(sources, which, wanted)


def _listed(source: str, wanted: BaseFilter | None, ids: set[str] | None) -> Iterator[ListedRecording]:
    """The recordings of a source, of which the episodes count that match and have one of the `ids`."""
    from tupli_mcap.storage.listing import list_recordings, listed_of

    if is_server(source):
        with any_storage(source) as storage:
            headers = storage.list_episodes(wanted)
        yield from listed_of(header for header in headers if ids is None or header.id in ids)
        return
    choose = None
    if wanted is not None or ids is not None:
        from tupli_mcap.schema import EpisodeHeader, check_keys

        if wanted is not None:
            check_keys(wanted, EpisodeHeader)
        choose = partial(_positions, place=source, wanted=wanted, ids=ids)
    yield from list_recordings([source if is_url(source) else path_of(source)], choose)


def _positions(
    recording: Recording, place: str, wanted: BaseFilter | None, ids: set[str] | None
) -> Positions:
    """The positions of the episodes that match and have one of the `ids`, in a recording that was found at a place."""
    from tupli_mcap.dataset.which import candidates
    from tupli_mcap.storage.base import episode_id
    from tupli_mcap.storage.listing import name_at

    found = candidates(recording, wanted, name_at(place, recording.name))
    if ids is None:
        return found
    numbers = recording.index["episode"][found].tolist()
    return found[[episode_id(recording.uuid, number) in ids for number in numbers]]


def _sorted(
    items: Sequence[ListedRecording], value: Callable[[ListedRecording], Any], *, descending: bool
) -> list[ListedRecording]:
    """Sorts runs by a value, texts after numbers; those without one, and unreadable ones, come last."""

    def key(item: ListedRecording) -> Any:
        found = value(item)
        if item.error or found is None or (isinstance(found, float) and math.isnan(found)):
            return None
        if isinstance(found, dict):
            return 1, pairs_of(found)
        if isinstance(found, int | float):
            return 0, found
        return 1, found if isinstance(found, str) else _text(found)

    known = [item for item in items if key(item) is not None]
    return [*sorted(known, key=key, reverse=descending), *(item for item in items if key(item) is None)]


def _column(name: str) -> _Listed:
    from tupli_mcap.schema import split_key
    from tupli_mcap.schema.facts import LISTED_AS

    if name.startswith(_SETTING):
        value = partial(_setting, split_key(name)[2:])
        return _listed_by(value, Column(name.upper()), _text)
    key = LISTED_AS.get(name.lower(), name.lower())
    if key not in _COLUMNS:
        similar = did_you_mean(_MEANT.get(name, name), list(_COLUMNS))
        similar = similar or f" (your own: {_SETTING}{name:.40})"
        raise typer.BadParameter(
            f"there is no column {name!r}{similar}; columns are {', '.join(_COLUMNS)}, {_SETTING}KEY"
        )
    return _COLUMNS[key]


def _text(value: Any) -> str:
    from tupli_mcap.jsonvalue import spelled

    return "" if value is None else spelled(value)


def _setting(path: Sequence[str], item: ListedRecording) -> Any:
    """A value in the settings of a run."""
    found: Any = item.settings
    for part in path:
        found = found.get(part) if isinstance(found, dict) else None
    return found


def _chosen_columns(text: str | None, items: Sequence[ListedRecording]) -> list[_Listed]:
    if text is not None:
        return [_column(name.strip()) for name in text.split(",")]
    wide, in_a_file = is_wide(), terminal_width() is None
    shown = {
        "files": any(item.files > 1 for item in items),
        "size": wide,
        "state": wide or any(item.state != "complete" for item in items),
    }
    chosen = []
    for name in _IN_TABLE:
        if shown.get(name, True):
            listed = _COLUMNS[name] if name != "started" or in_a_file else _STARTED_IN_SHORT
            least = _WHOLE_NAME if name == "run" and is_roomy() else _LEAST.get(name, 8)
            column = listed.column._replace(least=least, rank=_BY_NEED.index(name))
            chosen.append(listed._replace(column=column))
    return chosen


def _json_of_runs(items: Sequence[ListedRecording], columns: str | None) -> list[dict[str, Any]]:
    """The chosen columns of runs, or all fields."""
    from tupli_mcap.schema.times import iso_utc

    if columns is not None:
        names = [name.strip() for name in columns.split(",")]
        values = {name if name.startswith(_SETTING) else name.lower(): _column(name).value for name in names}
        return [{name: value(item) for name, value in values.items()} for item in items]
    return [
        {
            **{name: listed.value(item) for name, listed in _COLUMNS.items()},
            "return_nan": item.return_nan,
            "created_at": iso_utc(item.created_ns) if item.created_ns else None,
            "benchmark_id": item.benchmark_id,
            "error": item.error,
        }
        for item in items
    ]


def _print_runs(items: Sequence[ListedRecording], names: str | None, empty: str) -> None:
    from tupli_mcap.recording.describe.description import nan_text

    chosen = _chosen_columns(names, items)
    columns, cells = [one.column for one in chosen], [one.cells(items) for one in chosen]
    notes = [nan_text(r.return_nan, r.episodes) for r in items]
    if any(notes) and any(column.title == "RETURN" for column in columns):
        columns.append(Column("NOTE ON RETURN", shrink="end"))
        cells.append(notes)
    print_table(columns, list(zip(*cells, strict=True)), empty=empty, named=names is not None)


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
    found = headers = _headers_of(dataset_of(paths), wanted, sort)
    if (ids := _chosen_ids(paths, which, wanted)) is not None:
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
    if sort is None:  # the storage stops at the limit
        headers: Sequence[EpisodeHeader] = storage.list_episodes(wanted, limit=limit)
        if wanted is not None and not headers and limit != 0:
            matching_in(open_dataset(storage), wanted)
    else:
        headers = _first_in_order(storage, wanted, sort, limit) or _headers_of(
            open_dataset(storage), wanted, sort
        )
    _print_headers(headers[:limit], columns, among=headers[:limit], several=True, as_json=as_json)


def _first_in_order(
    storage: TupliStorage, wanted: BaseFilter | None, sort: str, limit: int | None
) -> Sequence[EpisodeHeader]:
    """The first episodes in an order that a directory's catalog has an index of, without a look at the others; none if
    it has none, or no episode is found."""
    from tupli_mcap.storage import FileStorage
    from tupli_mcap.storage.catalog.order import Sort, has_index
    from tupli_mcap.storage.catalog.queries import find_episodes

    order = Sort.parse(sort)
    if order is None or limit is None or not isinstance(storage, FileStorage) or not has_index(order, {}):
        return ()
    return storage.ask(lambda connection: list(find_episodes(connection, wanted, limit=limit, sort=order)))


def _headers_of(dataset: Dataset, wanted: BaseFilter | None, sort: str | None) -> Sequence[EpisodeHeader]:
    found = dataset if wanted is None else matching_in(dataset, wanted)
    if sort is not None:
        found = found.sort(sort.removeprefix("-"), descending=sort.startswith("-"))
    return found.headers


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
    least = _WHOLE_NAME if roomy else 8
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
