"""What the project has promised itself, and whether it was reached in this run."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from tools.bench.contenders import OURS
from tools.bench.measure import ratio

SAVED = "tupli-mcap, saved columns"
NPY, HDF5 = ".npy, mapped", "HDF5 by hand"
_SIZES = {
    "bytes": "lengths of the files",
    "apparent": "lengths of files and directories",
    "allocated": "allocated on disk",
}
MINARI = ("Minari HDF5", "Minari Arrow", "Minari Parquet")


@dataclass(frozen=True)
class Target:
    """One promise: `what <= limit` or `>=`, and the figure; None if it was not measured, and why in `note`."""

    what: str
    words: str
    figure: float | None
    reached: bool | None
    note: str = ""
    unit: str = ""

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def at_most(what: str, limit: float, figure: float | None, note: str = "", unit: str = "") -> Target:
    """A target that the figure be small."""
    words = (
        f"<= 1/{1 / limit:.0f}"
        if not unit and limit < 0.25 and abs(1 / limit - round(1 / limit)) < 1e-6
        else f"<= {limit:g}"
    )
    return Target(
        what, f"{words} {unit}".strip(), figure, None if figure is None else figure <= limit, note, unit
    )


def at_least(what: str, limit: float, figure: float | None, note: str = "", unit: str = "") -> Target:
    """A target that the figure be large."""
    return Target(
        what, f">= {limit:g} {unit}".strip(), figure, None if figure is None else figure >= limit, note, unit
    )


class Matrix:
    """Ratios between contenders in the table."""

    def __init__(self, found: dict[str, Any]) -> None:
        self._found = found

    def values(self, work: str, operation: str, name: str) -> Sequence[float]:
        """The figures; none if there are none."""
        values: Sequence[float] = (
            self._found.get(work, {}).get("cells", {}).get(operation, {}).get(name, {}).get("values", [])
        )
        return values

    def ratio(self, work: str, operation: str, name: str, other: str) -> float | None:
        """The one over the other."""
        mine, theirs = self.values(work, operation, name), self.values(work, operation, other)
        return ratio(mine, theirs) if mine and theirs else None

    def best(
        self, work: str, operation: str, names: Sequence[str], pick: Callable[..., float] = min
    ) -> str | None:
        """The contender of the smallest (or largest) median."""
        medians = {n: statistics.median(v) for n in names if (v := self.values(work, operation, n))}
        return None if not medians else pick(medians, key=lambda name: medians[name])

    def built(self, work: str, name: str) -> dict[str, Any]:
        """What was built for the readers."""
        facts: dict[str, Any] = self._found.get(work, {}).get("built", {}).get(name, {})
        return facts


def from_matrix(found: dict[str, Any]) -> Iterator[Target]:
    """The targets that are ratios of cells."""
    m = Matrix(found)
    yield from _recording(m)
    for name, least in (("PyTupli", 100), ("Minari HDF5", 10)):
        yield at_least(
            f"CartPole to NumPy, over {name}", least, m.ratio("cartpole", "read", OURS, name), unit="x"
        )
    best = m.best("floats", "window", MINARI)
    yield at_most(
        f"window of 32 steps, chunks decoded, over {best}",
        0.1,
        best and m.ratio("floats", "window", OURS, best),
    )
    yield from _sizes(m)
    for work in ("cartpole", "floats", "images"):
        figure = m.ratio(work, "read", OURS, HDF5)
        yield at_least(f"read all, {work}, over HDF5 by hand (gzip)", 1, figure, unit="x")
    for operation in ("epoch0", "epoch2"):
        workers = f"{operation[-1]} workers"
        for name in (OURS, SAVED):
            figure = m.ratio("floats", operation, name, NPY)
            yield at_least(
                f"shuffled epoch of 32-step windows, {workers}, {name}, over mapped .npy",
                0.7,
                figure,
                unit="x",
            )


def _recording(m: Matrix) -> Iterator[Target]:
    rollout = m.built("cartpole", "Minari HDF5").get("rollout")
    mine = m.values("cartpole", "record", OURS)
    figure = ratio(mine, rollout) if rollout and mine else None
    yield at_most("record CartPole, over Minari HDF5", 1 / 60, figure, "its create_dataset is not counted")
    yield at_most("record CartPole, over PyTupli", 1 / 12, m.ratio("cartpole", "record", OURS, "PyTupli"))
    yield at_most(
        "record CartPole, over bare mcap add_message", 0.4, m.ratio("cartpole", "record", OURS, "mcap")
    )
    rollouts = {name: m.built("floats", name).get("rollout") for name in MINARI}
    fastest = min((statistics.median(v) for v in rollouts.values() if v), default=None)
    mine = m.values("floats", "record", OURS)
    figure = statistics.median(mine) / fastest if mine and fastest else None
    yield at_most(
        "record 17 + 6 floats, over Minari's fastest", 1 / 12, figure, "its create_dataset is not counted"
    )


def _sizes(m: Matrix) -> Iterator[Target]:
    for work, limit in (("cartpole", 0.25), ("images", 0.6)):
        for key, words in _SIZES.items():
            sizes = [size for name in MINARI if (size := m.built(work, name).get(key))]
            mine = m.built(work, OURS).get(key)
            figure = mine / min(sizes) if mine and sizes else None
            yield at_most(f"size, {work}, {words}, over Minari's smallest", limit, figure)
