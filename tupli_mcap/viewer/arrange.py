"""The blueprint: where the panels of a scene are in the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tupli_mcap.viewer.panels import Panel
from tupli_mcap.viewer.pictures import Camera, Grid, HeatMap, Picture
from tupli_mcap.viewer.scene import Scene
from tupli_mcap.viewer.words import Infos, Lanes, Words

__all__ = ["blueprint_of"]

_STACKED, _A_PAGE = 4, 12
_MOST_LINKED = 1000  # rows
_SHARE = 3.0  # of a column's height, a panel like any other
_SHARES: dict[type, float] = {
    Lanes: 1.6,
    Words: 2.0,
    Infos: 2.0,
    Picture: 4.0,
    Camera: 4.0,
    Grid: 4.0,
    HeatMap: 6.0,
}


def blueprint_of(scene: Scene, roots: Sequence[str] = ("",)) -> Any:
    """The blueprint of a scene whose panels are below each of `roots`."""
    import rerun.blueprint as rrb

    # where there is nothing to plot, what is looked at has the room
    main, beside = (scene.states, scene.beside) if scene.states else (scene.beside, [])
    axis = _time_axis(scene.rows)
    groups = ((main, "state"), (scene.actions, "action"))
    left = [
        (_stack(group, roots, axis, name), _share(group, group is main)) for group, name in groups if group
    ]
    right = [(_stack(beside, roots, axis, "beside"), _share(beside, False))] if beside else []
    right += [(panel.view(roots, axis), 4.0) for panel in scene.rewards]
    about = rrb.Tabs(
        rrb.TextDocumentView(name="recording", origin="/card"),
        rrb.BarChartView(name="returns", origin="/overview/return"),
        rrb.BarChartView(name="lengths", origin="/overview/length"),
        name="about",
    )
    right.append((about, 3.0))
    columns = [
        rrb.Vertical(*(view for view, _ in column), row_shares=[share for _, share in column])
        for column in (left, right)
        if column
    ]
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[3, 2][-len(columns) :]),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline="step"),
        auto_layout=False,
        auto_views=False,
    )


def _stack(panels: Sequence[Panel], roots: Sequence[str], axis: Any, name: str) -> Any:
    """Views below each other; many of them side by side, and on several pages. A heat map has a page of its own."""
    import rerun.blueprint as rrb

    maps = [panel.view(roots, axis) for panel in panels if isinstance(panel, HeatMap)]
    others = [panel for panel in panels if not isinstance(panel, HeatMap)]
    views = [panel.view(roots, axis) for panel in others]
    if not maps and len(views) <= _STACKED:
        shares = [_SHARES.get(type(panel), _SHARE) for panel in others]
        return views[0] if len(views) == 1 else rrb.Vertical(*views, name=name, row_shares=shares)
    pages = list(maps)
    for start in range(0, len(views), _A_PAGE):
        page = views[start : start + _A_PAGE]
        told = name if len(views) <= _A_PAGE else f"{name} {start + 1} to {start + len(page)}"
        pages.append(rrb.Grid(*page, name=told) if len(page) > 1 else page[0])
    return pages[0] if len(pages) == 1 else rrb.Tabs(*pages, name=name)


def _share(panels: Sequence[Panel], main: bool) -> float:
    """How much of a column's height some panels need; what matters most takes what there is."""
    return min(8.0, max(6.0 if main else 0.0, sum(_SHARES.get(type(panel), _SHARE) for panel in panels)))


def _time_axis(rows: int) -> Any:
    """The time axis of plots: moved together, or if there are many rows, each showing them all."""
    import rerun.blueprint as rrb

    if rows <= _MOST_LINKED:  # linked plots begin with a window around the cursor
        return rrb.archetypes.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    forever = rrb.TimeRange(start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite())
    return rrb.archetypes.TimeAxis(view_range=forever)
