"""Panels: a leaf, or what follows from the steps, as entities of a Rerun recording and a view on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.blocks import Block
from tupli_mcap.viewer.sending import Times, send_scalars

__all__ = ["ENDS", "PALETTE", "Panel", "Place", "Rewards", "Series", "flat_values", "named", "plot"]

ENDS: Mapping[str, int] = {"terminal": 0xE4572EFF, "timeout": 0xF3A712FF, "interrupted": 0x9A9A9AFF}
"""How an episode may end, by code, and the colour of its marker (RGBA)."""

PALETTE: Final = (
    0x4C9BE8FF, 0xF28E2BFF, 0x59C36AFF, 0xE15759FF, 0xB07AD9FF, 0xEDC948FF,
    0x3FBFB5FF, 0xFF9DA7FF, 0xB58A6BFF, 0x8FA6C8FF, 0xA8C64DFF, 0xD264B6FF,
)  # fmt: skip
"""Colours that are told apart next to each other, on a light and on a dark ground (RGBA)."""


class Place(NamedTuple):
    """Where a panel's entities go: below `root` in a stream. `title` and `color` tell several episodes in one view
    apart; they are empty where there is only one. `single`: one step is all that comes, which makes no line."""

    stream: Any
    root: str = ""
    title: str = ""
    color: int | None = None
    single: bool = False

    def told(self, name: str, *, alone: bool) -> str:
        """The name of a series: of the episode where the view shows only this one of each."""
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
        """How the scalars of an entity are drawn: as lines, or a single row as points."""
        import rerun as rr
        from rerun.components import AggregationPolicy, InterpolationMode, MarkerShape

        style: Any
        if self.single:
            shapes = [MarkerShape.Circle] * len(names)
            style = rr.SeriesPoints(
                names=names, colors=colors, markers=shapes, marker_sizes=[4.0] * len(names)
            )
        else:
            style = rr.SeriesLines(
                names=names,
                colors=colors,
                interpolation_mode=InterpolationMode.StepAfter if stepped else None,
                aggregation_policy=AggregationPolicy.MinMax,
            )
        self.stream.log(self.root + entity, style, static=True)


class Panel(Protocol):
    """Something that is shown."""

    @property
    def title(self) -> str: ...

    @property
    def column(self) -> str:
        """The field that it shows. Only those of "states" have a value after the last step of an episode."""
        ...

    def declare(self, place: Place) -> None:
        """Sends what does not change."""
        ...

    def send(self, place: Place, block: Block, times: Times) -> None:
        """Sends a block of steps; of "states", a block `with_finals`."""
        ...

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        """The view on the entities below each root; `axis` is the time axis of plots."""
        ...


@dataclass(frozen=True)
class Series:
    """Dimensions `dims` of a leaf as one entity of scalars, a line each.

    column: the field of the steps that the leaf is in. stepped: the value is held, as an action is, rather than moved.
    """

    leaf: Leaf
    column: str
    entity: str
    title: str
    dims: Sequence[int]
    names: Sequence[str]
    stepped: bool = False

    def declare(self, place: Place) -> None:
        names = [place.told(name, alone=len(self.names) == 1) for name in self.names]
        place.declare_series(self.entity, names, place.colors(len(names)), stepped=self.stepped)

    def send(self, place: Place, block: Block, times: Times) -> None:
        values = flat_values(self.leaf, self.column, block)
        if len(self.dims) < values.shape[1]:
            values = values[:, list(self.dims)]
        send_scalars(place.stream, place.root + self.entity, times, values)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        told = len(roots) == 1 and len(self.names) > 1  # compared episodes are told beside the returns, once
        return plot(self.title, [root + self.entity for root in roots], axis, legend=told)


@dataclass
class Rewards:
    """The reward, the running return, and a marker at the end of each episode, by how it ended."""

    leaves: Sequence[Leaf]
    title: str = "reward and return"
    column: str = "rewards"
    _running: float = 0.0  # the return of an episode that goes on in the next block

    def declare(self, place: Place) -> None:
        import rerun as rr
        from rerun.components import MarkerShape

        for name, color in (("reward", 6), ("return", 2)):
            place.declare_series(f"/{name}", [place.told(name, alone=True)], place.colors(1, color))
        shapes = (MarkerShape.Cross, MarkerShape.Diamond, MarkerShape.Square)
        for (name, color), shape in zip(ENDS.items(), shapes, strict=True):
            points = rr.SeriesPoints(
                names=[name], colors=np.array([color], np.uint32), markers=[shape], marker_sizes=[5.0]
            )
            place.stream.log(f"{place.root}/end/{name}", points, static=True)

    def send(self, place: Place, block: Block, times: Times) -> None:
        rewards = self._totals(block)
        returns = self._returns(rewards, block)
        send_scalars(place.stream, f"{place.root}/reward", times, rewards[:, None])
        send_scalars(place.stream, f"{place.root}/return", times, returns[:, None])
        ends = [piece for piece in block.pieces if piece.last]
        if not ends:
            return
        how = block.recording.index["end"][[piece.position for piece in ends]]
        rows = np.array([piece.end - 1 for piece in ends], np.int64)
        heights = np.where(np.isfinite(returns), returns, 0.0)  # a marker has to be somewhere
        for code, name in enumerate(ENDS):
            at = rows[how == code]
            if len(at):
                send_scalars(place.stream, f"{place.root}/end/{name}", times.at(at), heights[at][:, None])

    def miss(self) -> None:
        """Steps are left out before the next block: a return that goes on is not known until its episode ends."""
        self._running = np.nan

    def _totals(self, block: Block) -> Array:
        total = np.zeros(len(block))
        for leaf in self.leaves:
            if leaf.dtype is not None and leaf.size:
                total += flat_values(leaf, "rewards", block).sum(axis=1, dtype=np.float64)
        return total

    def _returns(self, rewards: Array, block: Block) -> Array:
        """The return so far, after each step."""
        returns = np.empty(len(rewards))
        if np.isfinite(rewards).all():
            sums = np.cumsum(rewards)
            first = np.array([piece.begin for piece in block.pieces])
            lengths = np.array([piece.end - piece.begin for piece in block.pieces])
            returns = sums - np.repeat(sums[first] - rewards[first], lengths)
        else:  # what is not finite stays in its episode
            for piece in block.pieces:
                np.cumsum(rewards[piece.begin : piece.end], out=returns[piece.begin : piece.end])
        head, tail = block.pieces[0], block.pieces[-1]
        if head.step:  # its episode began in an earlier block
            returns[head.begin : head.end] += self._running
        self._running = 0.0 if tail.last else float(returns[-1])
        return returns

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        import rerun.blueprint as rrb

        ends = [f"{root}/end/{name}" for root in roots for name in ENDS]
        return rrb.Vertical(
            plot("return", [*(f"{root}/return" for root in roots), *ends], axis),
            plot("reward", [f"{root}/reward" for root in roots], axis, legend=False),
            name=self.title,
        )


def flat_values(leaf: Leaf, column: str, block: Block) -> Array:
    """A leaf's values in a block: rows x dimensions."""
    values: Array = leaf.get(getattr(block.columns, column))
    return values.reshape(len(block), -1)


def named(title: str, root: str) -> str:
    """A view's title: of several episodes, which one it is comes first."""
    return f"{root.rpartition('/')[2]}: {title}" if root else title


def plot(title: str, entities: Sequence[str], axis: Any, *, legend: bool = True) -> Any:
    """A view of series over time. A legend of what the title says would only hide it."""
    import rerun.blueprint as rrb

    return rrb.TimeSeriesView(
        name=title,
        origin="/",
        contents=list(entities),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        axis_x=axis,
    )
