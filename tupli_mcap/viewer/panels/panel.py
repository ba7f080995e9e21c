"""The interface of panels, and the places of their entities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.blocks import Block
from tupli_mcap.viewer.sdk import rr, rrb
from tupli_mcap.viewer.sending import Times, send_scalars

PALETTE: Final = (
    0x4C9BE8FF, 0xF28E2BFF, 0x59C36AFF, 0xE15759FF, 0xB07AD9FF, 0xEDC948FF,
    0x3FBFB5FF, 0xFF9DA7FF, 0xB58A6BFF, 0x8FA6C8FF, 0xA8C64DFF, 0xD264B6FF,
)  # fmt: skip
"""Colours that can be told apart next to each other, on a light and on a dark ground (RGBA)."""


class Root(NamedTuple):
    """Where a panel's entities go: below `root` in a stream.

    title, color: tell several episodes in one view apart; empty if there is only one.
    single: there is only one step, which is drawn as points, since it makes no line.
    """

    stream: Any
    root: str = ""
    title: str = ""
    color: int | None = None
    single: bool = False

    def series_name(self, name: str, *, alone: bool) -> str:
        """The name of a series. `alone`: the view shows only this series of each episode, so the episode names it."""
        if not self.title:
            return name
        return self.title if alone else f"{name} · {self.title}"

    def colors(self, count: int, first: int = 0) -> Array:
        """Colours for so many series: that of the episode, or those of the palette from `first` on."""
        if self.color is not None:
            return np.full(count, self.color, np.uint32)
        return np.resize(np.roll(np.array(PALETTE, np.uint32), -first), count)

    def declare_series(
        self, entity: str, names: Sequence[str], colors: Array, *, stepped: bool = False
    ) -> None:
        """Says how to draw the scalars of an entity: as lines, or a single row as points."""
        style: Any
        if self.single:
            shapes = [rr.components.MarkerShape.Circle] * len(names)
            style = rr.SeriesPoints(
                names=names, colors=colors, markers=shapes, marker_sizes=[4.0] * len(names)
            )
        else:
            style = rr.SeriesLines(
                names=names,
                colors=colors,
                interpolation_mode=rr.components.InterpolationMode.StepAfter if stepped else None,
                aggregation_policy=rr.components.AggregationPolicy.MinMax,
            )
        self.stream.log(self.root + entity, style, static=True)


class Panel(Protocol):
    """A view, and the entities that it shows."""

    @property
    def title(self) -> str: ...

    @property
    def column(self) -> str:
        """The field that it shows. Only "states" have a value after the last step of an episode."""

    def declare(self, place: Root) -> None:
        """Sends what does not change."""

    def send(self, place: Root, block: Block, times: Times) -> None:
        """Sends a block of steps; of "states", a block `with_finals`."""

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        """The view on the entities below each root; `axis` is the time axis of plots."""


@dataclass(frozen=True)
class LeafPanel:
    """The base of panels of a leaf. `column` is the field of the steps that the leaf is in."""

    leaf: Leaf
    column: str
    entity: str
    title: str

    def declare(self, place: Root) -> None:
        """Sends nothing: everything is sent with the values."""

    def values(self, block: Block) -> Any:
        """The leaf's values in a block."""
        return self.leaf.get(getattr(block.columns, self.column))

    def flat(self, block: Block) -> Array:
        """The same as rows x dimensions."""
        values: Array = self.values(block)
        return values.reshape(len(block), -1)


def send_lines(place: Root, entity: str, times: Times, values: Array) -> None:
    """Sends `values` (rows x width), with a row of NaN at the time of each seam, which breaks the lines there."""
    if times.seams:
        values = np.insert(values.astype(np.float64, copy=False), times.seams, np.nan, axis=0)
    send_scalars(place.stream, place.root + entity, times.broken, values)


def named(title: str, root: str) -> str:
    """A view's title, after the name of the episode if there are several."""
    return f"{root.strip('/').replace('_', ' ')}: {title}" if root else title


def side_by_side(kind: Any, title: str, roots: Sequence[str], entity: str, **looks: Any) -> Any:
    """A view of a kind on the entity below each root."""
    views = [kind(name=named(title, root), origin=root + entity, **looks) for root in roots]
    return views[0] if len(views) == 1 else rrb.Grid(*views, name=title)


def plot(title: str, entities: Sequence[str], axis: Any, *, legend: bool = True) -> Any:
    """A view of series over time, without a legend if that would only repeat the title."""
    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=list(entities),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        axis_x=axis,
    )
