"""Every contender, every workload, every operation: in alternation, round after round."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from tools.bench.contenders import ENTRIES, OURS
from tools.bench.fleet import NoAnswerError, Process
from tools.bench.measure import Run
from tools.bench.workloads import VECTOR


class Operation(NamedTuple):
    """A column of the table."""

    title: str
    unit: str
    higher: bool = False  # whether more is better


OPERATIONS = {
    "record": Operation("record", "µs/step"),
    "size": Operation("size", "bytes/step"),
    "list": Operation("open, list", "µs/episode"),
    "read": Operation("read all", "M steps/s", True),
    "field": Operation("one field", "M steps/s", True),
    "episode": Operation("episode", "µs"),
    "window": Operation("window", "µs"),
    "epoch0": Operation("epoch", "k windows/s", True),
    "epoch2": Operation("epoch, 2 workers", "k windows/s", True),
    "filter": Operation("filter", "µs/episode"),
    "append": Operation("append", "ms"),
}
SLOW = 8.0  # seconds; who takes longer is asked once
VECTORS = (OURS, "HDF5 by hand", "Parquet by hand", ".npz", ".npy, mapped", "mcap", "foxglove-sdk")
STEPS = {"cartpole": 100_000, "floats": 100_000, "images": 1000, "dict": 10_000}
APPENDED = {"cartpole": 45, "floats": 1, "images": 1, "dict": 10}  # episodes, about 1,000 steps (images: 200)


@dataclass
class Cell:
    """Figures of a contender, one a round; or why there are none."""

    values: list[float] = field(default_factory=list)
    cannot: str = ""
    failed: str = ""

    @property
    def median(self) -> float:
        return statistics.median(self.values)


@dataclass
class Workbench:
    """The processes, what went on, and how much time there is."""

    run: Run
    processes: dict[str, Process]
    say: Callable[[str], None]
    fail: Callable[[str], None]
    rounds: int = 5
    build_seconds: float = 4.0
    record_seconds: float = 1.0
    workload_seconds: float = 190.0  # operations that begin later have one round
    growth_seconds: float = 200.0  # no further size begins after this
    operation_seconds: float = 10.0  # no further round of an operation begins after this
    loading: tuple[str, ...] = ()  # contenders whose epochs are measured; all if empty

    def measure(self, work: str) -> dict[str, Any]:
        """One workload: {"built": {contender: facts}, "cells": {operation: {contender: cell}}}."""
        return self._measure(work, STEPS[work], list(self.processes), list(OPERATIONS))

    def vectors(self) -> dict[str, Any]:
        """The same of a vector environment, by those who can record one."""
        names = [name for name in VECTORS if name in self.processes]
        return self._measure(VECTOR, 400_000, names, ["record", "size", "read"])

    def _measure(self, work: str, steps: int, names: list[str], operations: list[str]) -> dict[str, Any]:
        started = time.perf_counter()
        built: dict[str, Any] = {}
        cells: dict[str, dict[str, Cell]] = {operation: {} for operation in operations}
        paths = {name: self.run.fresh(f"{work}-{number}.mcap") for number, name in enumerate(names)}
        steps = self.run.part(steps, 250)
        for name in names:
            try:
                arguments = {
                    "work": work,
                    "path": str(paths[name]),
                    "steps": steps,
                    "seconds": self.build_seconds,
                }
                built[name] = self.processes[name].ask("build", 90, **arguments)
                cells["size"][name] = Cell([built[name]["bytes"]])
            except NoAnswerError as err:
                for operation in operations:
                    cells[operation][name] = Cell(**{err.why: str(err)})
                if err.why == "failed":
                    self.fail(f"{work}: {name} failed: {err}")
        self.say(f"{work}: building took {time.perf_counter() - started:.0f} s")
        for operation in operations:
            if operation != "size":
                began = time.perf_counter()
                rounds = self.rounds if began - started < self.workload_seconds else 1
                self._operation(operation, work, paths, steps, cells[operation], built, rounds)
                self.say(f"{work}: {operation} took {time.perf_counter() - began:.0f} s")
        for name, path in paths.items():
            if name in built:
                self._quietly(name, path)
        return {
            "built": built,
            "cells": {op: {name: asdict(cell) for name, cell in row.items()} for op, row in cells.items()},
        }

    def _quietly(self, name: str, path: Path) -> None:
        with contextlib.suppress(NoAnswerError):
            self.processes[name].ask("forget", path=str(path))

    def _operation(
        self,
        operation: str,
        work: str,
        paths: dict[str, Path],
        steps: int,
        cells: dict[str, Cell],
        built: Any,
        rounds: int,
    ) -> None:
        """Fills one column: a round that does not count, then as many as there are or as time permits."""
        began = time.perf_counter()
        sides, slow = list(built), set[str]()
        if operation.startswith("epoch") and self.loading:
            sides = [name for name in sides if name in self.loading]
        for name in sides:
            cells[name] = Cell()
        for number in range(rounds + 1):
            if number == 1:
                began = time.perf_counter()
            if number > 2 and time.perf_counter() - began > self.operation_seconds:
                break
            for name in sides if number % 2 else sides[::-1]:
                cell = cells[name]
                if cell.cannot or cell.failed or name in slow:
                    continue
                asked = time.perf_counter()
                try:
                    value = self._ask(name, operation, work, paths[name], steps)
                except NoAnswerError as err:
                    cells[name] = Cell(**{err.why: str(err)})
                    if err.why == "failed":
                        self.fail(f"{work}: {operation}: {name} failed: {err}")
                        self._again(name, work, paths[name], built)
                    continue
                if time.perf_counter() - asked > SLOW and number < rounds:
                    slow.add(name)  # this figure is all there will be
                if number or name in slow:
                    cell.values.append(value)
                if operation == "record" and (number or name in slow):
                    finishing = self.processes[name].ask("finishing")
                    if finishing:
                        built[name].setdefault("rollout", []).append(value - finishing)

    def _ask(self, name: str, operation: str, work: str, path: Path, steps: int) -> float:
        ask = self.processes[name].ask
        if operation == "record":
            other = str(path.with_name(f"recorded-{path.name}"))
            return float(ask("record", work=work, path=other, seconds=self.record_seconds, steps=steps))
        arguments: dict[str, Any] = {"work": work, "path": str(path)}
        if operation == "append":
            copy = str(path.with_name(f"more-{path.name}"))
            return float(ask("append", copy=copy, episodes=APPENDED[work], **arguments))
        if operation.startswith("epoch"):
            return float(
                ask("epoch", 90, workers=int(operation[-1]), seconds=self.record_seconds, **arguments)
            )
        return float(ask(operation, **arguments))

    def _again(self, name: str, work: str, path: Path, built: Any) -> None:
        """After a process has died, a new one builds the same anew."""
        if self.processes[name].alive:
            return
        try:
            self.processes[name].ask("forget", path=str(path))
            self.processes[name].ask("build", 90, work=work, path=str(path), steps=built[name]["steps"])
        except NoAnswerError as err:
            self.fail(f"{work}: {name} is out: {err}")


def grow(
    bench: Workbench, names: list[str], sizes: list[int], seconds: float
) -> dict[str, list[dict[str, float]]]:
    """Cost by number of steps; a contender grows no further when ten times the work would take too long."""
    found: dict[str, list[dict[str, float]]] = {}
    started = time.perf_counter()
    for name in names:
        process = bench.processes.get(name)
        if process is None:
            continue
        found[name] = []
        for steps in sizes:
            path = bench.run.fresh(f"grow-{steps}.mcap")
            began = time.perf_counter()
            try:
                found[name].append(process.ask("grow", 240, work="growth", path=str(path), steps=steps))
            except NoAnswerError as err:
                bench.fail(f"growth: {name} failed: {err}") if err.why == "failed" else bench.say(
                    f"growth: {name}: {err}"
                )
                break
            took = time.perf_counter() - began
            bench.say(f"growth: {name}, {steps:,} steps took {took:.1f} s")
            if name == OURS and not bench.run.quick:
                continue  # goes all the way
            if took * 10 > seconds or time.perf_counter() - started > bench.growth_seconds:
                break
        process.stop()  # and its memory with it: the next size is judged alone
    return found


def start(run: Run, names: list[str] | None) -> dict[str, Process]:
    """The processes of the contenders, none of them started yet."""
    return {name: Process(name, run.directory) for name in ENTRIES if not names or name in names}
