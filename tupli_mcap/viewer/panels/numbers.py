"""Panels of numbers over time: lines for a leaf's dimensions, reward and return."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.blocks import Block
from tupli_mcap.viewer.panels.panel import LeafPanel, Root, plot, send_lines
from tupli_mcap.viewer.sdk import rr, rrb
from tupli_mcap.viewer.sending import Times, send_scalars

_ENDS: Mapping[str, int] = {"terminal": 0xE4572EFF, "timeout": 0xF3A712FF, "interrupted": 0x9A9A9AFF}
"""How an episode may end, by code, and the colour of its marker (RGBA)."""


@dataclass(frozen=True)
class Series(LeafPanel):
    """Dimensions `dims` of a leaf as one entity of scalars, a line each.

    stepped: the value is held, as an action is, rather than moved.
    """

    dims: Sequence[int]
    names: Sequence[str]
    stepped: bool = False

    def declare(self, place: Root) -> None:
        names = [place.series_name(name, alone=len(self.names) == 1) for name in self.names]
        place.declare_series(self.entity, names, place.colors(len(names)), stepped=self.stepped)

    def send(self, place: Root, block: Block, times: Times) -> None:
        values = self.flat(block)
        if len(self.dims) < values.shape[1]:
            values = values[:, list(self.dims)]
        send_lines(place, self.entity, times, values)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        # compared episodes are named once, beside the returns
        legend = len(roots) == 1 and len(self.names) > 1
        return plot(self.title, [root + self.entity for root in roots], axis, legend=legend)


@dataclass
class Rewards:
    """The reward, the running return, and a marker at the end of each episode, by how it ended."""

    leaves: Sequence[Leaf]
    title: str = "reward and return"
    column: str = "rewards"
    _running: float = 0.0  # the return of an episode that goes on in the next block

    def declare(self, place: Root) -> None:
        for name, color in (("reward", 6), ("return", 2)):
            place.declare_series(f"/{name}", [place.series_name(name, alone=True)], place.colors(1, color))
        shape_of = rr.components.MarkerShape
        shapes = (shape_of.Cross, shape_of.Diamond, shape_of.Square)
        for (name, color), shape in zip(_ENDS.items(), shapes, strict=True):
            points = rr.SeriesPoints(
                names=[name], colors=np.array([color], np.uint32), markers=[shape], marker_sizes=[5.0]
            )
            place.stream.log(f"{place.root}/end/{name}", points, static=True)

    def send(self, place: Root, block: Block, times: Times) -> None:
        with np.errstate(over="ignore", invalid="ignore"):  # returns beyond all floats are infinite, or NaN
            rewards = self._totals(block)
            returns = self._returns(rewards, block)
        send_lines(place, "/reward", times, rewards[:, None])
        send_lines(place, "/return", times, returns[:, None])
        heights = np.where(np.isfinite(returns), returns, 0.0)  # a marker needs a finite position
        for code, name in enumerate(_ENDS):
            at = np.array([piece.end - 1 for piece in block.pieces if piece.how_ended == code], np.int64)
            if len(at):
                send_scalars(place.stream, f"{place.root}/end/{name}", times.at(at), heights[at][:, None])

    def miss(self) -> None:
        """Call this if steps are left out before the next block: the return is then unknown until the episode ends."""
        self._running = np.nan

    def _totals(self, block: Block) -> Array:
        total = np.zeros(len(block))
        for leaf in self.leaves:
            if leaf.dtype is not None and leaf.size:
                values = leaf.get(block.columns.rewards).reshape(len(block), -1)
                total += values.sum(axis=1, dtype=np.float64)
        return total

    def _returns(self, rewards: Array, block: Block) -> Array:
        """The return so far, after each step."""
        returns = np.empty(len(rewards))
        # each episode by itself: large rewards, NaN and infinities must not spill into the next one
        for piece in block.pieces:
            np.cumsum(rewards[piece.begin : piece.end], out=returns[piece.begin : piece.end])
        head, tail = block.pieces[0], block.pieces[-1]
        if head.step:  # its episode began in an earlier block
            returns[head.begin : head.end] += self._running
        self._running = 0.0 if tail.how_ended is not None else float(returns[-1])
        return returns

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        ends = [f"{root}/end/{name}" for root in roots for name in _ENDS]
        return rrb.Vertical(
            plot("return", [*(f"{root}/return" for root in roots), *ends], axis),
            plot("reward", [f"{root}/reward" for root in roots], axis, legend=False),
            name=self.title,
        )
