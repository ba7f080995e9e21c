"""How reports look: colours that colour-blind readers tell apart, fonts, and texts that can be drawn."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import cache
from typing import Any

from tupli_mcap.errors import missing_extra

__all__ = [
    "BLUE", "ENDS", "GREY", "INK", "SERIES", "VERMILION", "colours", "cut", "drawable", "legend_above", "number_text",
    "seed_text", "show_alone", "styled",
]  # fmt: skip

# Okabe and Ito's palette; https://jfly.uni-koeln.de/color/
BLUE, VERMILION, GREEN, PINK = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, INK, GREY, PALE = "#E69F00", "#56B4E9", "#222222", "#8A8A8A", "#E6E6E6"
SERIES = (BLUE, VERMILION, GREEN, PINK, ORANGE, SKY)
ENDS = {"terminal": (VERMILION, "o"), "timeout": (BLUE, "s"), "interrupted": (GREY, "^")}
"""Colour and marker of an episode by how it ended."""

_LONGEST = 60  # characters of a text in a picture
_RC: dict[str, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 110,
    "figure.facecolor": "white",
    "font.family": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlepad": 4,
    "axes.titley": 1.0,  # else it is looked for anew in every drawing
    "axes.labelsize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "axes.unicode_minus": True,
    "grid.color": PALE,
    "grid.linewidth": 0.6,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "text.color": INK,
    "text.parse_math": False,  # names come from files: a "$" is a "$"
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "patch.linewidth": 0,
    "svg.fonttype": "path",
    "svg.hashsalt": "tupli-mcap",  # the same recording gives the same bytes
    "path.simplify": True,
}
_KEPT = ("backend", "interactive", "toolbar", "webagg", "tk", "docstring", "date.epoch", "figure.hooks")


@contextlib.contextmanager
def styled() -> Iterator[None]:
    """Matplotlib's own defaults with `_RC` over them, whatever the user has set; theirs come back at the end.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl
    except ImportError as err:
        raise missing_extra("reports need matplotlib", "plot") from err
    settings: Any = {name: value for name, value in mpl.rcParamsDefault.items() if not name.startswith(_KEPT)}
    with mpl.rc_context(settings | _RC):
        yield


def drawable(text: str, longest: int = _LONGEST) -> str:
    """A text in one line of at most so many characters, without those that cannot be shown."""
    if len(text) > longest:
        text = text[: longest - 1] + "…"
    known = _glyphs()
    return "".join(
        char if char.isprintable() and ord(char) in known else "\N{REPLACEMENT CHARACTER}" for char in text
    )


@cache
def _glyphs() -> frozenset[int]:
    from matplotlib.font_manager import FontProperties, findfont, get_font

    font: Any = get_font(findfont(FontProperties(family="DejaVu Sans")))
    return frozenset(font.get_charmap())


def number_text(value: float) -> str:
    """A number for people, in few characters: `1,234`, `0.0123`, `-4.5e+20`."""
    if value == int(value) and abs(value) < 1e6 if abs(value) < 1e300 else False:
        return f"{int(value):,}"
    return f"{value:.4g}" if abs(value) < 1e4 or abs(value) >= 1e7 else f"{value:,.0f}"


def seed_text(seed: int) -> str:
    """A seed in few characters: one that an environment drew may have 39 digits, and is rounded."""
    return str(seed) if abs(seed) < 1 << 64 else number_text(float(seed))


def colours(count: int) -> list[str]:
    """A colour for each of several recordings; of many, shades in their order."""
    if count <= len(SERIES):
        return list(SERIES[:count])
    import matplotlib as mpl
    from matplotlib.colors import to_hex

    shades = mpl.colormaps["viridis"]
    return [to_hex(shades(0.9 * i / (count - 1))) for i in range(count)]


def legend_above(axes: Any, most: int = 6) -> None:
    """The legend in one line above the axes, right of the title; of many entries, the first and the last."""
    handles, names = axes.get_legend_handles_labels()
    if not handles:
        return
    if len(handles) > most:
        handles, names = [handles[0], handles[-1]], [names[0], f"… {names[-1]} ({len(names)})"]
    axes.legend(
        handles, names, loc="lower right", bbox_to_anchor=(1.01, 0.985), ncols=len(handles), borderaxespad=0.0,
        handlelength=1.3, handletextpad=0.4, columnspacing=1.1, borderpad=0.2,
    )  # fmt: skip


def show_alone(axes: Any, edges: Any) -> None:
    """A histogram of one bin is a bar in the middle, not a wall."""
    if len(edges) == 2:
        width = edges[1] - edges[0]
        axes.set_xlim(edges[0] - 4 * width, edges[1] + 4 * width)


def cut(text: str, longest: int) -> str:
    """A text that keeps its end, where it is too long: that is where names differ."""
    text = drawable(text, 400)
    if len(text) <= longest:
        return text
    head = longest // 3
    return f"{text[:head]}…{text[len(text) - (longest - head - 1) :]}"
