"""The blueprint: where the panels of a scene are in the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tupli_mcap.viewer.panels import Panel
from tupli_mcap.viewer.scene import Scene

__all__ = ["blueprint_of"]


_TALL, _PAGE = 4, 12  # panels that a column, and that a window has room for


def blueprint_of(scene: Scene, roots: Sequence[str] = ("",)) -> Any:
    """The blueprint of a scene whose panels are below each of `roots`: what was seen and done on the left, what came of
    it on the right, and no side panels."""
    import rerun.blueprint as rrb

    plots = [*scene.states, *scene.actions]
    left = _paged(plots, roots)
    rewards = [panel.view(roots) for panel in scene.rewards]
    about = rrb.Tabs(
        rrb.TextDocumentView(name="recording", origin="/card"),
        rrb.BarChartView(name="returns", origin="/overview/return"),
        rrb.BarChartView(name="lengths", origin="/overview/length"),
        name="about",
    )
    beside = [_grid([panel.view(roots) for panel in scene.beside], "seen")] if scene.beside else []
    right = rrb.Vertical(*beside, *rewards, about, row_shares=[3] * len(beside) + [3] * len(rewards) + [2])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[3, 2]) if plots else right,
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline="step"),
        auto_layout=False,
        auto_views=False,
    )


def _paged(panels: Sequence[Panel], roots: Sequence[str]) -> Any:
    """Panels below each other, in two columns where they would be flat, behind tabs where there are many."""
    import rerun.blueprint as rrb

    pages = []
    for start in range(0, len(panels), _PAGE):
        page = panels[start : start + _PAGE]
        views = [panel.view(roots) for panel in page]
        name = page[0].title if len(page) == 1 else f"{page[0].title} … {page[-1].title}"
        pages.append(rrb.Vertical(*views, name=name) if len(views) <= _TALL else _grid(views, name))
    return pages[0] if len(pages) == 1 else rrb.Tabs(*pages, name="state and action")


def _grid(views: Sequence[Any], name: str) -> Any:
    """Views in columns: one, or two."""
    import rerun.blueprint as rrb

    return rrb.Grid(*views, grid_columns=min(len(views), 2), name=name)
