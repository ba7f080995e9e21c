"""Panels over episodes: returns and lengths in their order, and how they are distributed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots import style
from tupli_mcap.plots.measure import Measured
from tupli_mcap.plots.statistics import bands, bin_edges, drawable_numbers, running_mean
from tupli_mcap.plots.style import Cell, Page, cut

__all__ = ["add_episodes"]

_MOST_DOTS, _VECTOR_DOTS = 3000, 500  # of more there are bands; they are one picture inside an SVG
_MOST_WINDOW, _GROUPS = 100, 250  # episodes of a mean, groups of a band
_BINS, _HEIGHT = 32, 1.65


def add_episodes(page: Page, measured: Sequence[Measured]) -> None:
    """Returns and lengths of recordings that have episodes."""
    page.heading("Episodes")
    for column, name in (("return", "return"), ("length", "length (steps)")):
        order, distribution = (partial(f, measured, column, name) for f in (_draw_order, _draw_distribution))
        page.add([Cell(order, _HEIGHT, 3), Cell(distribution, _HEIGHT, 1.25)], 4.25)


def _window(count: int) -> int:
    """Episodes of a running mean: a tenth of all, at most 100."""
    return max(1, min(_MOST_WINDOW, count // 10))


def _draw_order(measured: Sequence[Measured], column: str, name: str, axes: Any) -> None:
    axes.set_title(name)
    if len(measured) == 1:
        _draw_one(measured[0].rows, drawable_numbers(measured[0].rows[column]), axes)
        axes.set_xlabel("episode")
    else:
        for one, colour in zip(measured, style.colours(len(measured)), strict=True):
            numbers, values = one.rows["episode"], drawable_numbers(one.rows[column])
            marker = "o" if len(values) == 1 else None
            mean = running_mean(values, _window(len(values)))
            axes.plot(numbers, mean, color=colour, label=cut(one.name, 24), marker=marker)
            if len(values) <= _MOST_DOTS and len(measured) <= 4:
                dense = len(values) > _VECTOR_DOTS
                axes.scatter(numbers, values, s=5, color=colour, alpha=0.3, linewidths=0, rasterized=dense)
        spans = sorted(_window(len(one.rows)) for one in measured)
        span = f"{spans[0]} to {spans[-1]}" if spans[0] < spans[-1] else str(spans[0])
        axes.set_xlabel(f"episode; lines are means of {span} episodes" if spans[-1] > 1 else "episode")
    low, high = axes.get_xlim()
    if high - low < 1:  # of one episode: the axis shows its number, too
        axes.set_xlim(low - 1, high + 1)
    else:
        axes.set_xlim(low, high)
    axes.locator_params(axis="x", integer=True)
    style.legend_above(axes)


def _draw_one(rows: Array, values: Array, axes: Any) -> None:
    """A dot for each episode and a running mean; of many episodes, bands."""
    if len(rows) > _MOST_DOTS:
        at, mean, low, tenth, ninetieth, high = bands(values, _GROUPS)
        at = rows["episode"][at.astype(np.int64)]
        axes.fill_between(at, low, high, color=style.BLUE, alpha=0.13, label="smallest to largest")
        axes.fill_between(at, tenth, ninetieth, color=style.BLUE, alpha=0.32, label="middle 80%")
        axes.plot(at, mean, color=style.BLUE, label=f"mean of {len(rows) // _GROUPS:,} episodes")
        return
    for i, end in enumerate(END_NAMES):
        chosen = rows["end"] == i
        if chosen.any():
            colour, marker = style.ENDS[end]
            axes.scatter(
                rows["episode"][chosen], values[chosen], s=float(np.clip(3000 / len(rows), 5, 26)), c=colour,
                marker=marker, linewidths=0, label=end, alpha=0.75, rasterized=len(rows) > _VECTOR_DOTS,
            )  # fmt: skip
    window = _window(len(rows))
    if window > 1:
        mean = running_mean(values, window)
        axes.plot(rows["episode"], mean, color=style.INK, linewidth=1.4, label=f"mean of {window} episodes")


def _draw_distribution(measured: Sequence[Measured], column: str, name: str, axes: Any) -> None:
    columns = [drawable_numbers(one.rows[column]) for one in measured]
    pooled = np.concatenate(columns)
    edges, beyond = bin_edges(pooled, _BINS)
    if len(measured) == 1:
        axes.set_ylabel("episodes", color=style.GREY)
        axes.locator_params(axis="y", integer=True)
        finite = np.isfinite(pooled)
        ends, values = measured[0].rows["end"][finite], pooled[finite]
        frequent = [i for i, _ in Counter(ends.tolist()).most_common()]  # the most frequent end at the bottom
        if frequent:
            axes.hist(
                [values[ends == i] for i in frequent], edges, stacked=True, label=[END_NAMES[i] for i in frequent],
                color=[style.ENDS[END_NAMES[i]][0] for i in frequent],
            )  # fmt: skip
        axes.set_ylim(bottom=0)
        if len(pooled) > _MOST_DOTS:  # else the dots at the left say which colour is which
            style.legend_above(axes)
    else:
        axes.set_ylabel("% of episodes", color=style.GREY)
        style.draw_histograms(axes, [100 * np.histogram(v, edges)[0] / len(v) for v in columns], edges)
    odd = int((~np.isfinite(pooled)).sum())
    left_out = [f"{count:,} {word}" for count, word in ((beyond, "beyond"), (odd, "not finite")) if count]
    axes.set_xlabel("; ".join([name, *left_out]))
