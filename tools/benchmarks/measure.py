"""Timing in alternation, and the lines of the report.

Every comparison runs its sides in turn, round after round, in one process: a machine that slows down for a
while slows all sides down. A figure is the median over the rounds, its spread the smallest and the largest; a
ratio is the median of the ratios within each round.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

OURS = "tupli-mcap"
INSTALL_PEERS = "not installed: pip install -e '.[bench]'"


class WrongResultError(Exception):
    """A side returned something else than what was recorded: its time does not count."""


@dataclass(frozen=True)
class Line:
    """One row of the report; `values` are in `unit`, one a round, empty where a peer is missing."""

    case: str
    side: str
    does: str
    unit: str
    values: Sequence[float] = ()
    ratio: float | None = None  # ours over this side, or as `target` says
    target: str = ""
    met: bool | None = None
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """The row with its median and spread, for `--json`."""
        row = asdict(self) | {"values": list(self.values)}
        if self.values:
            row |= {
                "median": statistics.median(self.values),
                "min": min(self.values),
                "max": max(self.values),
            }
        return row


@dataclass
class Run:
    """What one invocation may use: a directory, and how much work to do."""

    directory: Path
    steps: int  # rolled out a round by the fast sides
    read_steps: int  # in the recording that is read
    rounds: int
    episodes: int  # in the recording that is listed
    catalogued: int  # episodes in the catalog that is filtered
    _count: int = field(default=0, init=False)

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
    """Median over the rounds of ours / theirs."""
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))


def at_most(limit: float, name: str = "ours/this") -> tuple[str, Callable[[float], bool]]:
    """A target `ratio <= limit`, in words (as a fraction where that reads better) and as a test."""
    words = f"1/{1 / limit:.0f}" if limit < 0.2 else f"{limit:.2f}"
    return f"{name} <= {words}", lambda value: value <= limit


def at_least(limit: float, name: str = "ours/this") -> tuple[str, Callable[[float], bool]]:
    """A target `ratio >= limit`."""
    return f"{name} >= {limit:g}", lambda value: value >= limit


def check(condition: bool, what: str) -> None:
    """Raise WrongResultError saying `what` was wrong."""
    if not condition:
        raise WrongResultError(what)


@contextmanager
def naming(side: str) -> Iterator[None]:
    """Put the side's name in front of a WrongResultError."""
    try:
        yield
    except WrongResultError as err:
        raise WrongResultError(f"{side}: {err}") from err
