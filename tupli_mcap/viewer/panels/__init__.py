"""Panels: a leaf, or values computed from the steps, as entities of a Rerun recording and a view of them.

`panel` has their interface; the kinds are in `numbers` (lines, reward and return), `images` (images, grids,
heat maps, camera frames) and `texts` (texts, lanes of states, infos). `viewer.scene` chooses among them.
"""

from tupli_mcap.viewer.panels.images import Camera, Grid, HeatMap, Picture, is_image, value_range
from tupli_mcap.viewer.panels.numbers import Rewards, Series
from tupli_mcap.viewer.panels.panel import PALETTE, Panel, Root
from tupli_mcap.viewer.panels.texts import Infos, Lanes, LiveInfos, Words, number_keys, panel_of_infos

__all__ = [
    "PALETTE", "Camera", "Grid", "HeatMap", "Infos", "Lanes", "LiveInfos", "Panel", "Picture", "Rewards", "Root",
    "Series", "Words", "is_image", "number_keys", "panel_of_infos", "value_range",
]  # fmt: skip
