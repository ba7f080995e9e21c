"""Makes the blueprint of a scene: the arrangement of its panels in the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tupli_mcap.viewer.panels import Camera, Grid, HeatMap, Infos, Lanes, Panel, Picture, Series, Words
from tupli_mcap.viewer.scene import Scene
from tupli_mcap.viewer.sdk import rrb

_STACKED, _A_PAGE = 4, 12
_WINDOW = 500  # rows that are shown of a running rollout
_SHARE = 3.0  # the share of a usual panel in the height of its column
# The share of a panel of lanes: without lanes, for each lane, at most.
_LANES, _LANE, _MOST_LANES = 1.2, 0.8, 6.0
# The share of all pictures: above plots of states, without them, in the other column.
_ABOVE, _ALONE, _BESIDE = 8.0, 12.0, 6.0
_CROWDED = 10.0  # above this sum of shares of plots, the column has no room for pictures
_SHARES: dict[type, float] = {Words: 2.0, Infos: 2.0, Grid: 4.0, HeatMap: 6.0}


def blueprint_of(scene: Scene, roots: Sequence[str], *, listed: bool = False, overview: bool = False) -> Any:
    """The blueprint of a scene whose panels are below each of `roots`. listed: whether the list of recordings is open.
    overview: whether the returns of all episodes are at the top."""
    axis = _time_axis(scene)
    pictures = [panel for panel in scene.beside if isinstance(panel, Picture | Camera)]
    beside = [panel for panel in scene.beside if not isinstance(panel, Picture | Camera)]
    if not scene.states and not pictures:  # without states, texts take their place
        states, beside = beside, []
    else:
        states = scene.states
    left = [
        (_stack(group, roots, axis, name), _share(group, len(roots), group is states))
        for group, name in ((states, "state"), (scene.actions, "action"))
        if group
    ]
    plots = sum(share for _, share in left)
    crowded = plots > _CROWDED  # so pictures are beside them, not above
    if pictures and not crowded:
        left.insert(0, (_pictures(pictures, roots, axis), _ABOVE if states else _ALONE))
    returns = rrb.BarChartView(
        name="returns", origin="/overview", contents=["/overview/return", "/overview/shown"]
    )
    lengths = rrb.BarChartView(name="lengths", origin="/overview/length")
    card = rrb.TextDocumentView(name="recording", origin="/card")
    right: list[tuple[Any, float]] = [(returns, 3.0)] if overview else []
    right += [(_pictures(pictures, roots, axis), _BESIDE)] if pictures and crowded else []
    right += [(_stack(beside, roots, axis, "beside"), _share(beside, len(roots), False))] if beside else []
    right += [(panel.view(roots, axis), 4.0) for panel in scene.rewards]
    right.append((rrb.Tabs(card, *([] if overview else [returns]), lengths, name="about"), 3.0))
    columns = [_column(views) for views in (left, right) if views]
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=([1, 1] if pictures and crowded else [3, 2])[-len(columns) :]),
        rrb.BlueprintPanel(state=rrb.PanelState.Expanded if listed else rrb.PanelState.Collapsed),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline="step"),
        auto_layout=False,
        auto_views=False,
    )


def _pictures(panels: Sequence[Panel], roots: Sequence[str], axis: Any) -> Any:
    """Images and cameras beside each other."""
    views = [panel.view(roots, axis) for panel in panels]
    return views[0] if len(views) == 1 else rrb.Grid(*views, name="pictures")


def _stack(panels: Sequence[Panel], roots: Sequence[str], axis: Any, name: str) -> Any:
    """Views below each other; many views in two columns, and on several pages. Heat maps and their lines come last."""
    maps = [panel for panel in panels if isinstance(panel, HeatMap)]
    wide = {panel.leaf.path for panel in maps}
    lines = [panel for panel in panels if isinstance(panel, Series) and panel.leaf.path in wide]
    apart = {id(panel) for panel in (*maps, *lines)}
    others = [panel for panel in panels if id(panel) not in apart]
    pages = []
    for group, title in ((others, name), (lines, f"{name}: lines")):
        for start in range(0, len(group), _A_PAGE):
            page = group[start : start + _A_PAGE]
            where = "" if len(group) <= _A_PAGE else f" {start + 1} to {start + len(page)}"
            pages.append((_below(page, roots, axis), title + where))
    if maps:
        shown, title = pages.pop(0) if others else ([], name)
        pages.insert(0, (shown + _below(maps, roots, axis), title))
    columns = [_column(views, title) for views, title in pages]
    return columns[0] if len(columns) == 1 else rrb.Tabs(*columns, name=name)


def _below(panels: Sequence[Panel], roots: Sequence[str], axis: Any) -> list[tuple[Any, float]]:
    """Views and their shares of the height; in two columns where they would be flat below each other."""
    views = [panel.view(roots, axis) for panel in panels]
    if len(views) <= _STACKED:
        return [(view, _height(panel, len(roots))) for view, panel in zip(views, panels, strict=True)]
    return [(rrb.Grid(*views, grid_columns=2), _SHARE * ((len(views) + 1) // 2))]


def _column(views: Sequence[tuple[Any, float]], name: str | None = None) -> Any:
    return rrb.Vertical(*(view for view, _ in views), row_shares=[share for _, share in views], name=name)


def _height(panel: Panel, episodes: int) -> float:
    if isinstance(panel, Lanes):
        return min(_LANES + _LANE * episodes, _MOST_LANES)
    return _SHARES.get(type(panel), _SHARE)


def _share(panels: Sequence[Panel], episodes: int, main: bool) -> float:
    """The share of some panels in the height of their column; `main` ones, the states, may take more."""
    return min(
        12.0 if main else 8.0, max(6.0 if main else 0.0, sum(_height(panel, episodes) for panel in panels))
    )


def _time_axis(scene: Scene) -> Any:
    """The time axis of plots. Linked ones move together, growing ones show the last rows before the cursor, which
    follows the newest row; others show all their rows."""
    start = end = rrb.TimeRangeBoundary.infinite()
    if scene.grows:
        start = rrb.TimeRangeBoundary.cursor_relative(seq=-_WINDOW)
        end = rrb.TimeRangeBoundary.cursor_relative()
    elif scene.linked:
        return rrb.archetypes.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    return rrb.archetypes.TimeAxis(view_range=rrb.TimeRange(start=start, end=end))
