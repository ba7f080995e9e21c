"""One contender in a process of its own: `python -m tools.bench.worker NAME` answers lines of JSON.

A request is {"do": operation, ...}; an answer {"value": ...}, {"cannot": why} or {"failed": what}. What a contender
recorded or read is compared with what was rolled out before its time is given.
"""

from __future__ import annotations

import contextlib
import gc
import importlib.metadata
import json
import math
import os
import resource
import shutil
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench import epochs
from tools.bench.contenders import ENTRIES, CannotError, make
from tools.bench.data import Data, check_same
from tools.bench.measure import check, seconds_of
from tools.bench.workloads import NUM_ENVS, VECTOR, WORKLOADS, Workload, reference

PLACES = 100
TRIAL = 40_000  # env-steps


class Worker:
    """Carries out requests; `do_x` is the operation "x"."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._contender = make(name)
        self._built: dict[tuple[str, str], Data] = {}
        self._sessions: dict[str, Any] = {}
        self._trials: list[float] = []
        self._batches: dict[str, int] = {}  # of recordings of a vector environment
        self._random = np.random.default_rng()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Does it; nothing is raised."""
        operation: Callable[..., Any] = getattr(self, f"do_{request.pop('do')}")
        try:
            return {"value": operation(**request)}
        except CannotError as err:
            return {"cannot": str(err)}
        except Exception as err:  # noqa: BLE001 a contender may fail in any way; the table says so
            return {"failed": f"{type(err).__name__}: {' '.join(str(err).split())}"[:300]}

    def do_versions(self) -> dict[str, Any]:
        versions = {"python": ".".join(map(str, sys.version_info[:3]))}
        for package in ENTRIES[self._name].packages:
            versions[package] = importlib.metadata.version(package)
        return {"versions": versions, "note": self._contender.note}

    def do_build(self, work: str, path: str, steps: int, seconds: float | None = None) -> dict[str, Any]:
        """Records about `steps` steps for the other operations, or what takes about `seconds`; checks it all."""
        if work == VECTOR:
            return self._build_vector(Path(path), steps, seconds)
        workload, where = WORKLOADS[work], Path(path)
        data = reference(work, steps)
        if seconds is not None:
            data = data.head(self._affordable(workload, where, data, seconds))
        self._contender.record(workload, where, len(data.lengths))
        self._built[work, path] = data
        narrowed = self._check(where, data)
        return {
            "steps": data.steps,
            "episodes": len(data.lengths),
            "narrowed": narrowed,
            **_sizes(where, data.steps),
        }

    def _build_vector(self, where: Path, steps: int, seconds: float | None) -> dict[str, Any]:
        _, count, batches = self._record_vector(where, steps, math.inf if seconds is None else seconds)
        self._batches[str(where)] = batches
        return {"steps": count, **_sizes(where, count)}

    def _record_vector(self, where: Path, steps: int, seconds: float) -> tuple[float, int, int]:
        """Microseconds an env-step, how many (`steps`, or what takes about `seconds`), and in how many batches."""
        from tools.bench.vectors import LENGTH, record  # not in every Gymnasium

        trial = min(steps, TRIAL)
        while len(self._trials) < 2:  # the first one imports, and is not counted
            took = seconds_of(lambda: record(self._contender, where, LENGTH, trial // NUM_ENVS + 1))
            self._trials.append(took / trial)
            _remove(where)
        batches = max(1, int(min(steps, seconds / self._trials[-1]) / NUM_ENVS))
        return *record(self._contender, where, LENGTH, batches), batches

    def _affordable(self, workload: Workload, where: Path, data: Data, seconds: float) -> int:
        """How many episodes may be recorded and read in about `seconds`, at least two."""
        trial = where.with_name(f"trial-{where.name}")
        before, per_step = (0, 0.0), 0.0  # of the trial before: steps, seconds
        for steps in (1, 100, 1000):  # the first one imports, and is not counted
            _remove(trial)
            episodes = max(2, data.episodes_for(steps))
            began = time.perf_counter()
            _, count = self._contender.record(workload, trial, episodes)
            with contextlib.suppress(CannotError):
                self._contender.read(trial)
            took = time.perf_counter() - began
            per_step = took / count
            if steps == 1000 and count > before[0]:  # what is paid once a recording does not grow with it
                per_step = max((took - before[1]) / (count - before[0]), per_step / 4)
            before = count, took
            if took > seconds / 4 and steps > 1:
                break
        _remove(trial)
        return max(2, data.episodes_for(min(data.steps, seconds / per_step)))

    def _check(self, path: Path, data: Data) -> bool:
        want = self._contender.wanted(data)
        found, lengths = self._contender.read(path)
        if lengths is not None:
            check(np.array_equal(lengths, want.lengths), "other episodes")
        return self._compare(found, want.leaves)

    def _compare(self, found: Any, wanted: dict[str, Any]) -> bool:
        """Row by row; without an order of the episodes, as sets of rows."""
        if not self._ordered:
            found, wanted = _sorted(found), _sorted(wanted)
        return check_same(found, wanted)

    @property
    def _ordered(self) -> bool:
        return self._name != "PyTupli"

    # ---- operations: each gives one figure

    def do_record(self, work: str, path: str, seconds: float, steps: int) -> float:
        """Microseconds a step over the same rollout without a recorder, in turns with it."""
        where = Path(path)
        if work == VECTOR:
            value, _, _ = self._record_vector(where, steps, seconds)
            _remove(where)
            return value
        workload = WORKLOADS[work]
        data = reference(work, steps)
        key = work, "record"
        if key not in self._built:
            self._built[key] = data.head(self._affordable(workload, where, data, seconds))
        data = self._built[key]
        episodes = len(data.lengths)
        gc.collect()
        with workload.beside() as bare:
            took, count = self._contender.record(workload, where, episodes)
        check(count == data.steps, f"{count} steps, not {data.steps}")
        self._check(where, data)
        _remove(where)
        return (took - 2 * bare.seconds) / count * 1e6  # once while it was recorded, and once for itself

    def do_finishing(self) -> float:
        """Microseconds a step of what came after the rollout of the last recording."""
        seconds: float = getattr(self._contender, "finishing", 0.0)
        return seconds * 1e6

    def do_append(self, work: str, path: str, copy: str, episodes: int) -> float:
        """Milliseconds of opening what is there, recording some more episodes, and closing it."""
        data = self._built[work, path]
        where = Path(copy)
        _remove(where)
        (shutil.copytree if Path(path).is_dir() else shutil.copy)(path, where)
        episodes = min(episodes, len(data.lengths))
        workload = WORKLOADS[work]
        bare = _bare(workload, episodes)
        took, count = self._contender.append(workload, where, episodes)
        wanted = self._contender.wanted(data).twice(episodes)
        found, _ = self._contender.read(where)
        self._compare(found, wanted.leaves)
        _remove(where)
        return (took - bare * count) * 1e3

    def do_list(self, work: str, path: str) -> float:
        """Microseconds an episode of opening and giving each one's length."""
        data = self._built[work, path]
        found: list[Any] = []
        seconds = seconds_of(lambda: found.append(self._contender.listing(Path(path))))
        have, want = found[0], data.lengths
        check(
            np.array_equal(
                have if self._ordered else np.sort(have), want if self._ordered else np.sort(want)
            ),
            "other lengths",
        )
        return seconds / len(want) * 1e6

    def do_read(self, work: str, path: str) -> float:
        """Million steps a second, opening counted."""
        if work == VECTOR:
            from tools.bench.vectors import LENGTH, read  # not in every Gymnasium

            return read(self._contender, Path(path), LENGTH, self._batches[path])
        data = self._built[work, path]
        found: list[Any] = []
        seconds = seconds_of(lambda: found.append(self._contender.read(Path(path))))
        self._compare(found[0][0], self._contender.wanted(data).leaves)
        return data.steps / seconds / 1e6

    def do_field(self, work: str, path: str) -> float:
        """Million steps a second, opening counted, of the actions alone."""
        data = self._built[work, path]
        found: list[Any] = []
        seconds = seconds_of(lambda: found.append(self._contender.field(Path(path))))
        check_same({"actions": found[0]}, data.leaves, ["actions"])
        return data.steps / seconds / 1e6

    def do_filter(self, work: str, path: str) -> float:
        """Microseconds an episode that is there, of finding those of a high return and reading them."""
        data = self._built[work, path]
        least, chosen = data.best()
        found: list[Any] = []
        seconds = seconds_of(lambda: found.append(self._contender.select(Path(path), least)))
        self._compare(found[0], self._contender.wanted(data).take(chosen).leaves)
        return seconds / len(data.lengths) * 1e6

    def do_episode(self, work: str, path: str) -> float:
        """Microseconds of reading an episode at a random place of an open dataset."""
        data, session = self._built[work, path], self._session(work, path)
        numbers = self._random.integers(0, len(data.lengths), PLACES).tolist()
        return self._each([(lambda n=n: session.episode(n), data.rows(n)) for n in numbers])

    def do_window(self, work: str, path: str) -> float:
        """Microseconds of reading a window at a random place of an open dataset that was read before."""
        data, session = self._built[work, path], self._session(work, path)
        length = WORKLOADS[work].window
        places = epochs.places_of(data, length, 1)
        places = places[self._random.integers(0, len(places), PLACES)]
        return self._each(
            [
                (lambda n=n, at=at: session.window(n, at, length), data.rows(n, at, length))
                for n, at in places.tolist()
            ]
        )

    def _each(self, calls: list[tuple[Callable[[], Any], Any]]) -> float:
        """Microseconds a call; as many as fit into a second. All are checked."""
        gc.collect()
        began = time.perf_counter()
        times: list[float] = []
        for call, wanted in calls:
            spent = time.perf_counter()
            found = call()
            times.append(time.perf_counter() - spent)
            check_same(found, wanted)
            if time.perf_counter() - began > 1.0:
                break
        return statistics.fmean(times) * 1e6

    def _session(self, work: str, path: str) -> Any:
        if path not in self._sessions:
            session = self._contender.open(Path(path))
            if hasattr(session, "starts"):
                session.starts = self._built[work, path].starts
            self._sessions[path] = session
        return self._sessions[path]

    def do_epoch(self, work: str, path: str, workers: int, seconds: float) -> float:
        """Thousand windows a second; all of them where batches are read at once, else what `seconds` are enough for."""
        count = epochs.MOST
        if not epochs.in_batches(self._contender):
            count = epochs.speed_of_window(self.do_window(work, path) / 1e6, seconds)
        data = self._built[work, path]
        took, count = epochs.epoch(self._contender, WORKLOADS[work], Path(path), data, workers, count)
        return count / took / 1e3

    def do_grow(self, work: str, path: str, steps: int) -> dict[str, float]:
        """Seconds of recording `steps` steps, listing, reading, 100 windows; and the peak of memory (MiB)."""
        workload, where = WORKLOADS[work], Path(path)
        data = workload.data(steps)
        self._built[work, path] = data
        episodes = len(data.lengths)
        bare = _bare(workload, min(episodes, 5000))
        took, count = self._contender.record(workload, where, episodes)
        made = {"steps": float(count), "record": took - bare * count}
        tasks: dict[str, Callable[[], float]] = {
            "list": lambda: self.do_list(work, path) * episodes / 1e6,
            "read": lambda: count / self.do_read(work, path) / 1e6,
            "window": lambda: self._first_windows(work, path),
        }
        for name, task in tasks.items():
            with contextlib.suppress(CannotError):
                made[name] = task()
        made["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        made["bytes"] = _sizes(where, 1)["bytes"]
        self.do_forget(path)
        return made

    def _first_windows(self, work: str, path: str) -> float:
        """Seconds of opening, and of a window; the first of a hundred."""
        began = time.perf_counter()
        session = self._session(work, path)
        opening = time.perf_counter() - began
        del session
        return opening + self.do_window(work, path) / 1e6

    def do_forget(self, path: str) -> None:
        """Closes and removes what is there."""
        if path in self._sessions:
            self._sessions.pop(path).close()
        self._built = {key: data for key, data in self._built.items() if key[1] != path}
        _remove(Path(path))


def _bare(workload: Workload, episodes: int) -> float:
    """Seconds a step of the rollout through a wrapper that does nothing."""
    env: Any = gym.Wrapper(workload.make())
    gc.collect()
    began = time.perf_counter()
    steps = workload.rollout(env, episodes)
    return (time.perf_counter() - began) / steps


def _sorted(leaves: dict[str, Any]) -> dict[str, Any]:
    """The rows in an order that depends on nothing but them."""
    columns = [
        np.asarray(leaves[name], np.float32).reshape(len(leaves["rewards"]), -1) for name in sorted(leaves)
    ]
    rows = np.concatenate(columns, axis=1)
    return {"rows": rows[np.lexsort(rows.T[:64])]}


def _sizes(path: Path, steps: int) -> dict[str, float]:
    """Bytes a step of a file or a directory: `bytes` by the lengths of the files, `apparent` with the directories that
    they lie in (`du --apparent-size`), `allocated` by what the disk takes for both (`du`).
    """
    found = [(each, each.stat()) for each in ([path, *path.rglob("*")] if path.is_dir() else [path])]
    return {
        "bytes": sum(stat.st_size for each, stat in found if each.is_file()) / steps,
        "apparent": sum(stat.st_size for _, stat in found) / steps,
        "allocated": sum(stat.st_blocks * 512 for _, stat in found) / steps,
    }


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def main() -> None:
    """Answers until its input ends. What contenders print goes nowhere."""
    answers = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    if not os.environ.get("TUPLI_MCAP_BENCH_TALK"):
        os.dup2(nowhere, 2)
    try:
        worker: Worker | None = Worker(sys.argv[1])
        trouble = ""
    except ImportError as err:
        worker, trouble = None, f"not installed: {err}"
    for line in sys.stdin:
        answer = {"cannot": trouble} if worker is None else worker.answer(json.loads(line))
        print(json.dumps(answer, default=float), file=answers, flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)  # threads and temporary files of contenders are of no interest any more
