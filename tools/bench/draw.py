"""The results in pictures: SVG without a background, in colours that a light and a dark page both bear."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from tools.bench.contenders import ENTRIES
from tools.bench.matrix import OPERATIONS
from tools.bench.report import MINE, figure
from tools.bench.workloads import WORKLOADS

GREY, FAINT, ACCENT = "#848d97", "#848d9740", "#e8590c"
COLOURS = ("#e8590c", "#2f81f7", "#1f9d61", "#a371f7", "#d29922", "#db61a2", "#39a0b5", "#848d97")
MARKERS = "os^Dv*PX"
STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "text.color": GREY,
    "axes.labelcolor": GREY,
    "axes.edgecolor": FAINT,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "tupli-mcap",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
SHOWN = ("record", "size", "read", "window", "epoch0")
GROWTH = {
    "record": "record",
    "list": "open and list all episodes",
    "read": "read everything",
    "window": "open, then one window",
}


def write(results: dict[str, Any], directory: Path) -> None:
    """A picture a workload, and one of the growth."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    with mpl.rc_context(STYLE):
        for work, found in results["matrix"].items():
            _save(plt, _bars(plt, work, found), directory / f"{work}.svg")
        if results["growth"]:
            _save(plt, _growth(plt, results["growth"]), directory / "growth.svg")


def _save(plt: Any, made: Any, path: Path) -> None:
    made.savefig(path, metadata={"Date": None}, bbox_inches="tight", pad_inches=0.1)
    plt.close(made)


def _bars(plt: Any, work: str, found: dict[str, Any]) -> Any:
    """A column an operation, a row a contender; shorter bars are better in all but those marked."""
    rows = [name for name in ENTRIES if any(_values(found, operation, name) for operation in SHOWN)]
    made, axes = plt.subplots(1, len(SHOWN), figsize=(10.5, 0.27 * len(rows) + 1.0), sharey=True)
    for axis, operation in zip(axes, SHOWN, strict=True):
        about = OPERATIONS[operation]
        medians = {name: statistics.median(v) for name in rows if (v := _values(found, operation, name))}
        shown = {name: value for name, value in medians.items() if value > 0}
        least = min(shown.values(), default=1.0) / 3
        axis.set_xscale("log")
        for y, name in enumerate(rows):
            if name not in medians:
                axis.text(least, y, " -", va="center", fontsize=8)
                continue
            value = max(medians[name], least * 1.2)
            axis.barh(
                y,
                value - least,
                left=least,
                height=0.66,
                color=ACCENT if name in MINE else GREY,
                alpha=1.0 if name == MINE[0] else 0.75 if name in MINE else 0.55,
                linewidth=0,
            )
            axis.text(value * 1.15, y, figure(medians[name]), va="center", fontsize=8)
        axis.set_xlim(least, max(shown.values(), default=1.0) * 12)
        axis.set_title(
            f"{about.title}, {about.unit}\n{'more' if about.higher else 'less'} is better",
            fontsize=9,
            loc="left",
        )
        axis.set_yticks(range(len(rows)), rows)
        axis.tick_params(length=0)
        axis.xaxis.set_visible(False)
        axis.spines["bottom"].set_visible(False)
    for label in axes[0].get_yticklabels():
        if label.get_text() in MINE:
            label.set_color(ACCENT)
    axes[0].invert_yaxis()
    made.suptitle(f"{WORKLOADS[work].title} (logarithmic)", x=0.01, ha="left", fontsize=10)
    made.tight_layout()
    return made


def _values(found: dict[str, Any], operation: str, name: str) -> list[float]:
    values: list[float] = found["cells"][operation].get(name, {}).get("values", [])
    return values


def _growth(plt: Any, growth: dict[str, Any]) -> Any:
    """Seconds by number of steps, both logarithmic."""
    from matplotlib.ticker import NullFormatter

    made, axes = plt.subplots(2, 2, figsize=(10.5, 6.2), sharex=True)
    for axis, (key, title) in zip(axes.flat, GROWTH.items(), strict=True):
        for number, (name, points) in enumerate(growth.items()):
            there = [(point["steps"], point[key]) for point in points if point.get(key, 0) > 0]
            if there:
                colour = COLOURS[number % len(COLOURS)]
                axis.plot(
                    *zip(*there, strict=True),
                    color=colour,
                    marker=MARKERS[number % len(MARKERS)],
                    markersize=5,
                    linewidth=2.4 if name in MINE else 1.4,
                    label=name,
                    zorder=3 if name in MINE else 2,
                )
        axis.set_xscale("log")
        axis.set_yscale("log")
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.set_title(f"{title} (seconds)", fontsize=9, loc="left")
        axis.grid(color=FAINT, linewidth=0.6)
        axis.tick_params(which="both", length=0)
    for axis in axes[1]:
        axis.set_xlabel("steps")
    handles, names = axes[0][0].get_legend_handles_labels()
    made.legend(
        handles,
        names,
        loc="upper center",
        ncols=8,
        frameon=False,
        bbox_to_anchor=(0.5, 1.0),
        fontsize=8.5,
        columnspacing=1.2,
        handlelength=1.6,
    )
    made.tight_layout(rect=(0, 0, 1, 0.96))
    return made
