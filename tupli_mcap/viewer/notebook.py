"""Replays in a notebook: the viewer if `rerun-notebook` is installed, else facts about the episodes as text."""

from __future__ import annotations

import html
import importlib.util
import sys
from collections.abc import Iterable
from typing import Any, Literal

from tupli_mcap.viewer.plan import Plan

_HEIGHT = 700  # pixels


def in_notebook() -> bool:
    """Whether this is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and hasattr(shell, "kernel")


class Display:
    """Episodes as the result of a cell. width, height: of the viewer (pixels); by default as wide as the cell."""

    def __init__(self, plans: Iterable[Plan], width: int | None = None, height: int | None = None) -> None:
        self._width: int | Literal["auto"] = width or "auto"
        self._height = height or _HEIGHT
        installed = importlib.util.find_spec("rerun_notebook") is not None
        self._facts: list[tuple[str, str]] = []
        self._streams: list[tuple[Any, Any]] = []
        for plan in plans:
            self._facts.append((plan.name, plan.shown))
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
