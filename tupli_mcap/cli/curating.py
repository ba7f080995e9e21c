"""Commands that make recordings of others: merge, split, filter."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from tupli_mcap.cli.options import Json
from tupli_mcap.cli.output import Column, bytes_of, counted, number, print_json, print_table
from tupli_mcap.cli.terminal import say

__all__ = ["register"]

_Output = Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The new recording (.mcap).")]
_Force = Annotated[bool, typer.Option("--force", help="Replace the output if it exists.")]
_DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be written.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.command("merge")(_merge)
    app.command("split")(_split)
    app.command("filter")(_filter)


def _merge(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE", help="Recordings of the same spaces.", readable=False)
    ],
    output: _Output,
    force: _Force = False,
    dry_run: _DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of several recordings into one.

    They come in the order of their times, and are numbered anew. Of recordings made at the same time, those of the
    later one follow the others, and rows that may not go back in time get a later one; a warning says how many.
    The new recording has ids of its own, the environment of the first one, and no signature.
    """
    from tupli_mcap.recording.edit.merge import merge_recordings

    report = merge_recordings(files, output, overwrite=force, dry_run=dry_run)
    if as_json:
        print_json({"dry_run": dry_run, **_plain(report)})
        return
    _say(report, dry_run)


def _split(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.", readable=False)],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE", help="The first one; FILE_0001.mcap, … follow.")
    ],
    episodes: Annotated[int | None, typer.Option(min=1, help="Episodes in each file.")] = None,
    max_bytes: Annotated[int | None, typer.Option(min=1, help="Bytes of each file, roughly.")] = None,
    dry_run: _DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes of a recording into several.

    Episodes stay whole and keep their numbers; the new recordings have ids of their own, and no signature.
    """
    if (episodes is None) == (max_bytes is None):
        raise typer.BadParameter("expected either --episodes or --max-bytes")
    from tupli_mcap.recording.edit.merge import split_recording

    parts = split_recording(file, output, episodes=episodes, max_bytes=max_bytes, dry_run=dry_run)
    if as_json:
        print_json({"dry_run": dry_run, "recordings": [_plain(part) for part in parts]})
        return
    columns = (Column("RECORDING", shrink="start"), Column("EPISODES", "right"), Column("STEPS", "right"))
    rows = [(str(part.path), number(part.episodes), number(part.steps)) for part in parts]
    print_table(columns, rows, empty="nothing to split")


def _filter(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.", readable=False)],
    filter_text: Annotated[
        str, typer.Argument(metavar="FILTER", help="Such as 'metadata.score > -200 and env = 0'.")
    ],
    output: _Output,
    force: _Force = False,
    dry_run: _DryRun = False,
    as_json: Json = False,
) -> None:
    """Write the episodes that a filter is true of into a file.

    They keep their ids. A signature is left out.
    """
    from tupli_mcap.dataset.curate import filter_recording

    report = filter_recording(file, output, filter_text, overwrite=force, dry_run=dry_run)
    if as_json:
        print_json({"dry_run": dry_run, **_plain(report)})
        return
    _say(report, dry_run)


def _plain(report: Any) -> dict[str, Any]:
    return {**report._asdict(), "path": str(report.path)}


def _say(report: Any, dry_run: bool) -> None:
    size = "" if dry_run else f", {bytes_of(report.size)}"
    would = "would write " if dry_run else ""
    say(f"{would}{report.path}: {counted(report.episodes, 'episode')}, {counted(report.steps, 'step')}{size}")
