"""The command plot: a report of recordings as a picture or a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import FilterText, Json, filter_of
from tupli_mcap.cli.output import bytes_of, counted, print_json
from tupli_mcap.cli.terminal import say
from tupli_mcap.errors import RecordingError

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command("plot")(_plot)


def _plot(
    paths: Annotated[
        list[str], typer.Argument(metavar="FILE|STORAGE", help="Recordings, directories, storages, URLs.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="A .png, .svg or .html; by default FILE's name with .png."
        ),
    ] = None,
    episode: Annotated[
        str,
        typer.Option(
            metavar="N|best|worst|...", help="Whose steps to show: a number, best, worst, first, last."
        ),
    ] = "best",
    filter_text: FilterText = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the output if it is there.")] = False,
    as_json: Json = False,
) -> None:
    """Draw a report of recordings as a picture or a page.

    Returns, lengths, states, actions, rewards, and one episode step by step. Several recordings are compared.
    The extension of the output says what it is; an .html needs no network. Needs the extra plot (matplotlib).
    Nothing in a file is executed.
    """
    from tupli_mcap.plots import check_goal, report

    goal = output or Path(f"{Path(paths[0]).resolve().stem if len(paths) == 1 else 'report'}.png")
    try:
        check_goal(goal, overwrite=force)
    except RecordingError as err:
        raise type(err)(str(err).replace("overwrite it", "replace it with --force")) from err
    made = report(paths, episode=episode, episode_filter=filter_of(filter_text))
    made.save(goal, overwrite=force)
    size = goal.stat().st_size
    episodes, steps = (
        sum(counts) for counts in zip(*((len(m.rows), m.steps) for m in made.measured), strict=True)
    )
    if as_json:
        told = {"path": str(goal), "size": size, "recordings": len(made.measured), "episodes": episodes}
        print_json({**told, "steps": steps, "notes": made.notes})
    else:
        say(f"{goal}: {counted(episodes, 'episode')}, {counted(steps, 'step')}, {bytes_of(size)}")
