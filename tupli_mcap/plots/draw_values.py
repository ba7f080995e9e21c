"""Panels of values: histograms of numbers, bars of choices, one heat map where there are too many dimensions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.plots.page import LEFT, Cell, Page
from tupli_mcap.plots.series import bin_count, bin_edges
from tupli_mcap.plots.style import GREY, VERMILION, colours, cut, number_text, show_alone
from tupli_mcap.plots.values import LeafValues
from tupli_mcap.spaces.element_names import short_path

__all__ = ["LEVELS", "Dimension", "add_values", "colour_bar", "quantiles", "value_names"]

MOST_PANELS = 16
LEVELS = (0, 1, 5, 10, 25, 50, 75, 90, 95, 99, 100)
"""Percents of the quantiles in a heat map."""
_COLUMNS = 4
_BINS = 40
_NAMED_BARS = 12
_BARS = 40
_TICKS = 24
_HEIGHT = 1.15
_SCALES = 10  # how much the sizes of dimensions in one heat map may differ for a linear scale


class Dimension(NamedTuple):
    """Element `i` of a leaf, of one recording or of several."""

    leaves: Sequence[LeafValues]
    i: int

    @property
    def name(self) -> str:
        return self.leaves[0].names[self.i]


Leaves = Sequence[Sequence[LeafValues]]
"""Some leaves, each as the same leaf of every recording."""


def add_values(page: Page, heading: str, *groups: Leaves) -> None:
    """Panels of some leaves; the dimensions of a group that has too many become one heat map."""
    groups = tuple([leaf for leaf in group if leaf[0].kind in ("numbers", "choices")] for group in groups)
    if not any(groups):
        return
    page.heading(heading)
    cells: list[tuple[float, Cell]] = []
    for group in groups:
        numbers = [leaf for leaf in group if leaf[0].kind == "numbers"]
        dimensions = [Dimension(leaf, i) for leaf in numbers for i in range(len(leaf[0].elements))]
        if len(dimensions) > MOST_PANELS:
            page.row(1.7, [Cell(partial(_draw_quantiles, dimensions=dimensions), right=0.9)])
        for leaf in group:
            if leaf[0].kind == "choices":
                cells += _cells_of_choices(leaf)
            elif len(dimensions) <= MOST_PANELS:
                cells += [
                    (_HEIGHT, Cell(partial(_draw_histogram, dimension=Dimension(leaf, i))))
                    for i in range(len(leaf[0].elements))
                ]
    page.pack(cells, _COLUMNS)


def _cells_of_choices(leaf: Sequence[LeafValues]) -> list[tuple[float, Cell]]:
    first = leaf[0]
    names = value_names(first, 0)
    if len(first.counts) == 1 and first.value_names and len(names) <= _NAMED_BARS:
        left = max(LEFT, min(2.2, 0.2 + 0.075 * max(map(len, names))))
        return [
            (max(0.45, 0.2 * len(names)), Cell(partial(_draw_named, leaf=leaf, names=names), 2, left=left))
        ]
    if isinstance(first.leaf.space, spaces.MultiBinary):
        return [(_HEIGHT, Cell(partial(_draw_bits, leaf=leaf), _columns_for(len(first.counts))))]
    if len(first.counts) > MOST_PANELS:
        return [(1.7, Cell(partial(_draw_shares, leaf=first), _COLUMNS, right=0.9))]
    return [
        (_HEIGHT, Cell(partial(_draw_counts, leaf=leaf, i=i), _columns_for(len(counts))))
        for i, counts in enumerate(first.counts)
    ]


def _columns_for(bars: int) -> int:
    return 1 if bars <= 8 else 2 if bars <= 24 else _COLUMNS


# --- numbers ---


def _draw_histogram(axes: Any, dimension: Dimension) -> None:
    leaves, i = dimension
    axes.set_title(cut(dimension.name, 25))
    columns = [leaf.column(i) for leaf in leaves]
    pooled = np.concatenate(columns)
    edges, beyond = bin_edges(pooled, bin_count(len(pooled), _BINS))
    show_alone(axes, edges)
    shades = colours(len(leaves))
    for column, colour in zip(columns, shades, strict=True):
        shares = 100 * np.histogram(column, edges)[0] / max(1, len(column))
        if len(leaves) == 1:
            axes.stairs(shares, edges, fill=True, color=colour)
        else:
            axes.stairs(shares, edges, color=colour, linewidth=1.2)
    axes.set_ylim(bottom=0)
    axes.set_ylabel("% of steps", color=GREY, fontsize=7.5)
    _draw_bounds(axes, leaves[0], i, edges)
    if len(leaves) == 1:
        mean, std = float(leaves[0].mean[i]), float(leaves[0].std[i])
        text = "no finite value" if np.isnan(mean) else f"mean {number_text(mean)}, std {number_text(std)}"
        if beyond:
            text += f"; {beyond:,} beyond"
        axes.set_xlabel(text, color=GREY, fontsize=7.5)
    axes.locator_params(axis="x", nbins=4)
    axes.locator_params(axis="y", nbins=4)


def _draw_bounds(axes: Any, leaf: LeafValues, i: int, edges: Array) -> None:
    """Dashed lines where the space ends, if values come near."""
    space = leaf.leaf.space
    if not isinstance(space, spaces.Box):
        return
    element, width = int(leaf.elements[i]), edges[-1] - edges[0]
    for bound in (float(space.low.reshape(-1)[element]), float(space.high.reshape(-1)[element])):
        if np.isfinite(bound) and edges[0] - 0.1 * width <= bound <= edges[-1] + 0.1 * width:
            axes.axvline(bound, color=GREY, linewidth=0.8, linestyle=(0, (3, 2)))


def quantiles(leaves: Sequence[LeafValues], i: int) -> Array:
    """The quantiles `LEVELS` of element `i` in the samples of some recordings; NaN where nothing is finite."""
    values = np.concatenate([leaf.column(i) for leaf in leaves])
    return np.percentile(values, LEVELS) if len(values) else np.full(len(LEVELS), np.nan)


def _draw_quantiles(axes: Any, dimensions: Sequence[Dimension]) -> None:
    from matplotlib.colors import Normalize, SymLogNorm

    table = np.array([quantiles(d.leaves, d.i) for d in dimensions])
    # of each dimension, the larger of its 1% and 99% quantiles
    sizes = np.abs(np.nan_to_num(table[:, [1, -2]], posinf=0, neginf=0)).max(axis=1)
    most = float(np.abs(np.nan_to_num(table)).max()) or 1.0
    least = float(sizes[sizes > 0].min()) if (sizes > 0).any() else most
    norm: Any = Normalize(-most, most)
    if most > _SCALES * least:  # one scale would show the largest dimensions only
        norm = SymLogNorm(max(least / 2, most * 1e-4), vmin=-most, vmax=most)
    image = axes.imshow(
        table.T, aspect="auto", cmap="RdBu_r", norm=norm, interpolation="nearest", origin="lower",
        extent=(-0.5, len(table) - 0.5, -0.5, len(LEVELS) - 0.5),
    )  # fmt: skip
    axes.grid(False)
    axes.set_title(f"quantiles of each of the {len(dimensions)} dimensions")
    axes.set_yticks(range(len(LEVELS)), [f"{level}%" for level in LEVELS], fontsize=7.5)
    _label_dimensions(axes, dimensions)
    colour_bar(axes, image, "value")


def _label_dimensions(axes: Any, dimensions: Sequence[Dimension]) -> None:
    """Where there are several leaves, a line between them and a name below each; else numbers."""
    starts = [at for at, d in enumerate(dimensions) if d.i == 0]
    if len(starts) == 1:
        axes.set_xlabel(f"dimension of {cut(short_path(dimensions[0].leaves[0].leaf), 40)}")
        return
    for start in starts[1:]:
        axes.axvline(start - 0.5, color="black", linewidth=0.8)
    stops = [*starts[1:], len(dimensions)]
    places, names = [], []
    for start, stop in zip(starts, stops, strict=True):
        room = int(70 * (stop - start) / len(dimensions))
        if room >= 4:
            places.append((start + stop - 1) / 2)
            names.append(cut(short_path(dimensions[start].leaves[0].leaf), room))
    axes.set_xticks(places, names)
    axes.tick_params(axis="x", length=0)


def colour_bar(axes: Any, image: Any, label: str) -> None:
    """A bar of fixed size right of the axes."""
    from matplotlib.ticker import FuncFormatter

    inside = axes.inset_axes((1.015, 0, 0.015, 1))
    bar = axes.figure.colorbar(image, cax=inside)
    bar.formatter = FuncFormatter(lambda value, _: number_text(float(value)))
    bar.set_label(label, fontsize=7.5)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=7.5)
    bar.ax.minorticks_off()


# --- choices ---


def value_names(leaf: LeafValues, i: int) -> list[str]:
    numbers = [str(leaf.starts[i] + k) for k in range(len(leaf.counts[i]))]
    return [cut(name, 26) for name in leaf.value_names] if len(leaf.value_names) == len(numbers) else numbers


def _shares(leaf: LeafValues, i: int) -> Array:
    return 100 * leaf.counts[i] / max(1, leaf.count)


def _never(leaves: Sequence[LeafValues], i: int) -> Array:
    """The values (positions) that occur in none of the recordings."""
    return np.flatnonzero(sum(leaf.counts[i] for leaf in leaves) == 0)


def _draw_named(axes: Any, leaf: Sequence[LeafValues], names: Sequence[str]) -> None:
    """Horizontal bars with the names of the values at their left; the first on top."""
    axes.set_title(cut(leaf[0].names[0], 40))
    at = np.arange(len(names))
    height = 0.8 / len(leaf)
    for k, (one, colour) in enumerate(zip(leaf, colours(len(leaf)), strict=True)):
        axes.barh(at - 0.4 + height * (k + 0.5), _shares(one, 0), height, color=colour)
    for value in _never(leaf, 0):
        axes.text(0, value, " never", color=VERMILION, fontsize=8, va="center")
    axes.set_yticks(at, names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.grid(False, axis="y")
    axes.set_xlabel("% of steps", color=GREY, fontsize=7.5)


def _draw_counts(axes: Any, leaf: Sequence[LeafValues], i: int) -> None:
    """Bars over the numbers of the values; an outline where there are many."""
    axes.set_title(cut(leaf[0].names[i], 25 if len(leaf[0].counts) > 1 else 80))
    start, count = leaf[0].starts[i], len(leaf[0].counts[i])
    edges = start - 0.5 + np.arange(count + 1)
    for one, colour in zip(leaf, colours(len(leaf)), strict=True):
        if len(leaf) > 1:
            axes.stairs(_shares(one, i), edges, color=colour, linewidth=1.2)
        elif count > _BARS:
            axes.stairs(_shares(one, i), edges, fill=True, color=colour)
        else:
            axes.bar(edges[:-1] + 0.5, _shares(one, i), 0.8, color=colour)
    never = _never(leaf, i)
    if len(never):
        axes.plot(start + never, np.zeros(len(never)), "x", color=VERMILION, markersize=4, clip_on=False)
    few = f"{len(never):,} of {count:,} never occur (×)" if len(never) else f"{count:,} values, all occur"
    axes.set_xlabel(few, color=VERMILION if len(never) else GREY, fontsize=7.5)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom=0)
    axes.set_ylabel("% of steps", color=GREY, fontsize=7.5)
    if count <= _TICKS:
        axes.set_xticks(start + np.arange(count))
    else:
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.grid(False, axis="x")


def _draw_bits(axes: Any, leaf: Sequence[LeafValues]) -> None:
    axes.set_title(cut(short_path(leaf[0].leaf), 60))
    edges = np.arange(len(leaf[0].counts) + 1) - 0.5
    for one, colour in zip(leaf, colours(len(leaf)), strict=True):
        ones = np.array([_shares(one, i)[1] for i in range(len(one.counts))])
        if len(leaf) == 1 and len(ones) <= _BARS:
            axes.bar(edges[:-1] + 0.5, ones, 0.8, color=colour)
        else:
            axes.stairs(ones, edges, fill=len(leaf) == 1, color=colour, linewidth=1.2)
    axes.set_ylim(0, 100)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylabel("% of steps", color=GREY, fontsize=7.5)
    axes.set_xlabel("bits that are 1", color=GREY, fontsize=7.5)
    axes.xaxis.get_major_locator().set_params(integer=True)


def _draw_shares(axes: Any, leaf: LeafValues) -> None:
    """How often each value (up) of each element (right) occurs."""
    most = max(len(counts) for counts in leaf.counts)
    table = np.full((most, len(leaf.counts)), np.nan)
    for i, counts in enumerate(leaf.counts):
        table[: len(counts), i] = _shares(leaf, i)
    image = axes.imshow(table, aspect="auto", cmap="viridis", interpolation="nearest", origin="lower", vmin=0)
    axes.grid(False)
    axes.set_title(f"values of each of the {len(leaf.counts)} elements of {cut(short_path(leaf.leaf), 40)}")
    axes.set_xlabel("element")
    axes.set_ylabel("value")
    colour_bar(axes, image, "% of steps")
