"""The command replay: recordings in the Rerun viewer."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from tupli_mcap.cli.options import FilterText, filter_of
from tupli_mcap.cli.output import bytes_of

__all__ = ["register"]


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command("replay")(_replay)


def _replay(
    sources: Annotated[
        list[str], typer.Argument(metavar="PATH...", help="Recordings, URLs, directories of a storage.")
    ],
    episode: Annotated[
        str | None,
        typer.Option(
            "--episode", "-e", metavar="WHICH", help="Such as 3,7,9, best, worst, first, last, all."
        ),
    ] = None,
    filter_text: FilterText = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Overlay the episodes in the same plots.")
    ] = False,
    split: Annotated[
        bool,
        typer.Option(
            "--split/--joined", help="Each episode as a recording of its own, or all on one timeline."
        ),
    ] = False,
    save: Annotated[
        Path | None, typer.Option("--save", metavar="FILE.rrd", help="Write a file for the viewer instead.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Serve a viewer for the browser, on 127.0.0.1, until Ctrl-C.")
    ] = False,
    connect: Annotated[
        str | None,
        typer.Option(
            "--connect", metavar="URL", help="Send to a viewer that runs: rerun+http://HOST:PORT/proxy."
        ),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it exists.")] = False,
) -> None:
    """Look at recordings in the Rerun viewer.

    States, actions, rewards, infos and images over time, all episodes in an overview. Needs the extra `rerun`.
    Timelines: step, episode_time (where the recording knows how long a step takes), and wall clock.
    """
    from tupli_mcap import viewer

    if compare and split:
        raise typer.BadParameter("--compare overlays episodes, --split shows them apart; give one of them")
    form: viewer.Form = "compare" if compare else "split" if split else "joined"
    if sum([web, save is not None, connect is not None]) > 1:
        raise typer.BadParameter(
            "--save, --web and --connect are three places to show episodes; give one of them"
        )
    if force and save is None:
        raise typer.BadParameter("--force replaces the file of --save; give that too")
    wanted = filter_of(filter_text)
    if save is not None:
        path = viewer.save(sources, save, episode, filter=wanted, form=form, force=force)
        print(f"{path}: {bytes_of(path.stat().st_size)}; open it with: rerun {shlex.quote(str(path))}")
    elif web:
        viewer.serve(sources, episode, filter=wanted, form=form, tell=_tell)
    else:
        viewer.show(sources, episode, filter=wanted, form=form, connect=connect)


def _tell(url: str) -> None:
    print(f"{url}\nopen it in a browser; Ctrl-C ends it", flush=True)
