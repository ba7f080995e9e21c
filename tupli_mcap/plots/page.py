"""A page of panels: rows of fixed height, each with its cells, under headings; laid out in inches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from tupli_mcap.plots.style import INK, drawable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["WIDTH", "Cell", "Page", "Row"]

WIDTH = 10.0  # inches
_EDGE = 0.25
_HEADING = 0.36
LEFT, RIGHT, TOP, BOTTOM = 0.62, 0.18, 0.26, 0.42  # around the axes of a cell


class Cell(NamedTuple):
    """One panel: `draw` fills its axes. weight: its part of the row's width. right: room for a legend (inches)."""

    draw: Callable[[Any], None]
    weight: float = 1.0
    right: float = RIGHT
    left: float = LEFT


class Row(NamedTuple):
    """Cells side by side; `height` is that of the axes (inches). tight: no room for an axis label below."""

    height: float
    cells: Sequence[Cell]
    columns: int = 0
    tight: bool = False

    @property
    def total(self) -> float:
        return self.height + TOP + (0.16 if self.tight else BOTTOM)


class Page:
    """Collects headings, lines of text and rows, then draws them all on one figure."""

    def __init__(self) -> None:
        self._items: list[str | Row] = []

    def heading(self, text: str) -> None:
        self._items.append(text)

    def row(self, height: float, cells: Sequence[Cell], *, columns: int = 0, tight: bool = False) -> None:
        """`columns`: the weights that fit into a row; what these cells leave stays empty."""
        self._items.append(Row(height, cells, columns, tight))

    def pack(self, cells: Sequence[tuple[float, Cell]], columns: int = 4) -> None:
        """Cells, each with its height, in rows of so many columns; a cell's weight is how many it takes."""
        row: list[tuple[float, Cell]] = []
        for item in [*cells, None]:
            if row and (item is None or sum(cell.weight for _, cell in row) + item[1].weight > columns):
                self.row(max(height for height, _ in row), [cell for _, cell in row], columns=columns)
                row = []
            if item is not None:
                row.append(item)

    def draw(self) -> Figure:
        from matplotlib.figure import Figure

        height = sum(_HEADING if isinstance(item, str) else item.total for item in self._items) + 2 * _EDGE
        figure = Figure(figsize=(WIDTH, height))
        top = height - _EDGE
        for item in self._items:
            if isinstance(item, str):
                _draw_heading(figure, item, top / height, height)
                top -= _HEADING
            else:
                _draw_row(figure, item, top, height)
                top -= item.total
        return figure


def _draw_heading(figure: Figure, text: str, top: float, height: float) -> None:
    from matplotlib.lines import Line2D

    y = top - 0.2 / height
    figure.text(_EDGE / WIDTH, y, drawable(text, 120), fontsize=10.5, fontweight="bold", color=INK)
    line = y - 0.06 / height
    figure.add_artist(
        Line2D([_EDGE / WIDTH, 1 - _EDGE / WIDTH], [line, line], color="#BBBBBB", linewidth=0.8)
    )


def _draw_row(figure: Figure, row: Row, top: float, height: float) -> None:
    total = sum(cell.weight for cell in row.cells)
    total = max(total, row.columns)
    x = _EDGE
    for cell in row.cells:
        width = (WIDTH - 2 * _EDGE) * cell.weight / total
        axes: Axes = figure.add_axes(
            (
                (x + cell.left) / WIDTH,
                (top - TOP - row.height) / height,
                (width - cell.left - cell.right) / WIDTH,
                row.height / height,
            )
        )
        cell.draw(axes)
        x += width
