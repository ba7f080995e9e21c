"""Commands on storages: delete, restore, compact, list-benchmarks, list-artifacts, list-episodes, rename, reindex,
declare-key."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tupli_mcap.cli.episodes import list_chosen
from tupli_mcap.cli.options import (
    DEFAULT_STORAGE,
    AnyStorage,
    Benchmark,
    ColumnNames,
    DryRun,
    Episodes,
    FilterText,
    Json,
    Limit,
    Sort,
    StoragePath,
    any_storage,
    chosen_in,
    dataset_of,
    filter_of,
    full_id,
    local_path,
    none_in,
    open_storage,
    recordings_of,
)
from tupli_mcap.cli.output import (
    Column,
    number,
    print_facts,
    print_json,
    print_result,
    print_rows,
    print_table,
    short_ids,
    when,
)
from tupli_mcap.cli.terminal import is_roomy, say
from tupli_mcap.errors import Gathered, bytes_of, no_file, plural
from tupli_mcap.remote import is_server

if TYPE_CHECKING:
    from tupli_mcap.schema import BaseFilter
    from tupli_mcap.storage.listing import Compactable


def list_benchmarks(
    place: AnyStorage = None,
    filter_text: Annotated[
        str | None,
        typer.Option(
            "--filter", metavar="FILTER", help="Which benchmarks, such as 'metadata.difficulty = \"hard\"'."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the benchmarks of a storage.

    A filter compares keys: id, environment, created_at, metadata.name, metadata.difficulty,
    metadata.extra.<name>, ...
    """
    with any_storage(place) as storage:
        headers = storage.list_benchmarks(filter_of(filter_text))
    roomy = is_roomy()
    columns = (
        Column("ID"),
        Column("NAME", shrink="end"),
        Column("ENVIRONMENT", shrink="end"),
        Column("VERSION"),
        Column("CREATED"),
        Column("DESCRIPTION", shrink="end"),
    )
    rows = [
        (
            short_ids(h.id),
            h.metadata.name,
            h.environment if roomy else "",
            h.metadata.version or "",
            when(h.created_at),
            h.metadata.description,
        )
        for h in headers
    ]
    print_rows([h.model_dump() for h in headers], columns, rows, empty="no benchmarks", as_json=as_json)


def list_artifacts(
    place: AnyStorage = None,
    filter_text: Annotated[
        str | None,
        typer.Option("--filter", metavar="FILTER", help="Which artifacts, such as 'name = \"wind.csv\"'."),
    ] = None,
    as_json: Json = False,
) -> None:
    """List the artifacts of a storage.

    A filter compares keys: id, name, description, created_at, extra.<name>, ...
    """
    with any_storage(place) as storage:
        items = storage.list_artifacts(filter_of(filter_text))
    columns = (
        Column("ID"),
        Column("NAME", shrink="end"),
        Column("CREATED"),
        Column("DESCRIPTION", shrink="end"),
    )
    rows = [(short_ids(item.id), item.name, when(item.created_at), item.description) for item in items]
    print_rows([item.model_dump() for item in items], columns, rows, empty="no artifacts", as_json=as_json)


def list_episodes(
    place: AnyStorage = None,
    filter_text: FilterText = None,
    sort: Sort = None,
    columns: ColumnNames = None,
    limit: Limit = None,
    as_json: Json = False,
) -> None:
    """List the episodes of a storage.

    --filter, --sort and --columns take the same texts as in tupli-mcap episodes, which also
    lists files and directories.
    """
    from tupli_mcap import open as open_dataset

    with any_storage(place) as storage:
        dataset, wanted = open_dataset(storage), filter_of(filter_text)
        list_chosen(dataset, wanted, None, sort, columns, limit, several=True, as_json=as_json)


_Paths = Annotated[
    list[Path],
    typer.Argument(metavar="PATH", help="Recordings, directories, patterns, storages.", parser=local_path),
]


