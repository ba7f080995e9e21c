"""The command ls, which lists runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from tupli_mcap.cli.options import (
    ColumnNames,
    Episodes,
    FilterText,
    Json,
    Sort,
    any_storage,
    check_there,
    chosen_ids_of,
    filter_of,
)
from tupli_mcap.cli.output import (
    WHOLE_NAME,
    Column,
    number,
    numbers,
    pairs_of,
    print_json,
    print_table,
    short_path,
    when,
)
from tupli_mcap.cli.terminal import fail, is_roomy, is_wide, terminal_width
from tupli_mcap.errors import bytes_of, did_you_mean
from tupli_mcap.remote import is_server, is_url, path_of

if TYPE_CHECKING:
    from tupli_mcap.dataset.which import Positions
    from tupli_mcap.recording import Recording
    from tupli_mcap.schema import BaseFilter
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
    "split": _listed_by(attrgetter("split"), Column("SPLIT", shrink="end")),
    "tags": _listed_by(attrgetter("tags"), Column("TAGS", shrink="end"), ", ".join),
    "settings": _listed_by(
        attrgetter("settings"), Column("SETTINGS", shrink="end"), lambda s: pairs_of(s or {})
    ),
    "paths": _listed_by(attrgetter("paths"), Column("PATHS", shrink="end"), ", ".join),
}
_IN_TABLE: Final = [name for name in _COLUMNS if name not in ("tags", "settings", "paths")]
_BY_NEED: Final = (
    "run", "split", "episodes", "return", "recording", "state", "success", "steps", "started", "environment", "files",
    "size",
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
    limit: Annotated[
        int | None, typer.Option("--limit", "-n", min=1, help="Print at most this many runs.")
    ] = None,
    as_json: Json = False,
) -> None:
    """List runs in files, directories and servers.

    A run that was recorded into several files is one row; a file with several runs has one for
    each, and its size is told with the first. Columns are recording, files, run, environment,
    episodes, steps, return, success, started, size, state, split, tags, settings, paths.
    RECORDING is the first file of the run, in a storage without its folders, which PATHS and
    --json show; FILES is how many there are, if a run has several.
    A narrow terminal shows those that there is room for, RUN first, SIZE last.
    SPLIT appears where a run has one, the last three only with --columns; settings are the
    metadata of the run, and `run.metadata.lr` is one of them. RETURN is the mean over all
    episodes, also interrupted ones. STATE is `complete`; `recording` while a process writes a
    file; `unfinished` if its writer was killed or failed: all finished steps are there;
    `incomplete` if its journal is missing, too. A server does not tell SIZE and STATE. Deleted
    episodes are not counted.
    With --episodes or --filter, only those episodes are counted. A copy of a recording is a row
    of its own; `episodes` lists the episodes of both once.
    """
    from tupli_mcap.storage.listing import by_run

    sources, wanted = paths or ["."], filter_of(filter_text)
    ids = chosen_ids_of(sources, which, wanted)
    listed = by_run(item for source in sources for item in _listed(source, wanted, ids))
    if wanted is not None and not listed:
        check_there(sources, wanted)
    if sort is not None:
        listed = _sorted(listed, _column(sort.removeprefix("-")).value, descending=sort.startswith("-"))
    shown = listed if limit is None else listed[:limit]
    good = [item for item in shown if item.error is None]
    if as_json:
        print_json(_json_of_runs(shown, columns))
    elif good or not listed:
        _print_runs(good, columns, "no recordings" if wanted is None else "no recording matches")
    bad = [item for item in listed if item.error is not None]
    for item in bad:
        fail(item.error or "")
    if bad:
        raise typer.Exit(1)


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
        "split": any(item.split for item in items),
    }
    chosen = []
    for name in _IN_TABLE:
        if shown.get(name, True):
            listed = _COLUMNS[name] if name != "started" or in_a_file else _STARTED_IN_SHORT
            least = WHOLE_NAME if name == "run" and is_roomy() else _LEAST.get(name, 8)
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
