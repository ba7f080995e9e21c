"""Timing in alternation, and figures with their spread.

Every comparison asks its sides in turn, round after round: a machine that slows down for a while slows all of them
down. A figure is the median over the rounds, its spread the smallest and the largest; a ratio of two sides is the
median of the ratios within each round.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Run", "Stopwatch", "WrongResultError", "alternate", "check", "ratio", "seconds_of"]


class WrongResultError(Exception):
    """A side returned something else than what was recorded: its time does not count."""


@dataclass
class Run:
    """What one invocation may use: a directory, and how much work to do."""

    directory: Path
    quick: bool
    rounds: int
    _count: int = field(default=0, init=False)

    def part(self, amount: int, least: int = 1) -> int:
        """An amount of work, a fiftieth of it where it is quick."""
        return max(least, amount // 50) if self.quick else amount

    def fresh(self, name: str) -> Path:
        """A path that does not exist yet."""
        self._count += 1
        return self.directory / f"{self._count:04d}-{name}"


class Stopwatch:
    """Adds up the seconds spent inside `with stopwatch:`."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._start = 0.0

    def __enter__(self) -> Stopwatch:
        self._start = time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds += time.perf_counter() - self._start


def seconds_of(function: Callable[[], object]) -> float:
    """Wall-clock seconds of one call, after a garbage collection that is not counted."""
    gc.collect()
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def alternate(sides: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Call every side once a round, in an order that turns round each time; return what each returned."""
    values: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(rounds):
        for name in sorted(sides, key=list(sides).index, reverse=bool(number % 2)):
            values[name].append(sides[name]())
    return values


def ratio(ours: Sequence[float], theirs: Sequence[float]) -> float:
    """Median over the rounds of ours / theirs; of the medians where they took part in different rounds."""
    if len(ours) == len(theirs):
        return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))
    return statistics.median(ours) / statistics.median(theirs)


def check(condition: bool, what: str) -> None:
    """Raise WrongResultError saying `what` was wrong."""
    if not condition:
        raise WrongResultError(what)
