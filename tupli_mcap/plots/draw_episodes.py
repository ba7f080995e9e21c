"""Panels over episodes: returns, lengths, success and other numbers in their order, and how they are distributed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots import style
from tupli_mcap.plots.groups import Group, PlottedRun, X, shown_numbers
from tupli_mcap.plots.measure import INFO, SUCCESS
from tupli_mcap.plots.statistics import bands, bin_edges, mean_interval, running_mean
from tupli_mcap.plots.style import Cell, Page, cut

_MOST_DOTS, _VECTOR_DOTS = 3000, 500  # of more there are bands; they are one picture inside an SVG
_MOST_WINDOW, _GROUPS = 100, 250  # episodes of a mean, groups of a band
_POINTS, _MOST_LINES = 200, 12  # of a mean over runs; runs of a group that have lines of their own
_BINS, _HEIGHT, _LOW = 32, 1.65, 1.3
_UNITS = (("h", 3600.0), ("min", 60.0), ("s", 1.0))


class _Course(NamedTuple):
    """Episodes of a run in the order of the x axis: their places, numbers and ends; `whole` is false for those that
    were cut off, which would bend the end of a line."""

    at: Array
    values: Array
    ends: Array
    whole: Array


class _Axis(NamedTuple):
    """The x axis of all panels: what it counts, its label, and how many seconds are one unit of it ("time" only)."""

    x: X
    label: str
    scale: float = 1.0

    @classmethod
    def of(cls, x: X, groups: Sequence[Group]) -> _Axis:
        if x != "time":
            return cls(x, {"episodes": "episode", "steps": "steps"}[x])
        longest = max(float(run.places(x).max()) for group in groups for run in group.runs if len(run.rows))
        unit, scale = next((pair for pair in _UNITS if longest >= 2 * pair[1]), _UNITS[-1])
        return cls(x, f"time ({unit})", scale)

    def course(self, run: PlottedRun, name: str) -> _Course:
        at, values = run.places(self.x) / self.scale, run.numbers(name)
        order = np.argsort(at, kind="stable")
        return _Course(at[order], values[order], run.rows["end"][order], ~run.cut_off[order])


def add_episodes(page: Page, groups: Sequence[Group], x: X) -> None:
    """Panels of groups that have episodes.

    There is no panel of lengths if all are equal: the head says the length.
    """
    page.heading("Episodes")
    axis = _Axis.of(x, groups)
    alike = len({length for group in groups for length in np.unique(group.rows["length"]).tolist()}) == 1
    for name, title in (("return", "return"), ("length", "length (steps)")):
        if name == "return" or not alike:
            order = partial(_draw_order, groups, name, title, axis)
            distribution = partial(_draw_distribution, groups, name, title)
            page.add([Cell(order, _HEIGHT, 3), Cell(distribution, _HEIGHT, 1.25)], 4.25)
    names, _ = shown_numbers(groups)
    titles = ["success rate" if name == SUCCESS else name for name in names]
    titles = [f"{name}, mean of each episode" if name.startswith(INFO) else name for name in titles]
    draws = [partial(_draw_order, groups, *pair, axis) for pair in zip(names, titles, strict=True)]
    page.add([Cell(draw, _LOW, 2) for draw in draws])


def _window(count: int) -> int:
    """Episodes of a running mean: a tenth of all, at most 100."""
    return max(1, min(_MOST_WINDOW, count // 10))


def _filled_runs(groups: Sequence[Group]) -> list[PlottedRun]:
    """The runs that have episodes. The marks of a single one say how its episodes ended; else colours say the group."""
    return [run for group in groups for run in group.runs if len(run.rows)]


def _draw_order(groups: Sequence[Group], name: str, title: str, axis: _Axis, axes: Any) -> None:
    axes.set_title(cut(title, 60))
    runs, label = _filled_runs(groups), axis.label
    if len(runs) == 1:
        _draw_one(axis.course(runs[0], name), name, axes)
    else:
        spans = sorted(_window(len(run.rows)) for run in runs)
        span = f"{spans[0]} to {spans[-1]}" if spans[0] < spans[-1] else str(spans[0])
        label += f"; lines are means of {span} episodes" if spans[-1] > 1 else ""
        for group, colour in zip(groups, style.colours(len(groups)), strict=True):
            courses = [axis.course(run, name) for run in group.runs if len(run.rows)]
            dots = name != SUCCESS and len(runs) <= 4
            _draw_group(group.name, courses, colour, axes, dots=dots)
    low, high = axes.get_xlim()
    if high - low < 1 and axis.x != "time":  # of one episode: the axis shows its number, too
        low, high = low - 1, high + 1
    axes.set_xlim(low, high)
    axes.set_xlabel(label)
    axes.locator_params(axis="x", integer=axis.x != "time")
    if axis.x == "steps":
        axes.xaxis.set_major_formatter(lambda value, _: style.number_text(float(value)))
    if name == SUCCESS:
        axes.set_ylim(-0.04, 1.04)
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    if name in ("return", "length"):  # the others are narrow, and look the same
        style.legend_above(axes)


def _draw_group(name: str, courses: Sequence[_Course], colour: str, axes: Any, *, dots: bool) -> None:
    """A running mean of one run. Of several, their mean and interval up to the end of the shortest, and thin lines."""
    lines = []
    for at, values, _, whole in courses:
        over, mean = at[whole], running_mean(values[whole], _window(len(values)))
        lines.append((over[np.isfinite(mean)], mean[np.isfinite(mean)]))
        if len(courses) == 1:
            axes.plot(over, mean, color=colour, label=cut(name, 24), marker="o" if len(over) == 1 else None)
        elif len(courses) <= _MOST_LINES:
            axes.plot(over, mean, color=colour, linewidth=0.6, alpha=0.35)
        if dots and len(courses) == 1 and len(values) <= _MOST_DOTS:
            dense = len(values) > _VECTOR_DOTS
            axes.scatter(at, values, s=5, color=colour, alpha=0.3, linewidths=0, rasterized=dense)
    lines = [line for line in lines if len(line[0])]
    if len(courses) == 1 or not lines:
        return
    first, last = max(at[0] for at, _ in lines), min(at[-1] for at, _ in lines)
    points = np.linspace(first, max(first, last), _POINTS)
    mean, low, high = mean_interval(np.array([np.interp(points, at, values) for at, values in lines]))
    axes.fill_between(points, low, high, color=colour, alpha=0.2)
    axes.plot(points, mean, color=colour, linewidth=1.6, label=cut(name, 24))


def _draw_one(course: _Course, name: str, axes: Any) -> None:
    """A dot for each episode and a running mean; bands if there are many episodes; for success, only the mean."""
    at, values, ends, whole = course
    if name != SUCCESS and len(at) > _MOST_DOTS:
        where, mean, low, tenth, ninetieth, high = bands(values[whole], _GROUPS)
        where = at[whole][where.astype(np.int64)]
        axes.fill_between(where, low, high, color=style.BLUE, alpha=0.13, label="smallest to largest")
        axes.fill_between(where, tenth, ninetieth, color=style.BLUE, alpha=0.32, label="middle 80%")
        axes.plot(where, mean, color=style.BLUE, label=f"mean of {len(at) // _GROUPS:,} episodes")
        return
    for i, end in enumerate(END_NAMES):
        chosen = ends == i
        if chosen.any() and name != SUCCESS:
            colour, marker = style.ENDS[end]
            axes.scatter(
                at[chosen], values[chosen], s=float(np.clip(3000 / len(at), 5, 26)), c=colour,
                marker=marker, linewidths=0, label=end, alpha=0.75, rasterized=len(at) > _VECTOR_DOTS,
            )  # fmt: skip
    window = _window(len(at))
    if window > 1 or name == SUCCESS:
        label = f"mean of {window} episodes" if window > 1 else None
        shape = "o" if window == 1 else ""
        mean = running_mean(values[whole], window)
        axes.plot(at[whole], mean, color=style.INK, linewidth=1.4, label=label, marker=shape)


def _draw_distribution(groups: Sequence[Group], column: str, name: str, axes: Any) -> None:
    columns = [group.numbers(column) for group in groups]
    pooled = np.concatenate(columns)
    edges, beyond = bin_edges(pooled, _BINS)
    if len(_filled_runs(groups)) == 1:
        axes.set_ylabel("episodes", color=style.GREY)
        axes.locator_params(axis="y", integer=True)
        finite = np.isfinite(pooled)
        ends, values = groups[0].rows["end"][finite], pooled[finite]
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
