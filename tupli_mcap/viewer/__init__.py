"""Shows recordings in the Rerun viewer: in a window, a browser, a notebook, or as a file.

plan                  makes Rerun recordings of chosen episodes
scene, panels/        the panels of a recording, chosen by its spaces
about                 panels about recordings as a whole
blueprints            places the panels
names                 names of panels and dimensions, safe for Rerun
blocks, sending       reads steps, and sends them as columns
targets               where all of it goes: a window, a browser, a notebook, a file
process, sdk          the viewer's program; rerun-sdk
live/                 a rollout while it is recorded
foxglove_layout       a layout that makes Foxglove plot a recording
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tupli_mcap.dataset.chosen import Viewable, chosen_from
from tupli_mcap.recording import Recording
from tupli_mcap.viewer.names import plain
from tupli_mcap.viewer.plan import Form, Plan, extremes_of, plans_of, runs_apart
from tupli_mcap.viewer.sdk import ViewerError, rerun_sdk
from tupli_mcap.viewer.targets import Display, in_notebook, to_browser, to_file, to_viewer, to_window

__all__ = [
    "Form",
    "ViewerError",
    "blueprint",
    "display",
    "in_notebook",
    "save",
    "send",
    "serve",
    "show",
    "view",
]


def view(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None = None,
    *,
    save: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Any:
    """Calls `save` if it is given the path of a `.rrd` file; else `display` in a notebook, and `show` elsewhere. The
    other arguments are passed on; raises what these raise."""
    if save is not None:
        return _save(sources, save, episodes, **options)
    if in_notebook():
        return display(sources, episodes, **options)
    return show(sources, episodes, **options)


def save(
    sources: Viewable | Sequence[Viewable],
    target: str | os.PathLike[str],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    overwrite: bool = False,
    tell: Callable[[str], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> Path:
    """Write episodes and their blueprint into a `.rrd` file, which `rerun FILE` opens.

    A file holds several Rerun recordings if `form` is "apart", or if the sources have different spaces. `rerun FILE`
    opens only one of them, `rerun - < FILE` all. Recordings of different spaces are different applications in the
    viewer, so that each has its own blueprint.

    Args:
        sources: a recording, its path or URL, a directory, a storage, a dataset, or several of these.
        episodes: "best", "worst", "first", "last", "all", "3,7-9", or numbers. By default, all; if there are more than
            ten, the last, the best and the worst (of each recording; of more than three recordings, of all together).
        filter: only episodes that match it.
        form: "joined" on one timeline, "apart" into a Rerun recording each, or "compare" in the same plots.
        overwrite: replace a file that exists.
        tell: called with the command that opens the file.
        note: called with a sentence on which episodes are shown, if the default has left some out.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        RecordingError: the file exists, or there is no such episode.
        FormatError: a recording is damaged; no file is left.
    """
    with _planned(sources, episodes, filter, form, note) as plans:
        return to_file(plans, target, overwrite=overwrite, tell=tell)


_save = save  # within `view`, where `save` is a file


def show(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    connect: str | None = None,
    note: Callable[[str], None] | None = None,
) -> int | None:
    """Open the native viewer on episodes, chosen as for `save`. It stays open; returns its process id.

    Args:
        filter, form: as for `save`.
        connect: send to this running viewer instead: `rerun+http://HOST:PORT/proxy`. Then returns None.
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
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    width: int | None = None,
    height: int | None = None,
) -> Display:
    """Show episodes, chosen as for `save`, as the result of a notebook's cell.

    Without `rerun-notebook`, the cell shows facts about the episodes, and what to install.

    Args:
        filter, form: as for `save`.
        width, height: size of the viewer (pixels); by default, as wide as the cell.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    with _planned(sources, episodes, filter, form) as plans:
        return Display(plans, width, height)


def serve(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
    tell: Callable[[str], None] = print,
    note: Callable[[str], None] | None = None,
) -> None:
    """Serve the web viewer and the episodes on 127.0.0.1 until Ctrl-C.

    Args:
        sources, episodes, filter, form, note: as for `save`.
        tell: called with the URL.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        ViewerError: there is no viewer program, or it does not start.
    """
    with _planned(sources, episodes, filter, form, note) as plans:
        to_browser(plans, tell)


def blueprint(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    form: Form = "joined",
) -> Any:
    """The blueprint that `save` would write for these `sources`, `episodes`, `filter` and `form`, a
    `rerun.blueprint.Blueprint`."""
    with _planned(sources, episodes, filter, form) as plans:
        return next(plans).blueprint


def send(recording: Recording, stream: Any = None, episodes: str | Sequence[int] | None = None) -> Any:
    """Send episodes, joined on one timeline, and their blueprint into a `rerun.RecordingStream`; returns the stream.

    Without a stream, a new one is made. Give it a sink, such as `stream.save(...)`, to see its content.
    """
    with _planned(recording, episodes, None, "joined") as plans:
        for plan in plans:
            stream = plan.new_stream() if stream is None else stream
            stream.send_blueprint(plan.blueprint)
            plan.send(stream)
    return stream


@contextlib.contextmanager
def _planned(
    sources: Viewable | Sequence[Viewable],
    episodes: str | Sequence[int] | None,
    filter: Any,
    form: Form,
    note: Callable[[str], None] | None = None,
) -> Iterator[Iterator[Plan]]:
    """The Rerun recordings to show; the source files are open within the block."""
    rerun_sdk()
    with chosen_from(sources, episodes, filter) as chosen:
        of_runs = runs_apart(chosen)
        some, choice = extremes_of(of_runs) if episodes is None else (of_runs, "")
        if choice and note is not None:
            note(choice)
        plans = plans_of(some, form, among=chosen)
        yield (plan._replace(shown=f"{plain(choice)}\n\n{plan.shown}") for plan in plans) if choice else plans
