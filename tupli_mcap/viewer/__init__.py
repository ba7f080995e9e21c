"""Shows recordings in the Rerun viewer: in a window, a browser, a notebook, or as a file.

`plan` makes Rerun recordings of chosen episodes, `scene` chooses their panels (`panels`) by the spaces, `blueprints`
places them, `blocks` reads the steps, `sending` sends columns, and `targets` is where all goes. `live` shows a rollout
while it is recorded; `foxglove_layout` makes Foxglove plot a recording.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tupli_mcap.dataset.which import Source, chosen_from
from tupli_mcap.recording import Recording
from tupli_mcap.viewer.notebook import Display, in_notebook
from tupli_mcap.viewer.plan import Form, plans_of
from tupli_mcap.viewer.sdk import ViewerError, rerun_sdk
from tupli_mcap.viewer.targets import to_browser, to_file, to_viewer, to_window

__all__ = ["Form", "ViewerError", "blueprint", "display", "in_notebook", "save", "send", "serve", "show"]


def save(
    sources: Source | Sequence[Source],
    target: str | os.PathLike[str],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    force: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Path:
    """Writes episodes and their blueprint into a `.rrd` file, which `rerun FILE` opens.

    Of a file with several Rerun recordings ("split", or recordings of different spaces) it opens one; `rerun - < FILE`
    opens them all. Those of different spaces are of different applications in the viewer, which keeps a blueprint for
    each; opened as `rerun FILE`, it says so.

    Args:
        sources: a recording, its path or URL, a storage's directory, or several of them.
        episodes: "best", "worst", "first", "last", "all", "3,7,9", or numbers; all by default.
        filter: only episodes that it is true of.
        form: "joined" on one timeline, "split" into a Rerun recording each, or "compare" in the same plots.
        force: replace a file that exists.
        tell: given the command that opens the file.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        RecordingError: the file exists, or there is no such episode.
        FormatError: a recording is damaged; no file is left.
    """
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        return to_file(plans_of(chosen, form), target, force=force, tell=tell)


def show(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    connect: str | None = None,
) -> int | None:
    """Opens the native viewer on episodes, chosen as for `save`; it stays open. Returns its process id.

    Args:
        connect: send to this viewer instead, `rerun+http://HOST:PORT/proxy`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: there is no display, no viewer, or it does not start.
    """
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        if connect is None:
            return to_window(plans_of(chosen, form))
        to_viewer(plans_of(chosen, form), connect)
        return None


def display(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    width: int | None = None,
    height: int | None = None,
) -> Display:
    """Episodes, chosen as for `save`, as the result of a notebook's cell.

    Without `rerun-notebook`, the cell shows what is known of them, and what to install.

    Args:
        width, height: of the viewer (pixels); by default as wide as the cell.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        return Display(plans_of(chosen, form), width, height)


def serve(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    tell: Callable[[str], None] = print,
) -> None:
    """Serves the web viewer and the episodes on 127.0.0.1 until Ctrl-C; `tell` is given the URL.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: there is no viewer program, or it does not start.
    """
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        to_browser(plans_of(chosen, form), tell)


def blueprint(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
) -> Any:
    """The blueprint that `save` would write, a `rerun.blueprint.Blueprint`."""
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        return next(iter(plans_of(chosen, form))).blueprint


def send(recording: Recording, stream: Any = None, episodes: str | Sequence[int] | None = None) -> Any:
    """Sends episodes, joined on one timeline, and their blueprint into a `rerun.RecordingStream`.

    Without a stream, it makes one, which is returned either way: `stream.save(...)` before, or give it a sink.
    """
    rerun_sdk()
    with chosen_from(recording, episodes, None) as chosen:
        for plan in plans_of(chosen, "joined"):
            stream = plan.new_stream() if stream is None else stream
            stream.send_blueprint(plan.blueprint)
            plan.send(stream)
    return stream
