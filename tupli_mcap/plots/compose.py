"""From what was measured to a figure: which panels there are, and in which order."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from tupli_mcap.plots.card import card, title_of
from tupli_mcap.plots.draw_coverage import add_coverage
from tupli_mcap.plots.draw_episodes import add_episodes
from tupli_mcap.plots.draw_trace import add_trace
from tupli_mcap.plots.draw_values import add_values
from tupli_mcap.plots.gather import Measured
from tupli_mcap.plots.page import Cell, Page
from tupli_mcap.plots.style import GREY, INK, colours, cut, drawable, seed_text
from tupli_mcap.plots.trace import Trace
from tupli_mcap.plots.values import LeafValues

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["compose"]

_MOST_LISTED = 12  # recordings in the card
_LINE = 0.175  # inches
_NOTE_COLUMNS = 150
_ENDS = {"terminal": "ends by a terminal", "timeout": "ends by a timeout", "interrupted": "interrupted"}


def compose(
    measured: Sequence[Measured],
    traces: Sequence[tuple[Measured, Trace]],
    *,
    notes: Sequence[str] = (),
    head: bool = True,
) -> Figure:
    """The figure; without `head`, it leaves out title, card and notes. To be called inside `styled()`."""
    page = Page()
    if head:
        _add_card(page, measured)
    shown = [one for one in measured if len(one.rows)]
    if shown:
        add_episodes(page, shown)
    valued = [one for one in shown if one.layout is not None and one.read_steps]
    if valued:
        add_values(page, "States", _together([one.states for one in valued]))
        add_coverage(page, valued)
        acted, rewarded = ([one.actions for one in valued], [one.rewards for one in valued])
        add_values(page, "Actions and rewards", _together(acted), _together(rewarded))
    for one, trace in traces:
        add_trace(page, one, trace, _heading(one, trace, several=len(measured) > 1))
    if head:
        _add_notes(page, notes)
    return page.draw()


def _together(leaves: Sequence[Sequence[LeafValues]]) -> list[Sequence[LeafValues]]:
    """The same leaf of all recordings, for each leaf."""
    return list(zip(*leaves, strict=True))


def _heading(measured: Measured, trace: Trace, *, several: bool) -> str:
    seed = "" if trace.seed is None else f", seed {seed_text(trace.seed)}"
    where = f" of {measured.name}" if several else ""
    env = f", sub-environment {trace.env}" if measured.facts.num_envs > 1 else ""
    return (
        f"Episode {trace.episode}{where}: {trace.length:,} step{'' if trace.length == 1 else 's'}, "
        f"return {trace.total:.6g}, {_ENDS[trace.end]}{seed}{env}"
    )


def _add_card(page: Page, measured: Sequence[Measured]) -> None:
    facts = card(measured)
    more = len(facts) - _MOST_LISTED if len(measured) > 1 else 0
    if more > 0:
        facts = [*facts[:_MOST_LISTED], ("…", f"and {more} more")]
    shades = colours(len(measured)) if len(measured) > 1 else []
    lines = len(facts) if len(measured) > 1 else -(-len(facts) // 2)
    draw = partial(_draw_card, title=title_of(measured), facts=facts, shades=shades, lines=lines)
    page.row(0.25 + _LINE * lines, [Cell(draw, left=0, right=0)], tight=True)


def _draw_card(
    axes: Any, title: str, facts: Sequence[tuple[str, str]], shades: Sequence[str], lines: int
) -> None:
    axes.set_axis_off()
    height = 0.25 + _LINE * lines
    axes.set_xlim(0, 9.5)
    axes.set_ylim(height, 0)
    axes.text(0, 0.0, drawable(title, 80), fontsize=13, fontweight="bold", va="center")
    wide = lines == len(facts)
    for i, (label, value) in enumerate(facts):
        x, y = 4.9 * (i // lines), 0.32 + _LINE * (i % lines)
        room = 100 if wide else 56
        if shades and i < len(shades):
            axes.plot([x + 0.02, x + 0.2], [y, y], color=shades[i], linewidth=2.5)
            x += 0.28
        axes.text(x, y, cut(label, 34), color=INK if shades else GREY, va="center")
        axes.text(x + (2.4 if wide else 0.85), y, cut(value, room), va="center")


def _add_notes(page: Page, notes: Sequence[str]) -> None:
    lines = [line for note in notes for line in textwrap.wrap(drawable(note, 600), _NOTE_COLUMNS)]
    if lines:
        page.heading("Notes")
        page.row(_LINE * len(lines), [Cell(partial(_draw_notes, lines=lines), left=0, right=0)], tight=True)


def _draw_notes(axes: Any, lines: Sequence[str]) -> None:
    axes.set_axis_off()
    axes.set_ylim(len(lines), 0)
    for i, line in enumerate(lines):
        axes.text(0, i - 0.5, line, color="#444444", va="center", fontsize=8)
