"""Panels over episodes: returns and lengths in their order, and how they are distributed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.page import Cell, Page
from tupli_mcap.plots.series import bands, bin_count, bin_edges, drawn, running_mean, window_of
from tupli_mcap.plots.style import BLUE, ENDS, GREY, INK, colours, drawable, legend_above, show_alone

__all__ = ["add_episodes"]

MOST_DOTS = 3000
_VECTOR_DOTS = 500  # more are one picture inside an SVG
_GROUPS = 250
_BINS = 32


def add_episodes(page: Page, measured: Sequence[Measured]) -> None:
    """Returns and lengths."""
    page.heading("Episodes")
    for column, name in (("return", "return"), ("length", "length (steps)")):
        cells = [
            Cell(partial(_draw_order, measured=measured, column=column, name=name), 3),
            Cell(partial(_draw_distribution, measured=measured, column=column, name=name), 1.25),
        ]
        page.row(1.65, cells)


def _draw_order(axes: Any, measured: Sequence[Measured], column: str, name: str) -> None:
    axes.set_title(name)
    axes.set_xlabel("episode")
    if len(measured) == 1:
        rows = measured[0].rows
        values = drawn(rows[column])
        if len(rows) <= MOST_DOTS:
            _draw_dots(axes, rows, values)
        else:
            _draw_bands(axes, rows["episode"].astype(np.float64), values, BLUE)
    else:
        for one, colour in zip(measured, colours(len(measured)), strict=True):
            _draw_one_of_several(axes, one, column, colour, few=len(measured) <= 4)
        axes.set_xlabel(f"episode{_told_of_lines([len(one.rows) for one in measured])}")
    numbers = np.concatenate([one.rows["episode"].astype(np.int64) for one in measured])
    if numbers.min() == numbers.max():
        axes.set_xlim(numbers[0] - 1, numbers[0] + 1)
    axes.xaxis.get_major_locator().set_params(integer=True)
    legend_above(axes)


def _told_of_lines(counts: Sequence[int]) -> str:
    """What the lines of recordings of so many episodes are."""
    spans = [count // _GROUPS if count > MOST_DOTS else window_of(count) for count in counts]
    least, most = min(spans), max(spans)
    if most == 1:
        return ""
    return f"; lines are means of {most if least == most else f'{least} to {most}'} episodes"


def _draw_dots(axes: Any, rows: Array, values: Array) -> None:
    size = float(np.clip(3000 / max(1, len(rows)), 5, 26))
    for i, end in enumerate(END_NAMES):
        chosen = rows["end"] == i
        if chosen.any():
            colour, marker = ENDS[end]
            axes.scatter(
                rows["episode"][chosen], values[chosen], s=size, c=colour, marker=marker, linewidths=0, label=end,
                alpha=0.75, rasterized=len(rows) > _VECTOR_DOTS,
            )  # fmt: skip
    window = window_of(len(rows))
    if window > 1:
        mean = running_mean(values, window)
        axes.plot(rows["episode"], mean, color=INK, linewidth=1.4, label=f"mean of {window} episodes")


def _draw_bands(axes: Any, numbers: Array, values: Array, colour: str, name: str = "") -> None:
    found = bands(values, _GROUPS)
    at = numbers[found.at.astype(np.int64)]
    if not name:
        axes.fill_between(at, found.low, found.high, color=colour, alpha=0.13, label="smallest to largest")
        axes.fill_between(at, found.tenth, found.ninetieth, color=colour, alpha=0.32, label="middle 80%")
        name = f"mean of {len(values) // _GROUPS:,} episodes"
    axes.plot(at, found.mean, color=colour, label=name)


def _draw_one_of_several(axes: Any, measured: Measured, column: str, colour: str, *, few: bool) -> None:
    numbers = measured.rows["episode"].astype(np.float64)
    values = drawn(measured.rows[column])
    name = drawable(measured.name, 24)
    if len(values) > MOST_DOTS:
        _draw_bands(axes, numbers, values, colour, name)
        return
    if few:
        axes.scatter(
            numbers, values, s=5, color=colour, alpha=0.3, linewidths=0, rasterized=len(values) > _VECTOR_DOTS
        )
    axes.plot(
        numbers, running_mean(values, window_of(len(values))), color=colour, label=name,
        marker="o" if len(values) == 1 else None,
    )  # fmt: skip


def _draw_distribution(axes: Any, measured: Sequence[Measured], column: str, name: str) -> None:
    pooled = np.concatenate([drawn(one.rows[column]) for one in measured])
    edges, beyond = bin_edges(pooled, bin_count(len(pooled), _BINS))
    show_alone(axes, edges)
    if len(measured) == 1:
        axes.set_ylabel("episodes", color=GREY)
        axes.yaxis.get_major_locator().set_params(integer=True)
        _draw_ends(axes, measured[0].rows, column, edges)
        if len(pooled) > MOST_DOTS:  # else the dots at the left have told
            legend_above(axes)
    else:
        axes.set_ylabel("% of episodes", color=GREY)
        for one, colour in zip(measured, colours(len(measured)), strict=True):
            values = drawn(one.rows[column])
            counts, _ = np.histogram(values[np.isfinite(values)], edges)
            axes.stairs(100 * counts / max(1, len(values)), edges, color=colour, linewidth=1.2)
    odd = int((~np.isfinite(pooled)).sum())
    left_out = [f"{count:,} {word}" for count, word in ((beyond, "beyond"), (odd, "not finite")) if count]
    axes.set_xlabel("; ".join([name, *left_out]))


def _draw_ends(axes: Any, rows: Array, column: str, edges: Array) -> None:
    """Stacked, the most frequent end at the bottom."""
    below = np.zeros(len(edges) - 1)
    for i in np.argsort(-np.bincount(rows["end"], minlength=len(END_NAMES)), kind="stable"):
        values = drawn(rows[column][rows["end"] == i])
        counts, _ = np.histogram(values[np.isfinite(values)], edges)
        if counts.any():
            axes.stairs(
                below + counts,
                edges,
                baseline=below,
                fill=True,
                color=ENDS[END_NAMES[i]][0],
                label=END_NAMES[i],
            )
        below += counts
    axes.set_ylim(0, max(1.0, float(below.max())) * 1.05)
