"""HDF5 by hand: one dataset a column, chunked, gzip, written a block at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import Blocks, ByHand, Session, joined
from tools.bench.data import Array
from tools.bench.measure import Stopwatch
from tools.bench.workloads import Workload

CHUNK = 256 << 10  # bytes
CACHE = 64 << 20  # bytes of a dataset's chunk cache: the default of 1 MiB would be a weak opponent


class _Sink:
    def __init__(self, path: Path, mode: str = "w") -> None:
        import h5py

        self._file = h5py.File(path, mode)
        self._text = h5py.string_dtype()

    def _extend(self, name: str, rows: Array) -> None:
        if name not in self._file:
            kind = self._text if rows.dtype.kind == "U" else rows.dtype
            row = max(1, rows[:1].nbytes)
            self._file.create_dataset(
                name,
                (0, *rows.shape[1:]),
                kind,
                maxshape=(None, *rows.shape[1:]),
                chunks=(max(1, min(4096, CHUNK // row)), *rows.shape[1:]),
                compression="gzip",
            )
        dataset = self._file[name]
        start = len(dataset)
        dataset.resize(start + len(rows), axis=0)
        dataset[start:] = rows.astype(object) if rows.dtype.kind == "U" else rows

    def write(self, leaves: dict[str, Array]) -> None:
        for name, rows in leaves.items():
            self._extend(name, rows)

    def finish(self, lengths: Array, returns: Array, finals: dict[str, Array]) -> None:
        self._extend("lengths", lengths)
        self._extend("returns", returns)
        for name, rows in finals.items():
            self._extend(f"final.{name}", rows)
        self._file.close()


class _Session(Session):
    def __init__(self, path: Path) -> None:
        import h5py

        self.file = h5py.File(path, rdcc_nbytes=CACHE)
        super().__init__(self.file["lengths"][:])
        self._starts = np.cumsum(self.lengths) - self.lengths
        names = [name for name in self.file if name not in ("lengths", "returns") and name[:6] != "final."]
        self.leaves = {name: _strings(self.file[name]) for name in names}

    def episode(self, number: int) -> dict[str, Any]:
        return self.window(number, 0, int(self.lengths[number]))  # type: ignore[index]

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        first = int(self._starts[number]) + start
        return {name: leaf[first : first + length] for name, leaf in self.leaves.items()}

    def close(self) -> None:
        self.file.close()


def _strings(dataset: Any) -> Any:
    return dataset.asstr() if dataset.dtype.kind == "O" else dataset


class Hdf5(ByHand):
    """h5py."""

    sink = _Sink

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        env, watch = work.make(), Stopwatch()
        with watch:
            recorder = Blocks(env, _Sink(path, "a"))
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def listing(self, path: Path) -> Array:
        import h5py

        with h5py.File(path) as file:
            lengths: Array = file["lengths"][:]
            return lengths

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        session = _Session(path)
        found = {name: leaf[:] for name, leaf in session.leaves.items()}
        session.close()
        return found, session.lengths

    def field(self, path: Path) -> Array:
        import h5py

        with h5py.File(path) as file:
            actions: Array = file["actions"][:]
            return actions

    def open(self, path: Path) -> Session:
        return _Session(path)

    def select(self, path: Path, least: float) -> dict[str, Any]:
        session = _Session(path)
        chosen = np.flatnonzero(session.file["returns"][:] >= least)
        found = joined([session.episode(number) for number in chosen.tolist()])
        session.close()
        return found
