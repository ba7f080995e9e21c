"""Panels of one episode, below each other, over the same steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.plots import style
from tupli_mcap.plots.measure import Measured, Trace
from tupli_mcap.plots.statistics import LeafValues
from tupli_mcap.plots.style import Cell, Page, cut, number_text
from tupli_mcap.recording.describe.description import by_scale

_MOST_LINES, _LINES = 12, 6  # of all panels, of one panel
_SAME_SCALE = 8  # lines of one panel differ by this factor at most
_MOST_INFOS = 4
_CHOICES = 2  # panels of one leaf
_NAMED = 8  # values of a choice that are named at the axis
_HEIGHT, _TABLE_HEIGHT, _LEGEND = 0.75, 1.25, 1.85
_FRAME_WIDTH = 9.5 / 7 - 0.12
_ENDS = {"terminal": "ends by a terminal", "timeout": "ends by a timeout", "interrupted": "interrupted"}


def add_trace(page: Page, measured: Measured, trace: Trace, *, several: bool) -> None:
    """One episode: pictures, states, actions, rewards and the running return."""
    seed = "" if trace.seed is None else f", seed {style.seed_text(trace.seed)}"
    where = f" of {measured.name}" if several else ""
    env = f", sub-environment {trace.env}" if measured.facts.num_envs > 1 else ""
    page.heading(
        f"Episode {trace.episode}{where}: {trace.length:,} step{'' if trace.length == 1 else 's'}, "
        f"return {trace.total:.6g}, {_ENDS[trace.end]}{seed}{env}"
    )
    for name, pictures in trace.pictures.items():
        height, width = pictures[-1][1].shape[:2]
        height = float(np.clip(_FRAME_WIDTH * height / width, 0.4, 1.6))
        (first, frame), *others = pictures
        cells = [
            Cell(partial(_draw_picture, *picture), height, right=0.06, left=0.06)
            for picture in [(f"{cut(name, 60)}\n{first}", frame), *others]
        ]
        page.add(cells, 7, tight=True)
    if trace.length == 1:  # a panel of one point shows nothing more
        page.text(_step_lines(measured, trace))
        return
    add = partial(_add_panel, page, trace)
    _add_values(add, trace, measured.states, False)
    _add_values(add, trace, measured.actions, True)
    for leaf in measured.rewards:
        if len(leaf.elements) <= _LINES:
            add(partial(_draw_lines, trace, leaf, range(len(leaf.elements)), True))
    for key, values in list(trace.infos.items())[:_MOST_INFOS]:
        add(partial(_plot, trace, key, values, True, color=style.BLUE))
    seconds = measured.step_seconds
    unit = "" if seconds is None else f" (each {number_text(seconds)} s)"
    thinned = f"; smallest and largest of every {trace.thinned} steps" if trace.thinned > 1 else ""
    draw = partial(_plot, trace, "running return", trace.totals, False, color=style.INK)
    add(draw, label=f"step{unit}{thinned}")


def _step_lines(measured: Measured, trace: Trace) -> list[str]:
    """The values of an episode of one step, a text for each leaf."""
    lines = []
    for leaf in measured.leaves:
        said = []
        for i, name in enumerate(leaf.names[:_MOST_LINES]):
            value = float(trace.values[leaf.leaf.name][0, i])
            place = int(value - leaf.starts[i]) if leaf.counts and leaf.value_names else -1
            named = leaf.value_names[place:][:1] if place >= 0 else ()  # a value may be outside of the space
            said.append(f"{name} {number_text(value)}{''.join(f' ({text})' for text in named)}")
        more = len(leaf.names) - _MOST_LINES
        lines.append(", ".join(said) + (f" and {more:,} more" if more > 0 else ""))
    lines += [f"{key} {number_text(float(values[0]))}" for key, values in trace.infos.items()][:_MOST_INFOS]
    return list(filter(None, lines))


def _add_panel(
    page: Page, trace: Trace, draw: Callable[..., None], height: float = _HEIGHT, label: str = ""
) -> None:
    """A panel whose axis counts steps; without a label, only a panel below shows the numbers."""

    def draw_over_steps(axes: Any) -> None:
        draw(axes)
        axes.locator_params(axis="x", integer=True)
        axes.set(xlabel=label, xlim=(-0.5, max(trace.length, 1) - 0.5))
        axes.tick_params(labelbottom=bool(label))

    page.add([Cell(draw_over_steps, height, right=_LEGEND)], 1, tight=not label)


def _add_values(add: Callable[..., None], trace: Trace, leaves: Sequence[LeafValues], steps: bool) -> None:
    """Lines of numbers, then of choices; a table if there are too many. steps: values are constant during a step."""
    numbers = [leaf for leaf in leaves if leaf.kind == "numbers"]
    if sum(len(leaf.elements) for leaf in numbers) > _MOST_LINES:
        add(partial(_draw_table, trace, numbers, True), _TABLE_HEIGHT)
    else:
        for leaf in numbers:
            sizes = np.abs(np.nan_to_num(trace.values[leaf.leaf.name])).max(axis=0, initial=0).tolist()
            for chosen in by_scale(sizes, _SAME_SCALE, _LINES):
                add(partial(_draw_lines, trace, leaf, chosen, steps))
    for leaf in leaves:
        if len(leaf.counts) > _CHOICES:
            add(partial(_draw_table, trace, [leaf], False))
        else:
            for i in range(len(leaf.counts)):
                add(partial(_draw_choice, trace, leaf, i))


def _plot(trace: Trace, title: str, values: Array, steps: bool, axes: Any, **options: Any) -> None:
    axes.set_title(cut(title, 60))
    shape = "steps-mid" if steps and trace.thinned == 1 else "default"
    axes.plot(trace.at, values, drawstyle=shape, marker="." if trace.length <= 2 else None, **options)
    axes.locator_params(axis="y", nbins=4)


def _draw_lines(trace: Trace, leaf: LeafValues, chosen: Sequence[int], steps: bool, axes: Any) -> None:
    name = leaf.leaf.path
    for colour, i in zip(style.SERIES, chosen, strict=False):
        column = trace.values[leaf.leaf.name][:, i]
        _plot(trace, name, column, steps, axes, color=colour, label=cut(leaf.names[i], 22))
    if leaf.names != (name,):
        place = {"loc": "upper left", "bbox_to_anchor": (1.005, 1.08), "borderaxespad": 0}
        axes.legend(**place, handlelength=1.2, labelspacing=0.2)


def _draw_choice(trace: Trace, leaf: LeafValues, i: int, axes: Any) -> None:
    _plot(trace, leaf.names[i], trace.values[leaf.leaf.name][:, i], True, axes, color=style.BLUE)
    start, count = leaf.starts[i], len(leaf.counts[i])
    axes.locator_params(axis="y", integer=True)
    if count <= _NAMED:
        axes.set(ylim=(start - 0.4, start + count - 0.6), yticks=start + np.arange(count))
    if count <= _NAMED and leaf.value_names:
        axes.yaxis.set_tick_params(labelright=True, labelleft=False, right=True, left=False, labelsize=7.5)
        axes.set_yticklabels([cut(name, 26) for name in leaf.value_names])


def _draw_table(trace: Trace, leaves: Sequence[LeafValues], scaled: bool, axes: Any) -> None:
    """A row for each dimension. scaled: the colours of a row span its smallest to its largest value in the episode."""
    table = np.concatenate([trace.values[leaf.leaf.name] for leaf in leaves], axis=1).T
    if scaled:
        low, high = (end.reduce(table, axis=1, initial=np.nan)[:, None] for end in (np.fmin, np.fmax))
        table = np.where(high > low, (table - low) / np.where(high > low, high - low, 1), 0.5)
    right = max(trace.length, 1) - 0.5
    style.heat_map(axes, table, "", rasterized=True, extent=(-0.5, right, len(table) - 0.5, -0.5))
    names = ", ".join(leaf.leaf.path for leaf in leaves)
    scale = ", each from its smallest (0) to its largest value (1)" if scaled else ""
    axes.set(title=f"{cut(names, 40)}: {len(table)} dimensions{scale}", ylabel="dimension")


def _draw_picture(title: str, frame: Array, axes: Any) -> None:
    axes.set_title(title, fontsize=8)
    axes.imshow(frame, cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    axes.set_axis_off()
