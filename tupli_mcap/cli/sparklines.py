"""Series of numbers as lines of blocks, for `info`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from tupli_mcap.cli.output import Column, number, print_table, print_wrapped
from tupli_mcap.cli.terminal import can_print, say, terminal_width

if TYPE_CHECKING:
    from tupli_mcap.recording import Recording
    from tupli_mcap.recording.series import Series

__all__ = ["print_sketch", "sparkline"]

BLOCKS = "▁▂▃▄▅▆▇█"
PLAIN = ".:-=+*#@"  # where blocks cannot be printed
_WIDEST, _NARROWEST = 40, 8
_OTHERS = 44  # columns of a line beside its blocks
_LONGEST_NAME = 24


def sparkline(values: Sequence[float], *, zero_based: bool = False, blocks: str = BLOCKS) -> str:
    """One character a number: a higher one for a larger number, a space for NaN.

    zero_based: the lowest level is that of 0, which is a space; else that of the smallest number.
    """
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return ""
    low, high = (0.0 if zero_based else min(finite)), max(finite)
    line = ""
    for value in values:
        if not math.isfinite(value) or (zero_based and value <= 0):
            line += " "
        elif high > low:
            part = (value / 2 - low / 2) / (high / 2 - low / 2)  # a difference of huge numbers may overflow
            line += blocks[min(int(part * len(blocks)), len(blocks) - 1)]
        else:
            line += blocks[len(blocks) // 2]
    return line


def print_sketch(recording: Recording) -> None:
    """Returns and lengths over episodes, and how rewards, actions and states are distributed."""
    from tupli_mcap.recording.series import sketch

    room = (terminal_width() or _WIDEST + _OTHERS) - _OTHERS
    found = sketch(recording, max(_NARROWEST, min(_WIDEST, room)))
    if not found.courses:
        return
    say("")
    _print("EPISODES", "FIRST TO LAST", found.courses, zero_based=False)
    if found.distributions:
        say("")
        _print("STEPS", "LEAST TO MOST", found.distributions, zero_based=True)
        told = "" if found.sampled == recording.num_steps else f"{number(found.sampled)} steps sampled"
        hidden = f"{number(found.hidden)} more dimensions" if found.hidden else ""
        if told or hidden:
            say(", ".join(filter(None, (hidden, told))))
        odd = [f"{number(one.odd)} of {one.name}" for one in found.distributions if one.odd]
        if odd:
            print_wrapped(f"not finite, left out: {', '.join(odd)}", "", "")
    if found.error:
        say(f"no step is shown: {found.error}")


def _print(title: str, spark: str, series: Sequence[Series], *, zero_based: bool) -> None:
    blocks = BLOCKS if can_print(BLOCKS) else PLAIN
    columns = (Column(title, shrink="end"), Column(spark), Column("LEAST", "right"), Column("MOST", "right"))
    rows = [
        (
            one.name if len(one.name) <= _LONGEST_NAME else f"{one.name[:8]}...{one.name[-13:]}",
            sparkline(one.values, zero_based=zero_based, blocks=blocks),
            *("" if math.isnan(end) else number(end, 3) for end in (one.least, one.most)),
        )
        for one in series
    ]
    print_table(columns, rows, empty="")
