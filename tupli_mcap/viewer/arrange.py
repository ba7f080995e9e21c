"""The blueprint: where the panels of a scene are in the window."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tupli_mcap.viewer.scene import Scene

__all__ = ["blueprint_of"]


def blueprint_of(scene: Scene, roots: Sequence[str] = ("",)) -> Any:
    """The blueprint of a scene whose panels are below each of `roots`."""
    import rerun.blueprint as rrb

    left = [panel.view(roots) for panel in [*scene.states, *scene.actions]]
    right = [panel.view(roots) for panel in [*scene.beside, *scene.rewards]]
    about = rrb.Tabs(
        rrb.TextDocumentView(name="recording", origin="/card"),
        rrb.BarChartView(name="returns", origin="/overview/return"),
        rrb.BarChartView(name="lengths", origin="/overview/length"),
        name="about",
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(*left, name="state and action"),
            rrb.Vertical(*right, about, name="reward"),
            column_shares=[3, 2],
        ),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        rrb.SelectionPanel(state=rrb.PanelState.Collapsed),
        rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline="step"),
        auto_layout=False,
        auto_views=False,
    )
