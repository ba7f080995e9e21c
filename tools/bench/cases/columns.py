"""Random access beside memory-mapped `.npy` files, without a loader around it: what a training loop waits for."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.ours import Ours
from tools.bench.data import Array, Data, check_same, flat
from tools.bench.epochs import places_of
from tools.bench.measure import Run, alternate, check, ratio
from tools.bench.targets import Target, at_least
from tools.bench.workloads import SEED, STEPS, WORKLOADS, reference

BATCH, BATCHES, WINDOW = 256, 60, 32
FIELDS = ("states", *STEPS)


def _recorded(run: Run) -> tuple[Path, Data, Any, dict[str, Array]]:
    """A recording of a million steps, what it holds, its columns saved, and these mapped by hand."""
    from tupli_mcap import TupliDataset
    from tupli_mcap.dataset import open_columns

    work = WORKLOADS["floats"]
    path, data = run.fresh("mapped.mcap"), reference("floats", run.part(1_000_000, 4000))
    Ours().record(work, path, len(data.lengths))
    directory = run.fresh("by-hand")
    directory.mkdir()
    for name, leaf in data.leaves.items():
        np.save(directory / f"{name}.npy", leaf)
    mapped = {name: np.load(directory / f"{name}.npy", mmap_mode="r") for name in data.leaves}
    columns = run.fresh("columns")
    TupliDataset.from_files(path).save_columns(columns)
    return path, data, open_columns(columns), mapped


def windows(run: Run) -> Iterator[Target]:
    """Batches of shuffled windows, all five columns, chunks decoded before; the processor's time counts."""
    from tupli_mcap import TupliDataset

    path, data, columns, mapped = _recorded(run)
    places = places_of(data, WINDOW, 1)
    firsts, ahead = data.starts[places[:, 0]] + places[:, 1], np.arange(WINDOW)

    def by_hand(items: Array) -> dict[str, Any]:
        rows = firsts[items][:, None] + ahead
        return {name: leaf[rows] for name, leaf in mapped.items()}

    def of(windows: Any) -> Callable[[Array], dict[str, Any]]:
        check(len(windows) == len(places), f"{len(windows)} windows, not {len(places)}")
        return lambda items: _fields(windows[items].asdict())

    sides = {
        "mapped .npy": by_hand,
        "recording": of(TupliDataset.from_files(path).windows(WINDOW)),
        "saved columns": of(columns.windows(WINDOW)),
    }
    order = np.random.default_rng(SEED).permutation(len(places))[: BATCHES * BATCH]
    wanted = by_hand(order[:BATCH])
    for side in sides.values():
        check(not check_same(side(order[:BATCH]), wanted), "other windows")
    batches = np.array_split(order, max(1, len(order) // BATCH))
    timed = {name: (lambda side=side: _seconds(side, batches) * 1e6) for name, side in sides.items()}
    alternate(timed, 1)
    values = alternate(timed, max(run.rounds, 5))
    middle = statistics.median(values["mapped .npy"])
    for name in ("recording", "saved columns"):
        note = f"{statistics.median(values[name]):.0f} µs a batch of {BATCH}, {middle:.0f} by hand"
        what = f"shuffled windows of {WINDOW} steps, no loader: speed of the {name} over mapped .npy"
        yield at_least(what, 0.7, ratio(values["mapped .npy"], values[name]), note, "x")


def _fields(found: dict[str, Any]) -> dict[str, Any]:
    return {name: found[name] for name in FIELDS}


def _seconds(side: Callable[[Array], Any], batches: list[Array]) -> float:
    """Seconds of the processor a batch."""
    began = time.process_time()
    for batch in batches:
        side(batch)
    return (time.process_time() - began) / len(batches)


def saved(run: Run) -> Iterator[Target]:
    """All steps, and steps by number: the processor's time of saved columns and of `np.load`."""
    _, data, columns, mapped = _recorded(run)
    steps = columns.steps
    ascending = np.arange(data.steps)
    rows = list(np.random.default_rng(SEED).integers(0, data.steps, (BATCHES * 4, BATCH)))

    def read(chosen: Array) -> dict[str, Any]:
        found = steps.read(FIELDS, chosen)
        return flat(found.pop("states")) | found

    def copied(_: Any) -> dict[str, Any]:
        return {name: np.array(leaf) for name, leaf in mapped.items()}

    def picked(chosen: Array) -> dict[str, Any]:
        return {name: leaf[chosen] for name, leaf in mapped.items()}

    for what, theirs, batches in (
        ("all steps", copied, [ascending]),
        (f"batches of {BATCH} random steps", picked, rows),
    ):
        check(not check_same(read(batches[0]), theirs(batches[0])), "other steps")
        sides = {
            "ours": lambda batches=batches: _seconds(read, batches),
            "npy": lambda theirs=theirs, batches=batches: _seconds(theirs, batches),
        }
        # one batch of everything is over soon, and most of it is memory that the system makes ready
        values = alternate(sides, run.part(25, 7) if len(batches) == 1 else max(run.rounds, 7))
        figure = ratio(values["npy"], values["ours"])
        yield at_least(
            f"saved columns, {what}: speed over mapped .npy", 0.95, figure, "equal, up to noise", "x"
        )
