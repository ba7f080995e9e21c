"""Commands that write new recordings out of others: merge, split, filter, trim, relabel."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tupli_mcap.cli.options import (
    DryRun,
    Episodes,
    FilterText,
    Force,
    FunctionName,
    Json,
    Output,
    Sources,
    chosen_ids_of,
    dataset_of,
    filter_of,
    hinting,
    load_function,
    none_in,
    recordings_of,
)
from tupli_mcap.cli.output import Column, number, print_result, print_rows
from tupli_mcap.errors import RecordingError, TupliError, brief, bytes_of, plural
from tupli_mcap.remote import shown_name

if TYPE_CHECKING:
    from tupli_mcap.recording import Episode


def merge(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="PATH|URL", help="Recordings with the same spaces, or directories of them."),
    ],
    output: Output,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of several recordings into one.

    Episodes keep their times, and get new numbers and ids. Recordings that were made at the
    same time, or that have different numbers of sub-environments, become sub-environments of
    the new one. Each episode keeps its run. The new recording has the environment of the
    first one, and no signature.
    """
    from tupli_mcap.dataset import merge_recordings

    report = merge_recordings(recordings_of(sources), output, overwrite=force, dry_run=dry_run)
    _print_made(report, dry_run=dry_run, as_json=as_json)


def split(
    source: Annotated[str, typer.Argument(metavar="FILE|URL", help="A recording.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE", help="The first new recording; others are FILE_0001.mcap, …"
        ),
    ],
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes in each file.")] = None,
    max_bytes: Annotated[int | None, typer.Option(min=1, help="Bytes in each file, roughly.")] = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of a recording into several.

    Episodes stay whole, and keep their numbers. The new recordings have new ids, and no
    signature.
    """
    if (episodes is None) == (max_bytes is None):
        raise typer.BadParameter("expected either --episodes or --max-bytes")
    from tupli_mcap.dataset import split_recording

    found = recordings_of([source])
    if len(found) != 1:
        raise typer.BadParameter(
            f"expected one recording, found {len(found)} at {shown_name(source)}; give one of them"
        )
    parts = split_recording(found[0], output, episodes=episodes, max_bytes=max_bytes, dry_run=dry_run)
    columns = (
        Column("WOULD WRITE" if dry_run else "RECORDING", shrink="start"),
        Column("EPISODES", "right"),
        Column("STEPS", "right"),
    )
    rows = [(str(part.path), number(part.episodes), number(part.steps)) for part in parts]
    told = {"dry_run": dry_run, "recordings": parts}
    print_rows(told, columns, rows, empty="nothing to split", as_json=as_json)


def filter_(
    sources: Sources,
    output: Output,
    episodes: Episodes = None,
    filter_text: FilterText = None,
    sort: Annotated[
        str, typer.Option(metavar="KEY", help="With --limit: by which key; of -return, the best come first.")
    ] = "",
    limit: Annotated[
        int | None, typer.Option("--limit", "-n", min=1, help="Write only the first so many of them.")
    ] = None,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes that you choose into a new file.

    Episodes of one recording keep their ids; those of several get new ones. They lie in the
    order of their times. A signature is dropped.
    """
    from tupli_mcap.dataset.curate import filter_dataset
    from tupli_mcap.schema import FilterIN

    wanted, query = filter_of(filter_text), filter_text or ""
    if (ids := chosen_ids_of(sources, episodes, wanted)) is not None:
        wanted = FilterIN(key="id", value=sorted(ids))
        query = f"episodes {episodes}" if filter_text is None else f"{filter_text}, episodes {episodes}"
    if wanted is None and limit is None:
        raise typer.BadParameter(
            "expected --filter, --episodes or --limit, found none; to copy all episodes, merge them"
        )
    with hinting(sources, wanted):
        report = filter_dataset(
            dataset_of(sources),
            output,
            wanted,
            query=query,
            sort=sort,
            limit=limit,
            overwrite=force,
            dry_run=dry_run,
        )
    _print_made(report, dry_run=dry_run, as_json=as_json)


def trim(
    sources: Sources,
    steps: Annotated[
        str, typer.Option("--steps", metavar="10:-5", help="The steps to keep, as a Python slice.")
    ],
    output: Output,
    episodes: Episodes = None,
    filter_text: FilterText = None,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Cut steps off the ends of episodes, into a new recording.

    10:-5 leaves out the first ten and the last five steps, :200 all steps from 200 on.
    Episodes that are not chosen stay whole, also those of other recordings, so all must have
    the same spaces; to leave episodes out, filter them first. An episode that loses its end
    is marked as interrupted, the state after its last step becomes its final state, and its
    recorded success is dropped. An episode that loses its beginning loses its seed. The new
    recording has a new id, and no signature.
    """
    from tupli_mcap.dataset import curate

    begin, colon, stop = steps.partition(":")
    try:
        kept = slice(int(begin) if begin else None, int(stop) if stop else None)
    except ValueError:
        colon = ""
    if not colon:
        raise typer.BadParameter(f"--steps: expected a slice such as 10:-5, 10: or :200, found {steps!r:.80}")
    dataset, wanted = dataset_of(sources), filter_of(filter_text)
    if (ids := chosen_ids_of(sources, episodes, wanted)) is None:
        ids = {header.id for header in (dataset if wanted is None else dataset.filter(wanted)).headers}
        if not ids:
            raise none_in(sources, filter_text)
    report = curate.trim(dataset, kept, output, chosen=ids, overwrite=force, dry_run=dry_run)
    _print_made(report, dry_run=dry_run, as_json=as_json)


def relabel(
    sources: Sources,
    function: FunctionName,
    output: Output,
    fields: Annotated[
        list[str] | None,
        typer.Option(
            "--field", metavar="FIELD", help="rewards (the default), actions or states. Repeatable."
        ),
    ] = None,
    force: Force = False,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Write a recording with new rewards, actions or states.

    The function takes an episode as `open` gives it, and returns the new column: a value for
    each step, of states one more where there is a final state. With several fields, it
    returns a dict of columns. All else stays: times, frames, infos, seeds, metadata, the
    environment. All episodes are written; to leave some out, filter them first. The new
    recording has a new id, and no signature. A dry run does not call the function.
    """
    from tupli_mcap.dataset import curate

    made = _naming_itself(load_function(function, "function"), function)
    dataset, target = dataset_of(sources), curate.file_path(output)
    report = curate.relabel(dataset, made, target, fields or ["rewards"], overwrite=force, dry_run=dry_run)
    _print_made(report, dry_run=dry_run, as_json=as_json)


def _naming_itself(function: Callable[[Episode], Any], name: str) -> Callable[[Episode], Any]:
    """The function, which raises RecordingError with its name and the episode for what it raises."""

    @functools.wraps(function)
    def call(episode: Episode) -> Any:
        try:
            return function(episode)
        except TupliError:
            raise
        except Exception as err:  # the user's own code may raise anything
            where = f"episode {episode.number} of {shown_name(episode.recording.name)}"
            raise RecordingError(f"the function {name!r} failed at {where}: {brief(err)}") from err

    return call


def _print_made(report: Any, *, dry_run: bool, as_json: bool) -> None:
    size = "" if dry_run else f", {bytes_of(report.size)}"
    would = "would write " if dry_run else ""
    print_result(
        {"dry_run": dry_run, **report._asdict()},
        f"{would}{report.path}: {plural(report.episodes, 'episode')}, {plural(report.steps, 'step')}{size}",
        as_json=as_json,
    )
