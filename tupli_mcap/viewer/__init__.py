"""Shows recordings in the Rerun viewer: in a window, a browser, a notebook, or as a file.

`plan` makes Rerun recordings of chosen episodes, `scene` chooses their panels (`panels`) by the spaces, `blueprints`
places them, `blocks` reads the steps, `sending` sends columns, and `targets` is where all goes. `live` shows a rollout
while it is recorded; `foxglove_layout` makes Foxglove plot a recording.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tupli_mcap.dataset.which import Source, chosen_from
from tupli_mcap.recording import Recording
from tupli_mcap.viewer.names import plain
from tupli_mcap.viewer.notebook import Display, in_notebook
from tupli_mcap.viewer.plan import Form, Plan, extremes_of, plans_of
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
    note: Callable[[str], None] | None = None,
) -> Path:
    """Writes episodes and their blueprint into a `.rrd` file, which `rerun FILE` opens.

    Of a file with several Rerun recordings ("split", or recordings of different spaces) it opens one; `rerun - < FILE`
    opens them all. Those of different spaces are of different applications in the viewer, which keeps a blueprint for
    each; opened as `rerun FILE`, it says so.

    Args:
        sources: a recording, its path or URL, a storage's directory, or several of them.
        episodes: "best", "worst", "first", "last", "all", "3,7-9", or numbers; by default all, or of more than ten the
            last, the best and the worst (of each recording, or of more than three recordings, of all).
        filter: only episodes that match it.
        form: "joined" on one timeline, "split" into a Rerun recording each, or "compare" in the same plots.
        force: replace a file that exists.
        tell: given the command that opens the file.
        note: given a sentence on which episodes are shown, where that is a choice of ours.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        RecordingError: the file exists, or there is no such episode.
        FormatError: a recording is damaged; no file is left.
    """
    with _planned(sources, episodes, filter, form, note) as plans:
        return to_file(plans, target, force=force, tell=tell)


def show(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    connect: str | None = None,
    note: Callable[[str], None] | None = None,
) -> int | None:
    """Opens the native viewer on episodes, chosen as for `save`; it stays open. Returns its process id.

    Args:
        connect: send to this viewer instead, `rerun+http://HOST:PORT/proxy`.
        note: as for `save`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: there is no display, no viewer, or it does not start.
    """
    with _planned(sources, episodes, filter, form, note) as plans:
        if connect is None:
            return to_window(plans)
        to_viewer(plans, connect)
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
    with _planned(sources, episodes, filter, form) as plans:
        return Display(plans, width, height)


def serve(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    tell: Callable[[str], None] = print,
    note: Callable[[str], None] | None = None,
) -> None:
    """Serves the web viewer and the episodes on 127.0.0.1 until Ctrl-C; `tell` is given the URL, `note` as for `save`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: there is no viewer program, or it does not start.
    """
    with _planned(sources, episodes, filter, form, note) as plans:
        to_browser(plans, tell)


def blueprint(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
) -> Any:
    """The blueprint that `save` would write, a `rerun.blueprint.Blueprint`."""
    with _planned(sources, episodes, filter, form) as plans:
        return next(plans).blueprint


def send(recording: Recording, stream: Any = None, episodes: str | Sequence[int] | None = None) -> Any:
    """Sends episodes, joined on one timeline, and their blueprint into a `rerun.RecordingStream`.

    Without a stream, it makes one, which is returned either way: `stream.save(...)` before, or give it a sink.
    """
    with _planned(recording, episodes, None, "joined") as plans:
        for plan in plans:
            stream = plan.new_stream() if stream is None else stream
            stream.send_blueprint(plan.blueprint)
            plan.send(stream)
    return stream


@contextlib.contextmanager
def _planned(
    sources: Source | Sequence[Source],
    episodes: str | Sequence[int] | None,
    filter: Any,
    form: Form,
    note: Callable[[str], None] | None = None,
) -> Iterator[Iterator[Plan]]:
    """The Rerun recordings to show, while the files they are of are open."""
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        some, choice = extremes_of(chosen) if episodes is None else (chosen, "")
        if choice and note is not None:
            note(choice)
        plans = plans_of(some, form)
        yield (plan._replace(shown=f"{plain(choice)}\n\n{plan.shown}") for plan in plans) if choice else plans
