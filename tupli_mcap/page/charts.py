"""Draws numbers as SVG: tracks of an episode, histograms, values over time.

Drawings are stretched to the width of their place on the page; their texts are not. Colours are classes of the style
sheet, so that dark pages have their own. Only numbers and escaped texts go into a drawing.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from tupli_mcap.arrays import Array
from tupli_mcap.page.texts import number

_WIDE, _HIGH = 1000, 100  # size of a drawing before it is stretched
_TICKS = 4
_PATH = Markup('<path class="{}" d="{}"/>')
_BAR = Markup(
    '<rect class="bar" x="{:.1f}" y="{:.1f}" width="{:.1f}" height="{:.1f}"><title>{}: {}</title></rect>'
)
_FIGURE = Markup('<figure class="chart">{}{}<p class="ends"><span>{}</span><span>{}</span></p></figure>')
_PLOT = Markup(
    '<svg class="plot" role="img" aria-label="{}">{}<svg width="100%" height="100%" viewBox="0 0 {} {}" '
    'preserveAspectRatio="none">{}</svg></svg>'
)
_LEGEND = Markup('<ul class="legend">{}</ul>')
_KEY = Markup('<li class="s{}"><bdi>{}</bdi></li>')
_COVER = Markup(
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="-40 -6 1080 112" width="640" height="360" '
    'preserveAspectRatio="none"><style>path{{fill:none;stroke-width:2;vector-effect:non-scaling-stroke;'
    "stroke-linejoin:round}}.l0{{stroke:#1c6a86}}.l1{{stroke:#c2562f}}.l2{{stroke:#3b8560}}.l3{{stroke:#8561a8}}"
    ".l4{{stroke:#a87a14}}@media(prefers-color-scheme:dark){{.l0{{stroke:#6fb8d2}}.l1{{stroke:#f08a66}}"
    ".l2{{stroke:#7ac79d}}.l3{{stroke:#bb9add}}.l4{{stroke:#d9b04c}}}}</style>{}</svg>"
)

Line = tuple[Array, Array]
"""The positions and the values of the points of a line: two float64 arrays of the same length. NaN makes a gap."""


def line_path(at: Array, values: Array, across: tuple[float, float], up: tuple[float, float]) -> str:
    """The `d` of a line; `across` and `up` are the values at the edges of the drawing."""
    xs = _scaled(at, across) * _WIDE
    ys = (1 - _scaled(values, up)) * _HIGH
    parts, pen = list[str](), "M"
    for x, y in [*zip(xs.round(1).tolist(), ys.round(1).tolist(), strict=True), (0.0, math.nan)]:
        if math.isfinite(y):
            parts.append(f"{pen}{x:g} {y:g}")
            pen = "L"
        else:
            if pen == "L" and parts[-1].startswith("M"):
                parts.append("h1")  # a point between two gaps would be invisible
            pen = "M"
    return "".join(parts)


def lines(given: Sequence[Line], steps: int, ends: tuple[float, float]) -> Markup:
    """The same value of some episodes over so many steps, each in its colour, without axes. ends: the smallest and the
    largest value of all."""
    room = 0.04 * (ends[1] - ends[0])
    across, up = (0.0, max(1.0, steps - 1.0)), (ends[0] - room, ends[1] + room)
    paths = (_PATH.format(f"line s{i % 8}", line_path(*line, across, up)) for i, line in enumerate(given))
    return _drawing(Markup("").join(paths), "track")


def share(part: float) -> Markup:
    """A bar that is filled in part, from 0 to 1."""
    return Markup(
        '<svg class="bar-of" aria-hidden="true"><rect width="{:.1f}%" height="100%"/></svg>'
    ).format(100 * part)


def histogram(
    counts: Array, edges: Array, ends: tuple[str, str], names: Sequence[str] = (), label: str = ""
) -> Markup:
    """Bars, with the texts `ends` below the first and the last. names: names of the bars, if they have any."""
    most = max(1.0, float(np.max(counts, initial=0)))
    width = _WIDE / max(1, len(counts))
    bars = []
    for i, count in enumerate(counts.tolist()):
        high = _HIGH * count / most
        what = names[i] if i < len(names) else f"{number(edges[i])} … {number(edges[i + 1])}"
        wide = max(1.0, width - min(6.0, width * 0.2))
        bars.append(_BAR.format(i * width, _HIGH - high, wide, high, what, number(count)))
    return _FIGURE.format("", _drawing(Markup("").join(bars), "bars", label), *ends)


def cover(given: Sequence[Line]) -> str:
    """A picture of lines, each in its own band and colour. Positions and values are from 0 to 1."""
    bands = len(given) or 1
    paths = []
    for i, (at, values) in enumerate(given):
        low = -0.25 - 1.5 * (bands - 1 - i)
        across = line_path(at, values, (0.0, 1.0), (low, low + 1.5 * bands))
        paths.append(Markup('<path class="l{}" d="{}"/>').format(i % 5, across))
    return str(_COVER.format(Markup("").join(paths)))


def over_time(
    given: Sequence[Line],
    ends: tuple[str, str],
    label: str,
    *,
    names: Sequence[str] = (),
    points: Line | None = None,
    band: tuple[Array, Array] | None = None,
) -> Markup:
    """Lines over the same time, with a scale.

    Args:
        ends: texts for the begin and the end of the time.
        names: names of the lines, if there are several.
        points: single values, drawn behind the first line.
        band: the lower and the upper edge of the range of most values, at the points of the first line.
    """
    drawn = [*(line[1] for line in given), *([points[1]] if points else []), *(band or ())]
    finite = np.concatenate([values[np.isfinite(values)] for values in drawn])
    if not len(finite):
        return Markup("")
    ticks = _ticks(float(finite.min()), float(finite.max()))
    up = (min(ticks[0], float(finite.min())), max(ticks[-1], float(finite.max())))
    at = np.concatenate([line[0] for line in [*given, *([points] if points else [])]])
    across = float(at.min()), float(at.max())
    parts = [_PATH.format("band", _band(given[0][0], *band, across, up))] if band else []
    parts += [_PATH.format("dots", _dots(*points, across, up))] if points else []
    parts += [_PATH.format(f"line s{i % 8}", line_path(*line, across, up)) for i, line in enumerate(given)]
    grid = Markup("").join(_gridline(tick, up) for tick in ticks)
    key = Markup("").join(_KEY.format(i % 8, name) for i, name in enumerate(names))
    return _FIGURE.format(
        _LEGEND.format(key) if names else "",
        _PLOT.format(label, grid, _WIDE, _HIGH, Markup("").join(parts)),
        *ends,
    )


def _drawing(inside: Markup, kind: str, label: str = "") -> Markup:
    """label: describes the drawing to screen readers; without one, they skip it, and the text beside it says enough."""
    told = Markup('role="img" aria-label="{}"').format(label) if label else Markup('aria-hidden="true"')
    return Markup('<svg class="{}" {} viewBox="0 0 {} {}" preserveAspectRatio="none">{}</svg>').format(
        kind, told, _WIDE, _HIGH, inside
    )


def _gridline(tick: float, up: tuple[float, float]) -> Markup:
    y = 100 * (1 - float(_scaled(np.array(tick), up)))
    return Markup(
        '<line class="grid" x1="0" x2="100%" y1="{0:.1f}%" y2="{0:.1f}%"/>'
        '<text class="tick" x="0" y="{0:.1f}%" dy="-3">{1}</text>'
    ).format(y, number(tick))


def _band(at: Array, low: Array, high: Array, across: tuple[float, float], up: tuple[float, float]) -> str:
    known = np.isfinite(low) & np.isfinite(high)
    if not known.any():
        return ""
    forth = line_path(at[known], high[known], across, up)
    back = line_path(at[known][::-1], low[known][::-1], across, up)
    return f"{forth}L{back[1:]}Z"


def _dots(at: Array, values: Array, across: tuple[float, float], up: tuple[float, float]) -> str:
    known = np.isfinite(values)
    xs = (_scaled(at[known], across) * _WIDE).round(1).tolist()
    ys = ((1 - _scaled(values[known], up)) * _HIGH).round(1).tolist()
    return "".join(f"M{x:g} {y:g}h0" for x, y in zip(xs, ys, strict=True))


def _ticks(low: float, high: float) -> list[float]:
    """About four round numbers from `low` to `high`."""
    rough = (high - low) / _TICKS
    if not rough >= sys.float_info.min:  # of smaller ones, no power of ten may be left
        return [low]
    unit = 10.0 ** math.floor(math.log10(rough))
    step = unit * next((factor for factor in (1, 2, 5) if factor * unit >= rough), 10)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)] or [low]


def _scaled(values: Array, ends: tuple[float, float]) -> Array:
    low, high = ends
    if not high > low:
        return np.where(np.isfinite(values), 0.5, np.nan)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled: Array = (np.asarray(values, np.float64) - low) / (high - low)
    return scaled
