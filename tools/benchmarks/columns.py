"""Columns on the disk by other means: HDF5 by hand beside a recording, `.npy` beside materialized columns."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import ours, peers
from benchmarks.measure import (
    INSTALL_PEERS,
    OURS,
    Line,
    Run,
    alternate,
    at_most,
    check,
    naming,
    ratio,
    seconds_of,
)
from benchmarks.workloads import Columns, cartpole, floats

LEAVES = ("state", "action", "reward", "terminal", "timeout")
BATCH = 256
BATCHES = 400


def read_hdf5(run: Run) -> Iterator[Line]:
    """The whole recording to columns, and the same columns from chunked gzip datasets, as h5py makes them."""
    for workload in (cartpole(run.read_steps), floats()):
        case = f"read {workload.name} beside HDF5"
        if peers.missing(["h5py"]):
            yield Line(case, "h5py", "datasets to arrays", "ms", note=INSTALL_PEERS)
            continue
        path = run.fresh("read.mcap")
        reference = ours.record_with_reference(workload, path, run.read_steps)
        file = run.fresh("read.h5")
        _write_hdf5(file, reference)
        sides = {
            OURS: partial(_milliseconds, OURS, partial(_ours, path), reference, slice(None)),
            "h5py": partial(_milliseconds, "h5py", partial(_read_hdf5, file), reference, slice(None)),
        }
        values = alternate(sides, max(run.rounds, 5))
        does = (
            f"Recording.read(), {reference.steps:,} steps, CRCs checked, {path.stat().st_size / 1e6:.0f} MB"
        )
        yield Line(case, OURS, does, "ms", values[OURS])
        target, met = at_most(1)
        found = ratio(values[OURS], values["h5py"])
        does = f"datasets to arrays, chunks=True, gzip, {file.stat().st_size / 1e6:.0f} MB"
        yield Line(case, "h5py", does, "ms", values["h5py"], found, target, met(found))


def _write_hdf5(file: Path, columns: Columns) -> None:
    import h5py

    with h5py.File(file, "w") as out:
        for name in ours.COLUMNS:
            out.create_dataset(name, data=getattr(columns, name), chunks=True, compression="gzip")


def _read_hdf5(file: Path) -> Any:
    import h5py

    with h5py.File(file) as opened:
        return [opened[name][:] for name in ours.COLUMNS]


def _ours(path: Path) -> Any:
    columns = ours.read(path)
    return [getattr(columns, name) for name in ours.COLUMNS]


def materialized(run: Run) -> Iterator[Line]:
    """Materialized columns beside the same files through `np.load(mmap_mode="r")`: all of it, and random steps."""
    from tupli_mcap import TupliDataset

    path = run.fresh("mapped.mcap")
    reference = ours.record_with_reference(floats(), path, run.read_steps)
    directory = run.fresh("columns")
    dataset = TupliDataset.from_files(path).materialize(directory)
    steps = dataset.steps
    maps = [np.load(directory / f"{name}.npy", mmap_mode="r") for name in LEAVES]
    batches = np.random.default_rng(1).integers(0, reference.steps, (BATCHES, BATCH))

    def all_of_it() -> Any:
        return dataset.convert_to_numpy(mark_cuts=False)

    def ours_at(rows: NDArray[np.int64]) -> Any:
        found = steps.read(ours.COLUMNS, rows)
        return [found[name] for name in ours.COLUMNS]

    works: dict[str, tuple[Callable[[], Any], Callable[[], Any], Any]] = {
        "all steps copied": (all_of_it, lambda: [np.array(column) for column in maps], slice(None)),
        f"{BATCHES} batches of {BATCH} random steps": (
            lambda: [ours_at(rows) for rows in batches][-1],
            lambda: [[column[rows] for column in maps] for rows in batches][-1],
            batches[-1],
        ),
    }
    for does, (mine, theirs, rows) in works.items():
        sides = {
            OURS: partial(_milliseconds, OURS, mine, reference, rows),
            "npy": partial(_milliseconds, "npy", theirs, reference, rows),
        }
        values = alternate(sides, max(run.rounds, 5))
        yield Line("materialized", OURS, does, "ms", values[OURS])
        target, met = at_most(1.05)
        found = ratio(values[OURS], values["npy"])
        yield Line(
            "materialized",
            "npy",
            f"{does}, np.load(mmap_mode='r')",
            "ms",
            values["npy"],
            found,
            target,
            met(found),
        )


def _milliseconds(side: str, read: Callable[[], Any], reference: Columns, rows: Any) -> float:
    found: list[Any] = []
    seconds = seconds_of(lambda: found.append(read()))
    with naming(side):
        for name, column in zip(ours.COLUMNS, found[0], strict=True):
            check(np.array_equal(column, getattr(reference, name)[rows]), f"other {name}")
    return seconds * 1e3
