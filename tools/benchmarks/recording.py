"""Recording overhead per step over a no-op `gymnasium.Wrapper`, and the size of the files."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import gymnasium as gym

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
from benchmarks.workloads import Columns, Workload, cartpole, floats, small, small_vector


@dataclass
class Side:
    """A recorder: `record(episodes)` returns seconds and steps, after checking what it recorded."""

    does: str
    record: Callable[[int], tuple[float, int]]
    steps: int
    target: float | None = None
    needs: tuple[str, ...] = ()
    finishing: list[float] = field(default_factory=list)  # µs per step of a further act, one a run


def _noop_seconds(workload: Workload, episodes: int) -> float:
    """Seconds per step of the same rollout through a wrapper that does nothing."""
    env = gym.Wrapper(workload.make())
    steps = 0

    def rollout() -> None:
        nonlocal steps
        steps = workload.rollout(env, episodes)
        env.close()

    return seconds_of(rollout) / steps


def _overhead(workload: Workload, side: Side, reference: Columns) -> float:
    """Microseconds per step that the side adds; the no-op rollout runs just before and just after it."""
    episodes = reference.episodes_for(side.steps)
    before = _noop_seconds(workload, episodes)
    seconds, steps = side.record(episodes)
    after = _noop_seconds(workload, episodes)
    return (seconds / steps - (before + after) / 2) * 1e6


def _compare(
    case: str, workload: Workload, sides: dict[str, Side], reference: Columns, rounds: int
) -> Iterator[Line]:
    """Warm every side up, measure all in alternation, and report ours over each."""
    present = {name: side for name, side in sides.items() if not peers.missing(side.needs)}
    for side in present.values():
        side.record(2)
    values = alternate(
        {name: partial(_overhead, workload, side, reference) for name, side in present.items()}, rounds
    )
    for name, side in sides.items():
        if name not in present:
            yield Line(case, name, side.does, "µs/step", note=INSTALL_PEERS)
            continue
        does = f"{side.does}; {reference.episodes_for(side.steps):,} episodes"
        if name == OURS:
            yield Line(case, name, does, "µs/step", values[name])
            continue
        found = ratio(values[OURS], values[name])
        target, met = at_most(side.target) if side.target is not None else ("", None)
        yield Line(case, name, does, "µs/step", values[name], found, target, met and met(found))
        if side.finishing:
            total = [a + b for a, b in zip(values[name], side.finishing[-rounds:], strict=True)]
            does = "the same and create_dataset"
            yield Line(case, f"{name}, finished", does, "µs/step", total, ratio(values[OURS], total))


def _ours(run: Run, workload: Workload, reference: Columns) -> Side:
    def record(episodes: int) -> tuple[float, int]:
        path = run.fresh("ours.mcap")
        seconds, steps = ours.record(workload, path, episodes)
        with naming(OURS):
            ours.check_recording(path, reference.head(episodes))
        path.unlink()
        return seconds, steps

    return Side("RecordEpisodes, zstd", record, run.steps)


def _minari(run: Run, workload: Workload, fmt: str, steps: int, target: float | None) -> Side:
    finishing: list[float] = []

    def record(episodes: int) -> tuple[float, int]:
        home = run.fresh(f"minari-{fmt}")
        rollout, create, steps, dataset = peers.record_minari(workload, home, fmt, episodes)
        finishing.append(create / steps * 1e6)
        with naming(f"Minari {fmt}"):
            peers.check_minari(workload, dataset, steps)
        shutil.rmtree(home)
        return rollout, steps

    does = f"DataCollector(data_format={fmt!r})"
    return Side(does, record, steps, target, peers.MINARI_NEEDS[fmt], finishing)


def _pytupli(run: Run, workload: Workload, reference: Columns, steps: int) -> Side:
    def record(episodes: int) -> tuple[float, int]:
        home = run.fresh("pytupli")
        seconds, steps, storage = peers.record_pytupli(workload, home, episodes)
        with naming("PyTupli"):
            peers.check_pytupli(storage, reference.head(episodes))
        shutil.rmtree(home)
        return seconds, steps

    return Side("TupliEnvWrapper, FileStorage", record, steps, 1 / 12, peers.PYTUPLI_NEEDS)


def _mcap(run: Run, workload: Workload, reference: Columns) -> Side:
    sample = run.fresh("messages.mcap")
    ours.record(workload, sample, reference.episodes_for(run.steps))
    schema, messages = peers.step_messages(sample, run.steps * 2)
    sample.unlink()

    def record(episodes: int) -> tuple[float, int]:
        path = run.fresh("bare.mcap")
        seconds, steps = peers.record_mcap(workload, path, schema, messages, episodes)
        if episodes <= 2:  # reading it all back with the mcap package would take longer than everything else
            check(peers.step_messages(path, steps)[1] == messages[:steps], "mcap: other messages")
        path.unlink()
        return seconds, steps

    return Side("bare Writer.add_message of our messages, zstd", record, run.steps, 0.40)


def record_cartpole(run: Run) -> Iterator[Line]:
    """CartPole-v1, random policy: episodes of about 22 steps, everything counted."""
    workload = cartpole(run.steps * 2)
    reference = workload.reference(run.steps)
    sides = {
        OURS: _ours(run, workload, reference),
        "mcap Writer": _mcap(run, workload, reference),
        "PyTupli": _pytupli(run, workload, reference, run.steps // 5),
        "Minari HDF5": _minari(run, workload, "hdf5", run.steps // 10, 1 / 60),
    }
    yield from _compare("record CartPole", workload, sides, reference, run.rounds)


def record_floats(run: Run) -> Iterator[Line]:
    """17 float64 in, 6 float32 out, episodes of 1000 steps."""
    workload = floats()
    reference = workload.reference(run.steps)
    formats = {"Minari HDF5": "hdf5", "Minari Arrow": "arrow", "Minari Parquet": "parquet"}
    sides = {OURS: _ours(run, workload, reference)}
    sides |= {name: _minari(run, workload, fmt, run.steps // 10, 1 / 12) for name, fmt in formats.items()}
    yield from _compare("record 17+6 floats", workload, sides, reference, run.rounds)


def record_vector(run: Run) -> Iterator[Line]:
    """64 sub-environments, per env-step, over the single environment of the same layout."""
    for length, limit in ((1000, 0.3), (22, 0.5)):
        yield from _record_vector(run, length, limit)


def _record_vector(run: Run, length: int, limit: float, num_envs: int = 64) -> Iterator[Line]:
    workload = small(length)
    reference = workload.reference(run.steps)
    single = _ours(run, workload, reference)
    make, actions = small_vector(length, num_envs)
    steps = max(run.steps * 4 // num_envs, 2 * length)

    def noop() -> float:
        env = gym.vector.VectorWrapper(make())
        return seconds_of(lambda: ours.rollout_vector(env, actions, steps))

    def vector() -> float:
        path = run.fresh("vector.mcap")
        before = noop()
        seconds = ours.record_vector(make, actions, path, steps)
        after = noop()
        env_steps = ours.check_vector(make, actions, path, steps)
        path.unlink()
        return (seconds - (before + after) / 2) / env_steps * 1e6

    vector()
    sides = {"single": lambda: _overhead(workload, single, reference), "vector": vector}
    values = alternate(sides, run.rounds)
    case = f"record vector, {length}-step episodes"
    target, met = at_most(limit, "vector/single")
    found = ratio(values["vector"], values["single"])
    yield Line(case, "single", f"RecordEpisodes, {reference.steps:,} steps", "µs/step", values["single"])
    does = f"vector.RecordEpisodes, {num_envs} sub-environments, {steps:,} vector steps"
    yield Line(case, "vector", does, "µs/env-step", values["vector"], found, target, met(found))


def file_size(run: Run) -> Iterator[Line]:
    """Bytes per step, CartPole, everything in the recording or dataset counted."""
    case, unit = "file size CartPole", "bytes/step"
    workload = cartpole(run.steps)
    path = run.fresh("size.mcap")
    _, steps = ours.record(workload, path, workload.reference(run.steps).episodes_for(run.steps))
    mine = _sizes(path, steps)
    does = f"zstd, {steps:,} steps ({mine[1]:.0f} allocated on disk)"
    yield Line(case, OURS, does, unit, mine[:1])
    found: dict[str, tuple[float, float]] = {}
    for fmt in ("hdf5", "arrow", "parquet"):
        if peers.missing(peers.MINARI_NEEDS[fmt]):
            yield Line(case, f"Minari {fmt}", "", unit, note=INSTALL_PEERS)
            continue
        home = run.fresh(f"size-{fmt}")
        episodes = 500 if fmt == "hdf5" else 100  # the others take milliseconds a step
        _, _, steps, _ = peers.record_minari(workload, home, fmt, episodes)
        found[fmt] = _sizes(home, steps)
        does = f"{steps:,} steps ({found[fmt][1]:.0f} allocated on disk)"
        yield Line(case, f"Minari {fmt}", does, unit, found[fmt][:1], mine[0] / found[fmt][0])
    for number, does in enumerate(("sum of the files' lengths", "blocks allocated on disk")):
        if found:
            smallest = min(found, key=lambda fmt: found[fmt][number])
            target, met = at_most(1 / 4, f"ours/Minari {smallest}")
            share = mine[number] / found[smallest][number]
            sizes = [found[smallest][number]]
            yield Line(case, "smallest Minari", does, unit, sizes, share, target, met(share))


def _sizes(path: Path, steps: int) -> tuple[float, float]:
    """Bytes per step of a file or a directory: lengths of the files, and what the disk allocates."""
    files = [file.stat() for file in (path.rglob("*") if path.is_dir() else [path]) if file.is_file()]
    return sum(file.st_size for file in files) / steps, sum(file.st_blocks * 512 for file in files) / steps
