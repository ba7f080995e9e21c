"""Who is compared. Each module imports its library only when it is asked to do something."""

from __future__ import annotations

import importlib
from typing import NamedTuple

from tools.bench.contenders.base import CannotError, Contender

__all__ = ["ENTRIES", "OURS", "CannotError", "Contender", "Entry", "make"]

OURS = "tupli-mcap"


class Entry(NamedTuple):
    """Where a contender is, and the virtual environment ("" is the one that runs the benchmark)."""

    module: str
    cls: str
    venv: str
    packages: tuple[str, ...]


ENTRIES: dict[str, Entry] = {
    OURS: Entry("ours", "Ours", "", ("tupli-mcap", "mcap", "zstandard")),
    "tupli-mcap, saved columns": Entry("ours", "SavedColumns", "", ("tupli-mcap",)),
    "Minari HDF5": Entry("minari", "MinariHdf5", ".venv-peers", ("minari", "h5py")),
    "Minari Arrow": Entry("minari", "MinariArrow", ".venv-peers", ("minari", "pyarrow")),
    "Minari Parquet": Entry("minari", "MinariParquet", ".venv-peers", ("minari", "pyarrow")),
    "PyTupli": Entry("pytupli", "PyTupli", ".venv-peers", ("pytupli",)),
    "LeRobot v3": Entry("lerobot", "LeRobot", ".venv-peers", ("lerobot", "datasets", "torch")),
    "d3rlpy": Entry("d3rlpy", "D3rlpy", ".venv-d3rlpy", ("d3rlpy", "h5py")),
    "mcap": Entry("mcap", "Mcap", "", ("mcap",)),
    "foxglove-sdk": Entry("foxglove", "Foxglove", "", ("foxglove-sdk",)),
    "HDF5 by hand": Entry("hdf5", "Hdf5", "", ("h5py",)),
    "Parquet by hand": Entry("parquet", "Parquet", "", ("pyarrow",)),
    ".npz": Entry("numpys", "Npz", "", ("numpy",)),
    ".npy, mapped": Entry("numpys", "Npy", "", ("numpy",)),
}


def make(name: str) -> Contender:
    """A contender by its name in `ENTRIES`."""
    entry = ENTRIES[name]
    cls = getattr(importlib.import_module(f"tools.bench.contenders.{entry.module}"), entry.cls)
    made: Contender = cls()
    return made
