"""The look of reports: colours that colour-blind readers can tell apart, fonts, texts, axes, and a page of panels."""

from __future__ import annotations

import contextlib
import textwrap
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

from tupli_mcap.errors import missing_extra

# Okabe and Ito's palette; https://jfly.uni-koeln.de/color/
BLUE, VERMILION, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, INK, GREY, PALE = "#E69F00", "#56B4E9", "#222222", "#8A8A8A", "#E6E6E6"
SERIES = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY)
ENDS = {"terminal": (VERMILION, "o"), "timeout": (BLUE, "s"), "interrupted": (GREY, "^")}  # of episodes
SMALL: dict[str, Any] = {"color": GREY, "fontsize": 7.5}  # of texts beside small panels
COLUMNS = 4  # of small cells
LEFT, RIGHT, TOP, BOTTOM = 0.62, 0.18, 0.26, 0.42  # inches around the axes of a cell
_WIDTH, _EDGE, _HEADING, _LINE = 10.0, 0.25, 0.36, 0.175  # inches
_TEXT_COLUMNS = 150
_LEGEND = 74  # characters that fit beside the title of a wide panel
_LEAST_NAME = 10  # characters to which a name in a legend is cut
_RC: dict[str, Any] = {
    "figure.dpi": 110, "font.size": 8.5, "lines.linewidth": 1.3, "patch.linewidth": 0,
    "axes.titlesize": 9, "axes.titlelocation": "left", "axes.titlepad": 4, "axes.labelsize": 8.5,
    "axes.titley": 1.0,  # else matplotlib searches for it in every drawing
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#555555", "axes.linewidth": 0.7,
    "axes.grid": True, "axes.axisbelow": True, "grid.color": PALE, "grid.linewidth": 0.6,
    "axes.formatter.useoffset": False, "xtick.labelsize": 8, "ytick.labelsize": 8,
    "xtick.color": "#555555", "ytick.color": "#555555", "legend.fontsize": 8, "legend.frameon": False,
    "text.color": INK, "text.parse_math": False,  # names come from files: a "$" is a "$"
    "pdf.fonttype": 42,  # as texts that programs can change
    "svg.hashsalt": "tupli-mcap",  # the same recording gives the same bytes
}  # fmt: skip


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Uses matplotlib's defaults with `_RC` instead of the user's settings, which it restores at the end; raises
    MissingExtraError if matplotlib is not installed."""
    try:
        import matplotlib.style as mpl_style
    except ImportError as err:
        raise missing_extra("reports need matplotlib", "plot") from err
    with mpl_style.context(["default", _RC]):
        yield


def cut(text: str, longest: int) -> str:
    """One line without characters that cannot be shown; too long a text keeps its end, where names differ."""
    if len(text) > longest:
        head = longest // 3
        text = f"{text[:head]}…{text[len(text) - (longest - head - 1) :]}"
    known = _glyphs()
    return "".join(c if c.isprintable() and ord(c) in known else "\N{REPLACEMENT CHARACTER}" for c in text)


@cache
def _glyphs() -> frozenset[int]:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font: Any = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return frozenset(font.get_charmap())


def number_text(value: float) -> str:
    """A number for people, in few characters: `1,234`, `0.0123`, `-4.5e+20`."""
    if abs(value) < 1e6 and value.is_integer():
        return f"{int(value):,}"
    return f"{value:.4g}" if abs(value) < 1e4 or abs(value) >= 1e7 else f"{value:,.0f}"


def seed_text(seed: int) -> str:
    """A seed in few characters: one that an environment drew may have 39 digits, and is rounded."""
    return str(seed) if abs(seed) < 1 << 64 else number_text(float(seed))


def colours(count: int) -> list[str]:
    """A colour for each of several recordings; of many, shades in their order."""
    if count <= len(SERIES):
        return list(SERIES[:count])
    from matplotlib import colormaps, colors

    return [colors.to_hex(colormaps["viridis"](0.9 * i / (count - 1))) for i in range(count)]


def legend_above(axes: Any) -> None:
    """The legend in one line above the axes, right of the title; of many entries, the first and the last.

    Names that would not fit beside the title are cut: the head has them whole. If two of them are then the same, or
    there is room for few characters only, there is no legend.
    """
    handles, names = axes.get_legend_handles_labels()
    if len(handles) > len(SERIES):
        handles, names = [handles[0], handles[-1]], [names[0], f"… {names[-1]} ({len(names)})"]
    longest = _LEGEND // max(1, len(names)) - 5  # the mark of a name takes as much room as 5 characters
    if sum(map(len, names)) > longest * len(names):
        names = [cut(name, longest) for name in names] if longest >= _LEAST_NAME else []
    if names and len(set(names)) == len(names):
        axes.legend(
            handles, names, loc="lower right", bbox_to_anchor=(1.01, 0.985), ncols=len(handles), borderaxespad=0.0,
            handlelength=1.3, handletextpad=0.4, columnspacing=1.1, borderpad=0.2,
        )  # fmt: skip


def draw_histograms(axes: Any, heights: Sequence[Any], edges: Any) -> None:
    """A histogram of each recording: filled if it is the only one, else an outline in its colour."""
    alone = len(heights) == 1
    for values, colour in zip(heights, colours(len(heights)), strict=True):
        axes.stairs(values, edges, fill=alone, color=colour, linewidth=0 if alone else 1.2)


def heat_map(axes: Any, table: Any, label: str, **options: Any) -> None:
    """A table as colours, a column for each column of it, with its colour bar."""
    image = axes.imshow(table, **{"aspect": "auto", "cmap": "viridis", "interpolation": "nearest"} | options)
    axes.grid(False)
    colour_bar(axes, image, label)


def colour_bar(axes: Any, image: Any, label: str) -> None:
    """A bar of fixed size right of the axes."""
    from matplotlib.ticker import FuncFormatter

    text = FuncFormatter(lambda value, _: number_text(float(value)))
    bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.015, 0, 0.015, 1)), format=text)
    bar.set_label(label, fontsize=7.5)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=7.5)
    bar.ax.minorticks_off()


class Cell(NamedTuple):
    """One panel: `draw` fills its axes of this height (inches).

    weight: how many columns it takes. left, right: room beside the axes, such as for a legend (inches).
    """

    draw: Callable[[Any], None]
    height: float
    weight: float = 1.0
    right: float = RIGHT
    left: float = LEFT


class Page:
    """Collects headings and rows, then draws them all on one figure."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, Sequence[Cell], float]] = []  # the height of all, cells, columns

    def heading(self, text: str) -> None:
        def draw(axes: Any) -> None:
            axes.set_axis_off()
            axes.set(xlim=(0, 1), ylim=(0, _HEADING - TOP))
            axes.text(0, _HEADING - 0.2, cut(text, 100), fontsize=10.5, fontweight="bold")
            axes.axhline(_HEADING - TOP, color="#BBBBBB", linewidth=0.8, clip_on=False)

        self._rows.append((_HEADING, [Cell(draw, _HEADING - TOP, left=0, right=0)], 1))

    def add(self, cells: Sequence[Cell], columns: float = COLUMNS, *, tight: bool = False) -> None:
        """Cells in rows of so many columns; a cell's weight is how many of them it takes.

        tight: without room for an axis label below.
        """
        rows: list[list[Cell]] = []
        room = 0.0
        for cell in cells:
            if cell.weight > room:
                rows.append([])
                room = columns
            rows[-1].append(cell)
            room -= cell.weight
        for row in rows:
            height = max(cell.height for cell in row) + TOP + (0.16 if tight else BOTTOM)
            self._rows.append((height, row, columns))

    def text(self, paragraphs: Sequence[str]) -> None:
        """Texts in as many lines as they take; of each, 600 characters at most."""
        lines = [line for text in paragraphs for line in textwrap.wrap(cut(text, 600), _TEXT_COLUMNS)]

        def draw(axes: Any) -> None:
            axes.set_axis_off()
            axes.set_ylim(len(lines), 0)
            for i, line in enumerate(lines):
                axes.text(0, i - 0.5, line, color="#444444", va="center", fontsize=8)

        self.add([Cell(draw, _LINE * len(lines), left=0, right=0)], 1, tight=True)

    def draw(self) -> Any:
        """Matplotlib's figure."""
        from matplotlib.figure import Figure

        total = sum(height for height, *_ in self._rows) + 2 * _EDGE
        figure = Figure(figsize=(_WIDTH, total))
        top = total - _EDGE
        for height, row, columns in self._rows:
            left, inner = _EDGE, max(cell.height for cell in row)
            for cell in row:
                width = (_WIDTH - 2 * _EDGE) * cell.weight / columns
                x, wide = left + cell.left, width - cell.left - cell.right
                box = x / _WIDTH, (top - TOP - inner) / total, wide / _WIDTH, inner / total
                cell.draw(figure.add_axes(box))
                left += width
            top -= height
        return figure
