"""Panels of one episode, one below the other over the same steps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.plots.draw_values import colour_bar, value_names
from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.page import Cell, Page
from tupli_mcap.plots.style import BLUE, INK, SERIES, cut, number_text
from tupli_mcap.plots.trace import Pictures, Trace
from tupli_mcap.plots.values import LeafValues
from tupli_mcap.spaces.element_names import short_path

__all__ = ["add_trace", "by_scale"]

MOST_LINES = 12
_LINES = 6  # of one panel
_SAME_SCALE = 8  # lines of one panel differ by this factor at most
_CHOICES = 2  # panels of one leaf
_NAMED = 8  # values of a choice that are named at the axis
_HEIGHT, _LEGEND = 0.75, 1.85


def add_trace(page: Page, measured: Measured, trace: Trace, heading: str) -> None:
    """One episode: pictures, states, actions, rewards and the running return."""
    page.heading(heading)
    for pictures in trace.pictures:
        _add_pictures(page, pictures)
    panels: list[partial[None]] = []
    for leaves, steps in ((measured.states, False), (measured.actions, True)):
        panels += _panels_of(trace, leaves, steps=steps)
    for reward in measured.rewards:
        if len(reward.elements) <= _LINES:
            panels.append(partial(_draw_lines, trace=trace, leaf=reward, chosen=list(range(len(reward.elements))),
                                  steps=True))  # fmt: skip
    panels.append(partial(_draw_return, trace=trace))
    for i, draw in enumerate(panels):
        last = i == len(panels) - 1
        height = _HEIGHT + (0.5 if draw.func is _draw_table and draw.keywords["scaled"] else 0)
        cell = Cell(partial(_on_steps, trace=trace, draw=draw, measured=measured, last=last), right=_LEGEND)
        page.row(height, [cell], tight=not last)


def _on_steps(axes: Any, trace: Trace, draw: Any, measured: Measured, last: bool) -> None:
    draw(axes)
    axes.set_xlim(-0.5, max(trace.length, 1) - 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    if trace.length <= 1:
        axes.set_xticks([0])
    if last:
        seconds = measured.step_seconds
        unit = "" if seconds is None else f" (each {number_text(seconds)} s)"
        thinned = f"; smallest and largest of every {trace.thinned} steps" if trace.thinned > 1 else ""
        axes.set_xlabel(f"step{unit}{thinned}")
    else:
        axes.tick_params(labelbottom=False)


def _panels_of(trace: Trace, leaves: Sequence[LeafValues], *, steps: bool) -> list[partial[None]]:
    numbers = [leaf for leaf in leaves if leaf.kind == "numbers"]
    choices = [leaf for leaf in leaves if leaf.kind == "choices"]
    panels: list[partial[None]] = []
    if sum(len(leaf.elements) for leaf in numbers) > MOST_LINES:
        panels.append(partial(_draw_table, trace=trace, leaves=numbers, scaled=True))
    else:
        panels += [
            partial(_draw_lines, trace=trace, leaf=leaf, chosen=chosen, steps=steps)
            for leaf in numbers
            for chosen in by_scale(trace.values[leaf.leaf.name])
        ]
    for leaf in choices:
        if len(leaf.elements) > _CHOICES:
            panels.append(partial(_draw_table, trace=trace, leaves=[leaf], scaled=False))
        else:
            panels += [partial(_draw_choice, trace=trace, leaf=leaf, i=i) for i in range(len(leaf.elements))]
    return panels


def by_scale(values: Array) -> list[list[int]]:
    """Columns of a table (points, n) in groups that one axis can show: of about the same size, a few each."""
    with np.errstate(invalid="ignore"):
        sizes = np.abs(np.where(np.isfinite(values), values, 0)).max(axis=0, initial=0)
    groups: list[list[int]] = []
    largest = 0.0
    for i in np.argsort(-sizes, kind="stable").tolist():
        if groups and len(groups[-1]) < _LINES and (sizes[i] * _SAME_SCALE >= largest or sizes[i] == 0):
            groups[-1].append(i)
        else:
            groups.append([i])
            largest = float(sizes[i])
    return sorted(sorted(group) for group in groups)


def _draw_lines(axes: Any, trace: Trace, leaf: LeafValues, chosen: Sequence[int], steps: bool) -> None:
    axes.set_title(cut(short_path(leaf.leaf), 60))
    values = trace.values[leaf.leaf.name]
    for colour, i in zip(SERIES, chosen, strict=False):
        axes.plot(
            trace.at, np.where(np.isfinite(values[:, i]), values[:, i], np.nan), color=colour,
            label=cut(leaf.names[i], 22), drawstyle="steps-mid" if steps and trace.thinned == 1 else "default",
            marker="." if trace.length <= 2 else None,
        )  # fmt: skip
    axes.locator_params(axis="y", nbins=4)
    if len(leaf.elements) > 1 or leaf.names[0] != short_path(leaf.leaf):
        axes.legend(
            loc="upper left",
            bbox_to_anchor=(1.005, 1.08),
            borderaxespad=0,
            handlelength=1.2,
            labelspacing=0.2,
        )


def _draw_choice(axes: Any, trace: Trace, leaf: LeafValues, i: int) -> None:
    axes.set_title(cut(leaf.names[i], 60))
    values = trace.values[leaf.leaf.name][:, i]
    drawstyle = "steps-mid" if trace.thinned == 1 else "default"
    axes.plot(trace.at, values, color=BLUE, drawstyle=drawstyle, marker="." if trace.length <= 2 else None)
    count = len(leaf.counts[i])
    if count <= _NAMED:
        numbers = leaf.starts[i] + np.arange(count)
        names = value_names(leaf, i)
        axes.set_ylim(numbers[0] - 0.4, numbers[-1] + 0.4)
        axes.set_yticks(numbers)
        if leaf.value_names:
            axes.yaxis.set_tick_params(
                labelright=True, labelleft=False, right=True, left=False, labelsize=7.5
            )
            axes.set_yticklabels([cut(name, 27) for name in names])
    else:
        axes.yaxis.get_major_locator().set_params(integer=True, nbins=4)


def _draw_return(axes: Any, trace: Trace) -> None:
    axes.set_title("running return")
    axes.plot(trace.at, trace.totals, color=INK, marker="." if trace.length <= 2 else None)
    axes.locator_params(axis="y", nbins=4)


def _draw_table(axes: Any, trace: Trace, leaves: Sequence[LeafValues], scaled: bool) -> None:
    """A row a dimension, its colour from its smallest to its largest value in the episode."""
    table = np.concatenate([trace.values[leaf.leaf.name] for leaf in leaves], axis=1).T
    if scaled:
        with np.errstate(invalid="ignore", over="ignore"):
            finite = np.where(np.isfinite(table), table, np.nan)
            low = np.fmin.reduce(finite, axis=1, initial=np.inf)[:, None]
            high = np.fmax.reduce(finite, axis=1, initial=-np.inf)[:, None]
            table = np.where(high > low, (finite - low) / np.where(high > low, high - low, 1), 0.5)
    image = axes.imshow(
        table, aspect="auto", cmap="viridis", interpolation="nearest", rasterized=True,
        extent=(-0.5, max(trace.length, 1) - 0.5, len(table) - 0.5, -0.5),
    )  # fmt: skip
    axes.grid(False)
    names = ", ".join(short_path(leaf.leaf) for leaf in leaves)
    told = ", each from its smallest (0) to its largest value (1)" if scaled else ""
    axes.set_title(f"{cut(names, 40)}: {len(table)} dimensions{told}")
    axes.set_ylabel("dimension")
    colour_bar(axes, image, "")


def _add_pictures(page: Page, pictures: Pictures) -> None:
    """Frames side by side, and the mean of some."""
    height, width = pictures.mean.shape[:2]
    cells = [
        Cell(partial(_draw_picture, frame=frame, title=f"step {step}"), right=0.06, left=0.06)
        for step, frame in zip(pictures.steps, pictures.frames, strict=True)
    ]
    cells.append(
        Cell(
            partial(_draw_picture, frame=pictures.mean, title=f"mean of {pictures.averaged}"),
            right=0.06,
            left=0.06,
        )
    )
    room = 9.5 / 7 - 0.12
    page.row(float(np.clip(room * height / width, 0.4, 1.6)), cells, columns=7, tight=True)


def _draw_picture(axes: Any, frame: Array, title: str) -> None:
    axes.set_title(title, fontsize=8)
    axes.imshow(frame, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    axes.set_axis_off()
