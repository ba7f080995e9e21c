"""Promises that need a measurement of their own; each case yields targets."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from tools.bench.cases import (
    atari,
    catalog,
    columns,
    library,
    memory,
    reading,
    startup,
    vector,
    viewing,
    watching,
)
from tools.bench.measure import Run
from tools.bench.targets import Target

__all__ = ["CASES", "MORE"]

CASES: dict[str, Callable[[Run], Iterator[Target]]] = {
    "floor": reading.floor_speed,
    "over mcap": reading.over_mcap,
    "cold": reading.cold_windows,
    "windows": columns.windows,
    "saved": columns.saved,
    "listing": reading.listing,
    "noise": reading.incompressible,
    "vector": vector.record_vector,
    "atari": atari.overhead,
    "catalog": catalog.filter_catalog,
    "memory": memory.bounded,
    "worker": memory.loader_worker,
    "startup": startup.startup,
}
MORE: dict[str, Callable[[Run], Iterator[Target]]] = {
    "library": library.library,
    "copying": library.copying,
    "live": watching.live,
    "replay": viewing.replay_cartpole,
}
