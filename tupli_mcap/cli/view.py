"""The command view: shows recordings in the Rerun viewer, or writes a layout for Foxglove."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from tupli_mcap.cli.options import (
    Episodes,
    FilterText,
    Force,
    Json,
    Sources,
    check_extras,
    filter_of,
    hinting,
)
from tupli_mcap.cli.output import print_result
from tupli_mcap.cli.terminal import flush
from tupli_mcap.errors import bytes_of

_Compare = Annotated[bool, typer.Option("--compare", help="Overlay the episodes in the same plots.")]
_Apart = Annotated[
    bool, typer.Option("--apart/--joined", help="Show each episode on its own, or all on one timeline.")
]
_Save = Annotated[
    Path | None,
    typer.Option(
        "--save", "--output", "-o", metavar="FILE.rrd", help="Write a file instead of opening the viewer."
    ),
]
_Web = Annotated[
    bool, typer.Option("--web", help="Show it in a browser: serves the viewer on 127.0.0.1 until Ctrl-C.")
]
_Connect = Annotated[
    str | None,
    typer.Option(
        "--connect", metavar="URL", help="Send it to a running viewer: rerun+http://HOST:PORT/proxy."
    ),
]
_Layout = Annotated[
    Path | None,
    typer.Option(
        "--layout", metavar="FILE.json", help="Only write a layout for Foxglove that plots the recording."
    ),
]


def view(
    sources: Sources,
    episode: Episodes = None,
    filter_text: FilterText = None,
    compare: _Compare = False,
    apart: _Apart = False,
    save: _Save = None,
    web: _Web = False,
    connect: _Connect = None,
    force: Force = False,
    layout: _Layout = None,
    as_json: Json = False,
) -> None:
    """Look at recordings in the Rerun viewer.

    It shows states, actions, rewards, infos and images over time. Of more than ten episodes,
    it shows the returns of all, and the steps of the last, the best and the worst one;
    --episodes all shows the steps of all. Timelines are the step, the time within the episode
    (if the recording has the duration of a step), and the wall clock. Needs the extra
    `rerun`.
    """
    goals = sum([web, save is not None, connect is not None])
    if layout is not None:
        if episode or filter_text or compare or apart or goals:
            raise typer.BadParameter(
                "--layout goes only with --force: a layout is made for a whole recording"
            )
        _write_layout(sources, layout, force=force, as_json=as_json)
        return
    if compare and apart:
        raise typer.BadParameter("--compare overlays episodes, --apart shows them apart; give one of them")
    if goals > 1:
        raise typer.BadParameter("--save, --web and --connect exclude each other; give one of them")
    if force and save is None:
        raise typer.BadParameter("--force goes with --save or --layout, whose file it replaces")
    check_extras(sources, rerun="rerun")
    from tupli_mcap.viewer.sdk import import_quickly

    import_quickly()
    from tupli_mcap import viewer

    wanted, notes, commands = filter_of(filter_text), list[str](), list[str]()
    form: viewer.Form = "compare" if compare else "apart" if apart else "joined"
    shown: dict[str, Any] = {"filter": wanted, "form": form, "note": notes.append}
    with hinting(sources, wanted):
        if save is not None:
            path = viewer.save(sources, save, episode, overwrite=force, tell=commands.append, **shown)
            size, command = path.stat().st_size, commands[0]
            line = f"{path}: {bytes_of(size)}; open it with: {command}"
            _tell(line, as_json=as_json, notes=notes, path=path, size=size, command=command)
        elif web:
            line = "open this address in a browser; Ctrl-C ends the viewer"
            viewer.serve(
                sources,
                episode,
                tell=lambda url: _tell(url, line, as_json=as_json, notes=notes, address=url),
                **shown,
            )
        else:
            viewer.show(sources, episode, connect=connect, **shown)
            _tell(as_json=as_json, notes=notes)


def _tell(*lines: str, as_json: bool, notes: Sequence[str] = (), **facts: Any) -> None:
    """Prints what is shown, and where; at once, since the viewer may go on."""
    known = {"path": None, "size": None, "command": None, "address": None}
    print_result({**known, **facts, "notes": notes}, *lines, *notes, as_json=as_json)
    flush()


def _write_layout(sources: list[str], target: Path, *, force: bool, as_json: bool) -> None:
    from tupli_mcap.viewer.foxglove_layout import write_layout

    path = write_layout(sources, target, overwrite=force)
    line = f"{path}: open the recording in Foxglove, then import this file as a layout"
    _tell(line, as_json=as_json, path=path, size=path.stat().st_size)
