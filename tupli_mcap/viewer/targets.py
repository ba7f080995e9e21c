"""Sends a replay to a file, the native viewer, a browser, or a notebook's cell."""

from __future__ import annotations

import contextlib
import html
import importlib.util
import os
import shlex
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote, urlsplit

from tupli_mcap.errors import RecordingError, asking, taken
from tupli_mcap.files import is_directory, is_there, stopped_by_signals
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.viewer.plan import Plan
from tupli_mcap.viewer.process import (
    LOCAL,
    free_port,
    has_display,
    run_quietly,
    started,
    viewer_program,
    web_viewer,
)
from tupli_mcap.viewer.sdk import ViewerError

_ANSWER_SECONDS = 3.0
_FLUSH_SECONDS = 600.0  # seconds that a viewer may need to take all data
_HEIGHT = 700  # pixels, in a notebook


def to_file(
    plans: Iterable[Plan],
    target: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    tell: Callable[[str], None] | None = None,
) -> Path:
    """Writes a `.rrd` with its blueprint, as a whole or not at all. `tell` is called with the command that opens it.
    RecordingError if its name does not end in .rrd, it exists (without `overwrite`), or it cannot be written."""
    goal = Path(target)
    if goal.suffix != ".rrd":
        raise RecordingError(
            f"expected a name that ends in .rrd, by which the viewer recognises its files, found {str(goal)!r}"
        )
    check_new(goal, overwrite=overwrite)
    with replacing(goal, overwrite=overwrite) as (_, temporary):
        several = list(plans)
        if len(several) == 1:
            _write(several[0], temporary, several[0].blueprint)
        else:
            _write_all(several, temporary)
    if tell is not None:
        # with a path, the viewer opens only one of several recordings in a file
        tell(f"rerun {'- < ' if len(several) > 1 else ''}{shlex.quote(str(goal))}")
    return goal


def check_new(goal: Path, *, overwrite: bool) -> None:
    """Raises RecordingError if a file exists (without `overwrite`), or there is no directory for it."""
    if is_there(goal) and not overwrite:
        raise RecordingError(taken(goal))
    if not is_directory(goal.parent):
        raise RecordingError(
            f"{goal} cannot be written: there is no directory {str(goal.parent)!r}; make it first"
        )


def _write_all(plans: Sequence[Plan], path: Path) -> None:
    """Several Rerun recordings in one file."""
    program = viewer_program()
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".") as folder:
        parts = [Path(folder) / f"{i}.rrd" for i in range(len(plans))]
        arranged: set[str] = set()
        for plan, part in zip(plans, parts, strict=True):
            _write(plan, part, None if plan.application in arranged else plan.blueprint)
            arranged.add(plan.application)
        run_quietly(program, "rrd", "merge", *map(str, parts), "-o", str(path))


def _write(plan: Plan, path: Path, blueprint: Any) -> None:
    stream = plan.new_stream()
    try:
        stream.save(path, default_blueprint=blueprint)
        plan.send(stream)
        stream.flush()
    finally:
        stream.disconnect()


def to_viewer(plans: Iterable[Plan], url: str) -> None:
    """Sends to a running viewer, such as `rerun+http://127.0.0.1:9876/proxy`. ViewerError if the URL is not valid, or
    no viewer took the data."""
    _await_viewer(url)
    for plan in plans:
        stream = plan.new_stream()
        try:
            with _viewer_errors(url):
                stream.connect_grpc(url, default_blueprint=plan.blueprint)
            plan.send(stream)
            with _viewer_errors(url):
                stream.flush(timeout_sec=_FLUSH_SECONDS)
        finally:
            stream.disconnect()


def _await_viewer(url: str) -> None:
    """Waits a little for a viewer that may just have been started. (The SDK would wait much longer.)"""
    try:
        parts = urlsplit(url)
        address = parts.hostname, parts.port
    except ValueError:  # no valid address or port: the SDK raises the error
        return
    if None in address or not parts.scheme.startswith("rerun"):
        return
    until = time.monotonic() + _ANSWER_SECONDS
    while True:
        try:
            socket.create_connection(address, timeout=_ANSWER_SECONDS).close()
            return
        except OSError as err:
            if time.monotonic() > until:
                raise ViewerError(
                    f"no viewer answers at {url} ({err.strerror or err}); start one there (rerun --port "
                    f"{parts.port}), or write a file with {asking('viewer.save', '--save FILE.rrd')}"
                ) from err
        time.sleep(0.1)


