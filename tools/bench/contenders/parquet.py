"""Parquet through pyarrow: row groups of 4,096 steps, zstd; another file for the episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.base import ByHand, Session, joined
from tools.bench.data import Array


class _Sink:
    def __init__(self, path: Path) -> None:
        path.mkdir()
        self._path = path
        self._writer: Any = None
        self._shapes: dict[str, tuple[int, ...]] = {}

    def write(self, leaves: dict[str, Array]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({name: _column(rows) for name, rows in leaves.items()})
        if self._writer is None:
            np.save(self._path / "shapes.npy", np.array([f"{n}|{r.shape[1:]}" for n, r in leaves.items()]))
            self._writer = pq.ParquetWriter(self._path / "steps.parquet", table.schema, compression="zstd")
        self._writer.write_table(table)

    def finish(self, lengths: Array, returns: Array, finals: dict[str, Array]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._writer.close()
        columns = {"length": lengths, "return": returns}
        columns |= {f"final.{name}": _column(rows) for name, rows in finals.items()}
        pq.write_table(pa.table(columns), self._path / "episodes.parquet", compression="zstd")


def _column(rows: Array) -> Any:
    import pyarrow as pa

    if rows.ndim == 1:
        return pa.array(rows)
    flat = pa.array(rows.reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, int(np.prod(rows.shape[1:])))


def _array(column: Any, shape: tuple[int, ...]) -> Array:
    column = column.combine_chunks()
    if shape:
        column = column.flatten()
    made: Array = column.to_numpy(zero_copy_only=False)
    return made.reshape(-1, *shape)


class _Session(Session):
    def __init__(self, path: Path) -> None:
        import ast

        import pyarrow.parquet as pq

        facts = pq.read_table(path / "episodes.parquet", columns=["length", "return"])
        super().__init__(facts["length"].to_numpy())
        self.returns = facts["return"].to_numpy()
        self._starts = np.cumsum(self.lengths) - self.lengths
        told = (text.split("|") for text in np.load(path / "shapes.npy").tolist())
        self._shapes = {name: ast.literal_eval(shape) for name, shape in told}
        self.file = pq.ParquetFile(path / "steps.parquet")
        groups = [self.file.metadata.row_group(i).num_rows for i in range(self.file.num_row_groups)]
        self._ends = np.cumsum(groups)

    def arrays(self, table: Any) -> dict[str, Any]:
        return {name: _array(table[name], shape) for name, shape in self._shapes.items()}

    def episode(self, number: int) -> dict[str, Any]:
        return self.window(number, 0, int(self.lengths[number]))  # type: ignore[index]

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        first = int(self._starts[number]) + start
        low = int(np.searchsorted(self._ends, first, side="right"))
        high = int(np.searchsorted(self._ends, first + length - 1, side="right"))
        table = self.file.read_row_groups(list(range(low, high + 1)))
        return self.arrays(table.slice(first - (int(self._ends[low - 1]) if low else 0), length))

    def close(self) -> None:
        self.file.close()


class Parquet(ByHand):
    """pyarrow."""

    sink = _Sink

    def listing(self, path: Path) -> Array:
        import pyarrow.parquet as pq

        lengths: Array = pq.read_table(path / "episodes.parquet", columns=["length"])["length"].to_numpy()
        return lengths

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        session = _Session(path)
        return session.arrays(session.file.read()), session.lengths

    def field(self, path: Path) -> Array:
        session = _Session(path)
        table = session.file.read(columns=["actions"])
        return _array(table["actions"], session._shapes["actions"])

    def open(self, path: Path) -> Session:
        return _Session(path)

    def select(self, path: Path, least: float) -> dict[str, Any]:
        session = _Session(path)
        return joined([session.episode(n) for n in np.flatnonzero(session.returns >= least).tolist()])
