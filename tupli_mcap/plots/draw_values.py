"""Panels of values: histograms, bars of choices, heat maps of many dimensions, and maps of visited states."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.plots import style
from tupli_mcap.plots.statistics import LARGEST, LeafValues, bin_edges, drawable_numbers
from tupli_mcap.plots.style import COLUMNS, LEFT, SMALL, Cell, Page, cut, number_text

Leaves = Sequence[LeafValues]  # the same leaf of each group of recordings
Dimension = tuple[Leaves, int]  # one of its elements

LEVELS = (0, 1, 5, 10, 25, 50, 75, 90, 95, 99, 100)  # percents of the quantiles in a heat map
_MOST_PANELS = 16
_HEIGHT, _MAP_HEIGHT, _TABLE_HEIGHT = 1.15, 2.1, 1.7
_BINS, _MAP_BINS, _MOST_MAPS = 40, 60, 4
_NAMED_BARS, _BARS, _TICKS = 12, 40, 24  # above these: no names; an outline; few numbers
_SCALES = 10  # how much the sizes of dimensions in one heat map may differ for a linear scale


def add_values(page: Page, heading: str, *groups: Sequence[Leaves]) -> None:
    """Panels of some leaves; the numbers of a group that has too many dimensions become one heat map."""
    if any(_dimensions(group) for group in groups):
        page.heading(heading)
    cells: list[Cell] = []
    for group in groups:
        numbers = _dimensions([leaves for leaves in group if leaves[0].kind == "numbers"])
        if len(numbers) > _MOST_PANELS:
            page.add([Cell(partial(_draw_quantiles, numbers), _TABLE_HEIGHT, COLUMNS, right=0.9)])
        for leaves in group:
            if leaves[0].kind == "choices":
                cells += _cells_of_choices(leaves)
            elif len(numbers) <= _MOST_PANELS:
                cells += [Cell(partial(_draw_histogram, *of), _HEIGHT) for of in _dimensions([leaves])]
    page.add(cells)


def _dimensions(group: Sequence[Leaves]) -> list[Dimension]:
    return [(leaves, i) for leaves in group for i in range(len(leaves[0].elements))]


def _draw_histogram(leaves: Leaves, i: int, axes: Any) -> None:
    """Dashed lines show where the space ends, if values come near."""
    first, space = leaves[0], leaves[0].leaf.space
    columns = [leaf.column(i) for leaf in leaves]
    pooled = np.concatenate(columns)
    edges, beyond = bin_edges(pooled, _BINS)
    style.draw_histograms(axes, [100 * np.histogram(v, edges)[0] / max(1, len(v)) for v in columns], edges)
    axes.set(title=cut(first.names[i], 25), ylim=(0, None))
    axes.set_ylabel("% of steps", **SMALL)
    margin = 0.1 * (edges[-1] - edges[0])
    for bounds in (space.low, space.high) if isinstance(space, spaces.Box) else ():
        bound = float(bounds.flat[first.elements[i]])
        if np.isfinite(bound) and edges[0] - margin <= bound <= edges[-1] + margin:
            axes.axvline(bound, color=style.GREY, linewidth=0.8, linestyle=(0, (3, 2)))
    if len(leaves) == 1:
        mean, std = number_text(first.mean[i]), number_text(first.std[i])
        text = "no finite value" if np.isnan(first.mean[i]) else f"mean {mean}, std {std}"
        axes.set_xlabel(f"{text}; {beyond:,} beyond" if beyond else text, **SMALL)
    axes.locator_params(nbins=4)


def quantiles(leaves: Leaves, i: int) -> Array:
    """The quantiles `LEVELS` of element `i` in some recordings; NaN where nothing is finite."""
    values = np.concatenate([leaf.column(i) for leaf in leaves])
    return np.percentile(values, LEVELS) if len(values) else np.full(len(LEVELS), np.nan)


def _draw_quantiles(dimensions: Sequence[Dimension], axes: Any) -> None:
    from matplotlib.colors import Normalize, SymLogNorm

    table = np.array([quantiles(*dimension) for dimension in dimensions])
    sizes = np.abs(np.nan_to_num(table))
    most = float(sizes.max()) or 1.0
    sizes = sizes[:, [1, -2]].max(axis=1)  # of each dimension, the larger of its 1% and 99% quantiles
    least = float(sizes[sizes > 0].min(initial=most))
    norm: Any = Normalize(-most, most)
    if most > _SCALES * least:  # one scale would show the largest dimensions only
        norm = SymLogNorm(max(least / 2, most * 1e-4), vmin=-most, vmax=most)
    style.heat_map(axes, table.T, "value", cmap="RdBu_r", norm=norm, origin="lower")
    axes.set_title(f"quantiles of each of the {len(dimensions)} dimensions")
    axes.set_yticks(range(len(LEVELS)), [f"{level}%" for level in LEVELS], fontsize=7.5)
    # Several leaves get a line between them and a name below each; one leaf gets numbers.
    starts = [at for at, (_, i) in enumerate(dimensions) if i == 0]
    names = [dimensions[start][0][0].leaf.path for start in starts]
    if len(starts) == 1:
        axes.set_xlabel(f"dimension of {cut(names[0], 40)}")
        return
    for start in starts[1:]:
        axes.axvline(start - 0.5, color="black", linewidth=0.8)
    counts = np.diff([*starts, len(dimensions)])
    rooms = 70 * counts // len(dimensions)
    shown = [cut(name, room) if room >= 4 else "" for name, room in zip(names, rooms.tolist(), strict=True)]
    axes.set_xticks(starts + (counts - 1) / 2, shown)
    axes.tick_params(axis="x", length=0)


def _cells_of_choices(leaves: Leaves) -> list[Cell]:
    first = leaves[0]
    names = [cut(name, 26) for name in first.value_names]
    if 0 < len(names) <= _NAMED_BARS:
        left = max(LEFT, min(2.2, 0.2 + 0.075 * max(map(len, names))))
        return [Cell(partial(_draw_named, leaves, names), max(0.45, 0.2 * len(names)), 2, left=left)]
    if isinstance(first.leaf.space, spaces.MultiBinary):
        bars = [(partial(_draw_bits, leaves), len(first.counts))]
    elif len(first.counts) > _MOST_PANELS:
        return [Cell(partial(_draw_shares, first), _TABLE_HEIGHT, COLUMNS, right=0.9)]
    else:
        bars = [(partial(_draw_counts, leaves, i), len(counts)) for i, counts in enumerate(first.counts)]
    return [Cell(draw, _HEIGHT, 1 if n <= 8 else 2 if n <= 24 else COLUMNS) for draw, n in bars]


def _draw_named(leaves: Leaves, names: Sequence[str], axes: Any) -> None:
    """Horizontal bars with the names of the values at their left; the first on top."""
    at = np.arange(len(names))
    height = 0.8 / len(leaves)
    for k, (leaf, colour) in enumerate(zip(leaves, style.colours(len(leaves)), strict=True)):
        axes.barh(at - 0.4 + height * (k + 0.5), leaf.share(0), height, color=colour)
    for value in np.flatnonzero(sum(leaf.counts[0] for leaf in leaves) == 0):
        axes.text(0, value, " never", color=style.VERMILION, fontsize=8, va="center")
    axes.set_yticks(at, names)
    axes.set(title=cut(leaves[0].names[0], 40), ylim=(len(names) - 0.5, -0.5), xlim=(0, None))
    axes.grid(False, axis="y")
    axes.set_xlabel("% of steps", **SMALL)


def _draw_bars(shares: Sequence[Array], start: int, axes: Any) -> None:
    """Bars over the whole numbers from `start` on; outlines if there are many numbers, or several recordings."""
    edges = start - 0.5 + np.arange(len(shares[0]) + 1)
    if len(shares) == 1 and len(shares[0]) <= _BARS:
        axes.bar(edges[:-1] + 0.5, shares[0], 0.8, color=style.BLUE)
    else:
        style.draw_histograms(axes, shares, edges)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylabel("% of steps", **SMALL)
    axes.locator_params(axis="x", integer=True)


def _draw_counts(leaves: Leaves, i: int, axes: Any) -> None:
    first = leaves[0]
    never = np.flatnonzero(sum(leaf.counts[i] for leaf in leaves) == 0)
    start, count = first.starts[i], len(first.counts[i])
    _draw_bars([leaf.share(i) for leaf in leaves], start, axes)
    if len(never):
        axes.plot(start + never, 0 * never, "x", color=style.VERMILION, markersize=4, clip_on=False)
        axes.set_xlabel(f"{len(never):,} of {count:,} never occur (×)", **SMALL | {"color": style.VERMILION})
    else:
        axes.set_xlabel(f"{count:,} values, all occur" if count > 1 else "the only value", **SMALL)
    axes.set(title=cut(first.names[i], 25 if len(first.counts) > 1 else 80), ylim=(0, None))
    if count <= _TICKS:
        axes.set_xticks(start + np.arange(count))
    axes.grid(False, axis="x")


def _draw_bits(leaves: Leaves, axes: Any) -> None:
    _draw_bars([np.array([leaf.share(i)[1] for i in range(len(leaf.counts))]) for leaf in leaves], 0, axes)
    axes.set(title=cut(leaves[0].leaf.path, 60), ylim=(0, 100))
    axes.set_xlabel("bits that are 1", **SMALL)


def _draw_shares(leaf: LeafValues, axes: Any) -> None:
    """How often each value (up) of each element (right) occurs."""
    shares = [leaf.share(i) for i in range(len(leaf.counts))]
    table = np.array(list(itertools.zip_longest(*shares, fillvalue=np.nan)))
    style.heat_map(axes, table, "% of steps", origin="lower", vmin=0)
    title = f"values of each of the {len(shares)} elements of {cut(leaf.leaf.path, 40)}"
    axes.set(title=title, xlabel="element", ylabel="value")


def most_varying(states: Sequence[Leaves]) -> list[int]:
    """The dimensions (at most four) with the largest standard deviation in the first recording, in descending order."""
    stds = np.array([leaves[0].std[i] for leaves, i in _dimensions(states)])
    return [at for at in np.argsort(-stds, kind="stable").tolist() if 0 < stds[at] < LARGEST][:4]


def add_coverage(page: Page, states: Sequence[Leaves], names: Sequence[str]) -> None:
    """Maps of the states: of one recording, over two pairs of dimensions; of several, over one pair for each."""
    varying = most_varying(states)
    pairs = [sorted(varying[:2])] if len(varying) > 1 else []
    if len(varying) > 2 and len(names) == 1:
        pairs.append(sorted(varying[2:] if len(varying) > 3 else varying[::2]))
    cells = []
    for pair in pairs:
        x, y = (_dimensions(states)[at] for at in pair)
        points = []  # of each recording, the steps that have both dimensions (n, 2)
        for k in range(min(len(names), _MOST_MAPS)):
            both = np.stack([drawable_numbers(leaves[k].values[i]) for leaves, i in (x, y)], axis=1)
            points.append(both[np.isfinite(both).all(axis=1)])
        pooled = np.concatenate(points)
        edges = [bin_edges(column, _MAP_BINS)[0] for column in pooled.T]
        for name, of_recording in zip(names, points, strict=False):
            title = f"where the states lie{f': {name}' if len(names) > 1 else ''}"
            cells.append(
                Cell(partial(_draw_map, x, y, of_recording, edges, title), _MAP_HEIGHT, 2, right=0.85)
            )
    page.add(cells)


def _draw_map(x: Dimension, y: Dimension, points: Array, edges: list[Array], title: str, axes: Any) -> None:
    from matplotlib.colors import LogNorm

    counts = np.histogram2d(points[:, 0], points[:, 1], edges)[0]
    shares = np.where(counts > 0, 100 * counts / max(1, len(points)), np.nan)
    least, most = (np.nanmin(shares), np.nanmax(shares)) if counts.any() else (1.0, 1.0)
    norm = LogNorm(least, max(most, least * 10))
    mesh = axes.pcolormesh(*edges, shares.T, cmap="viridis", rasterized=True, norm=norm)
    axes.grid(False)
    axes.locator_params(axis="x", nbins=6)  # numbers such as -0.175 beside each other
    xlabel, ylabel = cut(x[0][0].names[x[1]], 40), cut(y[0][0].names[y[1]], 26)
    axes.set(title=cut(title, 60), xlabel=xlabel, ylabel=ylabel)
    for axis, at in zip("xy", edges, strict=True):
        axes.locator_params(axis=axis, integer=bool(at[1] - at[0] == 1))
    style.colour_bar(axes, mesh, "% of steps")