@contextlib.contextmanager
def _viewer_errors(url: str) -> Iterator[None]:
    try:
        yield
    except (RuntimeError, ValueError) as err:
        raise ViewerError(f"the viewer at {url} did not take the data: {err}") from err


def to_window(plans: Iterable[Plan]) -> int:
    """Opens the native viewer, which stays open when this process ends; returns its process id. ViewerError if there is
    no display, or no viewer, or it does not start."""
    program = viewer_program()
    if not has_display():
        raise ViewerError(
            f"there is no display here; look in a browser with {asking('viewer.serve', '--web')}, or write a file with "
            f"{asking('viewer.save', '--save FILE.rrd')}"
        )
    port = free_port()
    options = ["--port", str(port), "--hide-welcome-screen", "--expect-data-soon"]
    with started(program, [port], *options) as process:
        to_viewer(plans, f"rerun+http://{LOCAL}:{port}/proxy")
    process.returncode = 0  # keeps Popen from warning that the process still runs
    return process.pid


def to_browser(plans: Iterable[Plan], tell: Callable[[str], None]) -> None:
    """Serves the web viewer and the data on 127.0.0.1 until Ctrl-C; `tell` is called with the URL. ViewerError if there
    is no viewer program, or it does not start, or ends."""
    program = viewer_program()
    with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder, stopped_by_signals():
        path = to_file(plans, Path(folder) / "replay.rrd")
        with (
            contextlib.suppress(KeyboardInterrupt),
            web_viewer(program, "--server-memory-limit", "100%", str(path)) as (process, data, page),
        ):
            source = quote(f"rerun+http://{LOCAL}:{data}/proxy", safe="")
            tell(f"http://{LOCAL}:{page}/?url={source}")
            process.wait()
            raise ViewerError(f"the web viewer ended unexpectedly, with exit code {process.returncode}")


# --- notebooks ---


def in_notebook() -> bool:
    """Whether this is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class Display:
    """Episodes as the result of a cell: the viewer if `rerun-notebook` is installed, else facts about them as text.

    width, height: of the viewer (pixels); by default as wide as the cell.
    """

    def __init__(self, plans: Iterable[Plan], width: int | None = None, height: int | None = None) -> None:
        self._width: int | Literal["auto"] = width or "auto"
        self._height = height or _HEIGHT
        installed = importlib.util.find_spec("rerun_notebook") is not None
        self._facts: list[tuple[str, str]] = []
        self._streams: list[tuple[Any, Any]] = []
        for plan in plans:
            self._facts.append((plan.name, plan.shown.replace("**", "")))  # which is bold in the viewer
            if installed:
                stream = plan.new_stream()
                plan.send(stream)  # the stream keeps it until a viewer takes it
                self._streams.append((stream, plan.blueprint))

    def viewer(self) -> Any:
        """The viewer, an ipywidget, with everything in it; None where `rerun-notebook` is not installed."""
        if not self._streams:
            return None
        from rerun.notebook import Viewer

        viewer = Viewer(width=self._width, height=self._height, use_global_recording=False)
        for stream, blueprint in self._streams:
            viewer.add_recording(stream, blueprint)
        return viewer

    def _ipython_display_(self) -> None:
        from IPython.display import HTML, display

        viewer = self.viewer()
        if viewer is None:
            display(HTML(self._repr_html_()))
        else:
            viewer.display()

    def _repr_html_(self) -> str:
        """The facts about the episodes, and how to install the viewer."""
        told = "".join(
            f"<p><b>{html.escape(name)}</b></p><pre>{html.escape(shown)}</pre>" for name, shown in self._facts
        )
        return (
            f"{told}<p>To see it here: <code>pip install rerun-notebook</code>, and restart the kernel.</p>"
        )

    def __repr__(self) -> str:
        return "; ".join(f"{name}: {shown.splitlines()[0]}" for name, shown in self._facts)
