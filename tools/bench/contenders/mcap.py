"""The `mcap` package by hand: a message a step, its bytes prepared; no episodes, no columns."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.contenders.base import CannotError, Contender, Session
from tools.bench.data import Array, Data
from tools.bench.measure import Stopwatch
from tools.bench.workloads import Workload, reference

SCHEMA = "an array of C structs"


def packed(data: Data) -> Array:
    """The steps as one structured array, a row a step: what messages are made of without any library."""
    fields = []
    for name, leaf in data.leaves.items():
        kind = leaf.dtype if leaf.dtype.kind != "U" else np.dtype(f"S{leaf.dtype.itemsize // 4}")
        fields.append((name, kind, leaf.shape[1:]))
    rows = np.empty(data.steps, np.dtype(fields))
    for name, leaf in data.leaves.items():
        rows[name] = leaf
    return rows


def messages(work: Workload, episodes: int) -> tuple[list[bytes], np.dtype[Any]]:
    """The bytes of each step, made before the clock runs."""
    steps = 2 * episodes * work.length + 1000
    rows = packed(reference(work.name, steps).head(episodes))
    return _each(rows), rows.dtype


def _each(rows: Array) -> list[bytes]:
    size, everything = rows.dtype.itemsize, rows.tobytes()
    return [everything[i : i + size] for i in range(0, len(everything), size)]


class Writing(gym.Wrapper[Any, Any, Any, Any]):
    """One call of `add(bytes, number)` a step."""

    def __init__(self, env: gym.Env[Any, Any], prepared: list[bytes], add: Any, finish: Any) -> None:
        super().__init__(env)
        self._prepared, self._add, self._finish, self._count = prepared, add, finish, 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        self._add(self._prepared[self._count], self._count)
        self._count += 1
        return result

    def close(self) -> None:
        self._finish()
        super().close()


class WritingVector(gym.vector.VectorWrapper):
    """The same of a vector environment: one call of `add` for each sub-environment that was not reset."""

    def __init__(self, env: Any, prepared: list[list[bytes]], add: Any, finish: Any) -> None:
        super().__init__(env)
        self._prepared, self._add, self._finish, self._count = iter(prepared), add, finish, 0

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        result = self.env.step(actions)
        for data in next(self._prepared):
            self._add(data, self._count)
        self._count += 1
        return result

    def close(self, **kwargs: Any) -> None:
        self._finish()
        super().close(**kwargs)


class Mcap(Contender):
    """`Writer.add_message` and `iter_messages`."""

    note = (
        "a message a step, its bytes prepared before the clock runs; reading joins them to a structured array"
    )

    def __init__(self) -> None:
        self._dtype: np.dtype[Any] | None = None

    def record(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        prepared, self._dtype = messages(work, episodes)
        env, watch = work.make(), Stopwatch()
        with watch:
            recorder = Writing(env, prepared, *self._writer(path))
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def write(self, path: Path, data: Data) -> None:
        """The file that recording these steps makes."""
        rows = packed(data)
        self._dtype = rows.dtype
        add, finish = self._writer(path)
        for number, message in enumerate(_each(rows)):
            add(message, number)
        finish()

    def prepare_vector(self, leaves: dict[str, Array]) -> None:
        there = leaves["is_step"]
        steps = {name: leaf[there] for name, leaf in leaves.items() if name != "is_step"}
        steps["env"] = np.nonzero(there)[1].astype(np.uint16)
        rows = packed(Data(steps, there.sum(1)))
        self._dtype, every = rows.dtype, iter(_each(rows))
        self._batches = [list(itertools.islice(every, count)) for count in there.sum(1).tolist()]

    def wrap_vector(self, env: Any, path: Path) -> WritingVector:
        return WritingVector(env, self._batches, *self._writer(path))

    def _writer(self, path: Path) -> tuple[Any, Any]:
        """What adds a message, and what finishes the file."""
        from mcap.writer import CompressionType, Writer

        writer = Writer(str(path), compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("steps", "c", SCHEMA.encode())
        channel = writer.register_channel("/step", "raw", schema)

        def add(data: bytes, number: int) -> None:
            writer.add_message(channel, number, data, number, number)

        return add, writer.finish

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        return self._columns(path, log_time_order=False), None

    def _columns(self, path: Path, **kwargs: Any) -> dict[str, Any]:
        from mcap.reader import make_reader

        with path.open("rb") as stream:
            found = make_reader(stream).iter_messages(topics=["/step"], **kwargs)
            rows = np.frombuffer(b"".join(message.data for _, _, message in found), self._dtype)
        columns = {name: np.array(rows[name]) for name in rows.dtype.names or ()}
        return {name: c.astype("U") if c.dtype.kind == "S" else c for name, c in columns.items()}

    def open(self, path: Path) -> Session:
        return _Session(self, path)


class _Session(Session):
    """Windows by time, which is the number of the step here; the caller must know where episodes begin."""

    def __init__(self, contender: Mcap, path: Path) -> None:
        super().__init__()
        self._contender, self._path = contender, path
        self.starts: Array | None = None

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        if self.starts is None:
            raise CannotError("has no episodes")
        first = int(self.starts[number]) + start
        return self._contender._columns(self._path, start_time=first, end_time=first + length)