def delete(
    places: Annotated[
        list[str],
        typer.Argument(metavar="PATH|URL", help="Recordings, directories, patterns, storages, or a server."),
    ],
    episodes: Episodes = None,
    filter_text: FilterText = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Delete episodes; restore brings them back.

    A file beside the recording (FILE.json) lists the deleted episodes; the recording itself
    is not touched until compact frees their space. A copy of the recording without FILE.json
    still shows them. Episodes on a server are gone; their space is freed with the last episode
    of their recording.
    """
    if episodes is None and filter_text is None:
        raise typer.BadParameter("say which episodes: --episodes 3,7 or --filter 'return < 10'")
    if any(map(is_server, places)):
        wanted = filter_of(filter_text)
        if len(places) > 1 or episodes is not None or wanted is None:
            raise typer.BadParameter(
                "name one server alone, and choose its episodes with --filter 'return < 10'"
            )
        chosen = dataset_of(places).filter(wanted)
        ids = [header.id for header in chosen.headers]
        if not ids:
            raise none_in(places, filter_text)
        _check_negated(places, wanted)
        count = chosen.delete(dry_run=dry_run)
    else:
        paths = list(map(local_path, places))
        ids, count = _delete_in_files(paths, episodes, filter_text, dry_run)
    print_result(
        {"dry_run": dry_run, "episodes": ids},
        f"{'would delete' if dry_run else 'deleted'} {plural(count, 'episode')}",
        as_json=as_json,
    )


def _delete_in_files(
    paths: Sequence[Path], episodes: str | None, filter_text: str | None, dry_run: bool
) -> tuple[list[str], int]:
    """Deletes episodes; returns the ids of those that were chosen, and how many were still there."""
    from tupli_mcap.dataset import curate
    from tupli_mcap.dataset.sources import FilesSource
    from tupli_mcap.storage.base import episode_id

    gathered = Gathered()
    doomed = chosen_in(paths, episodes, filter_text, gathered)
    gathered.raise_all()
    if (wanted := filter_of(filter_text)) is not None:
        _check_negated(recordings_of(list(map(str, paths))), wanted)
    ids = [episode_id(uuid, number) for (_, uuid), numbers in doomed.items() for number in numbers]
    return ids, curate.delete(FilesSource(file for file, _ in doomed), doomed, dry_run=dry_run)


def _check_negated(places: Sequence[str], wanted: BaseFilter) -> None:
    """Raises FilterError if a filter with `not` names metadata or parts of runs that no episode has: mistyped, they
    would choose all."""
    from tupli_mcap.dataset.keys import check_metadata, negates

    if negates(wanted):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the same files as before
            headers = dataset_of(places).headers
        check_metadata(wanted, headers)


def restore(
    paths: _Paths,
    episodes: Annotated[
        str | None,
        typer.Option("--episodes", "--episode", "-e", metavar="WHICH", help="Numbers such as 3,7-9, or all."),
    ] = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Bring deleted episodes back, by default all.

    It cannot bring back episodes whose space compact has freed.
    """
    from tupli_mcap.dataset import restore_episodes

    restored = restore_episodes(paths, episodes, dry_run=dry_run)
    print_result(
        {"dry_run": dry_run, "episodes": restored},
        f"{'would restore' if dry_run else 'restored'} {plural(len(restored), 'episode')}",
        as_json=as_json,
    )


def compact(
    given: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PATH", help="Files, directories, storages; by default, --storage.", parser=local_path
        ),
    ] = None,
    storage_path: StoragePath = DEFAULT_STORAGE,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Free the space of deleted episodes.

    Rewrites recordings without their deleted episodes, or removes them if they have no others;
    removes temporary files of killed processes. Episodes that stay keep their ids. Recordings
    that a process is writing to are left alone.
    """
    from tupli_mcap.files import left_below
    from tupli_mcap.storage.listing import compactable

    chosen = _by_storage(given) if given else {storage_path: None}
    recordings: list[Compactable] = []
    left: list[Path] = []
    freed = 0
    for place, only in chosen.items():
        with open_storage(place) as storage:
            found = compactable(place, only)
            if len(chosen) > 1:  # names below a storage do not tell which storage
                found = [item._replace(recording=str(place / item.recording)) for item in found]
            recordings += found
            left += left_below(place)
            freed += 0 if dry_run else storage.compact(only)
    if as_json:
        print_json({"dry_run": dry_run, "recordings": recordings, "left_over": left, "bytes_freed": freed})
        return
    if dry_run:
        columns = (Column("RECORDING", shrink="start"), Column("DELETED", "right"), Column("SIZE", "right"))
        rows = [(short_ids(i.recording), number(i.deleted), bytes_of(i.size)) for i in recordings]
        if recordings or not left:
            print_table(columns, rows, empty="nothing to compact")
        if left:
            say(f"would remove {plural(len(left), 'temporary file')} of killed processes")
        return
    if not (recordings or left):
        say("nothing to compact")
        return
    told = (
        f"freed {bytes_of(freed)}" if freed >= 0 else f"which freed nothing: {bytes_of(-freed)} more are used"
    )
    say(f"compacted {plural(len(recordings), 'recording')}, {told}")


def _by_storage(paths: Sequence[Path]) -> dict[Path, set[str] | None]:
    """The storages of recordings and directories, each with the names of its recordings that are meant; None: all."""
    from tupli_mcap.storage.sidecar import home_of

    found: dict[Path, set[str] | None] = {}
    for path in paths:
        if path.is_dir():
            found[path.absolute()] = None
        elif path.is_file():
            place, name = home_of(path)
            if (names := found.setdefault(place, set())) is not None:
                names.add(name)
        else:
            raise no_file(path, "give a recording (.mcap), a directory or a storage")
    return found


def rename(
    benchmark: Benchmark,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="The new name.")] = None,
    description: Annotated[str | None, typer.Option(help="The new description.")] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Take back the last change.")] = False,
    storage_path: StoragePath = DEFAULT_STORAGE,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Give a benchmark another name or description.

    It keeps its id and its episodes; lists, filters and bundles use the new name. To rename a
    run, use edit.
    """
    if Path(benchmark).is_file():
        raise typer.BadParameter(
            f"{benchmark} is a recording; to rename its run: tupli-mcap edit {benchmark} --name NAME"
        )
    if undo == (name is not None or description is not None):
        raise typer.BadParameter("expected a NAME or --description, or else --undo")
    with open_storage(storage_path) as storage:
        uri = full_id(storage, benchmark)
        if undo:
            header = storage.undo_benchmark_edit(uri, dry_run=dry_run)
        else:
            header = storage.edit_benchmark(uri, name=name, description=description, dry_run=dry_run)
    if as_json:
        print_json({"dry_run": dry_run, "benchmark": header.model_dump()})
        return
    facts = {
        "would change" if dry_run else "benchmark": uri,
        "name": header.metadata.name,
        "description": header.metadata.description,
    }
    print_facts(facts.items())


def reindex(storage_path: StoragePath = DEFAULT_STORAGE, as_json: Json = False) -> None:
    """Rebuild the catalog of a storage.

    The catalog is an index of its episodes, made from the recordings.
    """
    with open_storage(storage_path) as storage:
        storage.reindex()
        count = storage.count_episodes()
    told = {"storage": storage_path, "episodes": count}
    print_result(told, f"{storage_path}: {plural(count, 'episode')}", as_json=as_json)


def declare_key(
    key: Annotated[str, typer.Argument(metavar="KEY", help="Such as metadata.score.")],
    place: AnyStorage = None,
    as_json: Json = False,
) -> None:
    """Make an index of a key of metadata.

    With many thousand episodes, a filter or an order by a key of metadata is slow without
    one. The storage keeps the index up to date.
    """
    with any_storage(place) as storage:
        storage.declare_key(key)
    print_result({"key": key}, f"{key} has an index", as_json=as_json)
