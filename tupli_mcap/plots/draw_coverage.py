"""Where the states of a recording lie: the density of the dimensions that vary most, two and two."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.plots.draw_values import colour_bar
from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.page import Cell, Page
from tupli_mcap.plots.series import LARGEST, bin_count, bin_edges, drawn
from tupli_mcap.plots.style import cut

__all__ = ["add_coverage", "most_varying"]

_BINS = 60
_MOST_MAPS = 4


class _Pair(NamedTuple):
    """Two dimensions of the states, as (leaf, element)."""

    x: tuple[int, int]
    y: tuple[int, int]


def most_varying(measured: Measured, most: int = 4) -> list[tuple[int, int]]:
    """(leaf, element) of the state's dimensions with the largest standard deviations above 0, largest first."""
    found = [
        (-float(std), at, i)
        for at, leaf in enumerate(measured.states)
        for i, std in enumerate(leaf.std)
        if 0 < std < LARGEST
    ]
    return [(at, i) for _, at, i in sorted(found)[:most]]


def add_coverage(page: Page, measured: Sequence[Measured]) -> None:
    """Maps of the states: of one recording, of two pairs of dimensions; of several, one pair of each."""
    varying = most_varying(measured[0])
    if len(varying) < 2:
        return
    pairs = [_pair(varying[0], varying[1])]
    if len(varying) > 2 and len(measured) == 1:
        pairs.append(_pair(varying[2], varying[3]) if len(varying) > 3 else _pair(varying[0], varying[2]))
    cells = []
    for pair in pairs:
        points = [_points(one, pair) for one in measured[:_MOST_MAPS]]
        pooled = np.concatenate(points)
        bins = bin_count(len(pooled), _BINS)
        edges = (bin_edges(pooled[:, 0], bins)[0], bin_edges(pooled[:, 1], bins)[0])
        for one, found in zip(measured[:_MOST_MAPS], points, strict=True):
            title = f"where the states lie{f': {one.name}' if len(measured) > 1 else ''}"
            draw = partial(_draw_map, measured=one, pair=pair, points=found, edges=edges, title=title)
            cells.append((2.1, Cell(draw, 2, right=0.85)))
    page.pack(cells)


def _pair(one: tuple[int, int], other: tuple[int, int]) -> _Pair:
    return _Pair(*sorted((one, other)))


def _points(measured: Measured, pair: _Pair) -> Array:
    """The sampled steps that have both dimensions: (n, 2)."""
    columns = [drawn(measured.states[leaf].sample[:, i]) for leaf, i in pair]
    points = np.stack(columns, axis=1)
    finite: Array = points[np.isfinite(points).all(axis=1)]
    return finite


def _draw_map(
    axes: Any, measured: Measured, pair: _Pair, points: Array, edges: tuple[Array, Array], title: str
) -> None:
    from matplotlib.colors import LogNorm

    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], edges)
    shares = 100 * counts / max(1, len(points))
    seen = shares[shares > 0]
    least, most = (float(seen.min()), float(seen.max())) if len(seen) else (1.0, 1.0)
    mesh = axes.pcolormesh(
        *edges, np.where(shares > 0, shares, np.nan).T, cmap="viridis", rasterized=True,
        norm=LogNorm(least, max(most, least * 10)),
    )  # fmt: skip
    axes.grid(False)
    axes.locator_params(axis="x", nbins=6)  # numbers such as -0.175 beside each other
    names = [measured.states[leaf].names[i] for leaf, i in pair]
    axes.set_xlabel(cut(names[0], 40))
    axes.set_ylabel(cut(names[1], 26))
    axes.set_title(cut(title, 60))
    for axis, at in ((axes.xaxis, edges[0]), (axes.yaxis, edges[1])):
        if at[1] - at[0] == 1:  # whole numbers
            axis.get_major_locator().set_params(integer=True)
    colour_bar(axes, mesh, "% of steps")
