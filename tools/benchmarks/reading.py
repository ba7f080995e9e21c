"""Reading to NumPy, random windows, and opening and listing."""

from __future__ import annotations

import shutil
import statistics
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from benchmarks import floor, ours, peers
from benchmarks.measure import (
    INSTALL_PEERS,
    OURS,
    Line,
    Run,
    Stopwatch,
    alternate,
    at_least,
    at_most,
    check,
    naming,
    ratio,
    seconds_of,
)
from benchmarks.workloads import Columns, cartpole, floats, small

WINDOW = 32
WINDOWS = 200


def read_cartpole(run: Run) -> Iterator[Line]:
    """The whole recording to columns, CRCs checked, opening counted."""
    workload = cartpole(run.read_steps)
    path = run.fresh("read.mcap")
    reference = ours.record_with_reference(workload, path, run.read_steps)
    chunks = floor.locate(path)
    sides: dict[str, Callable[[], float]] = {}
    for threads in (1, 2):
        sides[f"{OURS}, threads={threads}"] = partial(_ours_speed, path, reference, threads)
        sides[f"floor, threads={threads}"] = partial(_floor_speed, chunks, reference, threads)
    values = alternate(sides, max(run.rounds, 5))
    case, unit = "read CartPole", "M steps/s"
    for threads in (1, 2):
        mine, under = values[f"{OURS}, threads={threads}"], values[f"floor, threads={threads}"]
        does = f"Recording.read(threads={threads}), {reference.steps:,} steps"
        yield Line(case, f"{OURS}, threads={threads}", does, unit, mine)
        target, met = at_least(0.7)
        found = ratio(mine, under)
        does = f"zstd and strided copy of the same chunks, threads={threads}, no checks"
        yield Line(case, f"floor, threads={threads}", does, unit, under, found, target, met(found))
    yield from _slow_readers(run, case, path, reference, statistics.median(values[f"{OURS}, threads=1"]))


def _ours_speed(path: Path, reference: Columns, threads: int) -> float:
    found: list[Any] = []
    seconds = seconds_of(lambda: found.append(ours.read(path, threads)))
    with naming(OURS):
        ours.check_columns(found[0], reference)
    return reference.steps / seconds / 1e6


def _floor_speed(chunks: floor.Chunks, reference: Columns, threads: int) -> float:
    found: list[Any] = []
    fields = ("state", "action", "reward", "terminal", "timeout")
    seconds = seconds_of(lambda: found.append(floor.read(chunks, fields, threads)))
    with naming("floor"):
        for name, column in zip(ours.COLUMNS, found[0], strict=True):
            check(np.array_equal(column, getattr(reference, name)), f"other {name}")
    return reference.steps / seconds / 1e6


def _slow_readers(run: Run, case: str, path: Path, reference: Columns, mine: float) -> Iterator[Line]:
    """Readers too slow for the whole recording: fewer steps, which is kinder to them, and speed per step."""
    rounds = max(run.rounds // 2, 2)
    steps = max(run.read_steps // 10, 2000)

    def mcap() -> float:
        count = 0

        def iterate() -> None:
            nonlocal count
            with path.open("rb") as stream:
                messages = make_reader(stream).iter_messages(topics=["/step"], log_time_order=False)
                count = sum(1 for _ in messages)

        seconds = seconds_of(iterate)
        check(count == reference.steps, f"mcap: {count} messages")
        return count / seconds / 1e6

    yield _slow(
        case,
        "mcap",
        f"iter_messages(log_time_order=False), undecoded, {reference.steps:,} steps",
        mcap,
        2,
        mine,
        50,
    )
    side = "PyTupli"
    if peers.missing(peers.PYTUPLI_NEEDS):
        yield Line(case, side, "TupliDataset.load, convert_to_tensors", "M steps/s", note=INSTALL_PEERS)
    else:
        episodes = reference.episodes_for(steps)
        home = run.fresh("pytupli")
        _, recorded, storage = peers.record_pytupli(cartpole(run.read_steps), home, episodes)
        peers.check_pytupli(storage, reference.head(episodes))
        does = f"TupliDataset.load, convert_to_tensors, {recorded:,} steps"
        read = _reader(lambda: peers.read_pytupli(storage), recorded)
        yield _slow(case, side, does, read, rounds, mine, 100)
        shutil.rmtree(home)
    for fmt, limit, part in (("hdf5", 10, 5), ("arrow", None, 100)):
        side = f"Minari {fmt}"
        if peers.missing(peers.MINARI_NEEDS[fmt]):
            yield Line(case, side, "iterate_episodes, concatenate", "M steps/s", note=INSTALL_PEERS)
            continue
        home = run.fresh(f"minari-{fmt}")
        workload = cartpole(run.read_steps)
        episodes = reference.episodes_for(steps // part)
        _, _, recorded, dataset = peers.record_minari(workload, home, fmt, episodes)
        peers.check_minari(workload, dataset, recorded)
        does = f"iterate_episodes, concatenate, {recorded:,} steps"
        read = _reader(partial(peers.read_minari, dataset), recorded)
        yield _slow(case, side, does, read, rounds, mine, limit)
        shutil.rmtree(home)


def _reader(read: Callable[[], object], steps: int) -> Callable[[], float]:
    return lambda: steps / seconds_of(read) / 1e6


def _slow(
    case: str, side: str, does: str, speed: Callable[[], float], rounds: int, mine: float, limit: float | None
) -> Line:
    values = [speed() for _ in range(rounds)]
    found = mine / statistics.median(values)
    target, met = at_least(limit) if limit is not None else ("", None)
    return Line(case, side, does, "M steps/s", values, found, target, met and met(found))


def window(run: Run) -> Iterator[Line]:
    """32 steps at a random place, 17+6 floats in episodes of 1000 steps."""
    workload = floats()
    path = run.fresh("window.mcap")
    reference = ours.record_with_reference(workload, path, run.read_steps)
    fewer = max(run.read_steps // 20, 2000)
    home = run.fresh("minari-window")
    sides: dict[str, Callable[[], float]] = {}
    does: dict[str, str] = {}
    warm = _WarmWindows(path, reference)
    sides[f"{OURS} warm"] = warm
    does[f"{OURS} warm"] = f"a slice of an episode of {reference.steps:,} steps, chunks decoded before"
    sides[f"{OURS} cold"] = lambda: _cold_windows(path, reference)
    does[f"{OURS} cold"] = (
        f"the same from a recording just opened, {path.stat().st_size / 1e6:.0f} MB in the page cache"
    )
    for fmt in ("hdf5", "arrow", "parquet"):
        if not peers.missing(peers.MINARI_NEEDS[fmt]):
            _, _, steps, dataset = peers.record_minari(workload, home / fmt, fmt, fewer // 1000)
            sides[f"Minari {fmt}"] = partial(_minari_windows, dataset, reference)
            does[f"Minari {fmt}"] = f"dataset[i], sliced, {steps:,} steps"
    values = alternate(sides, run.rounds)
    warm.close()
    for fmt in ("hdf5", "arrow", "parquet"):
        if f"Minari {fmt}" not in sides:
            yield Line("window", f"Minari {fmt}", "", "ms", note=INSTALL_PEERS)
    theirs = min(
        (name for name in sides if name.startswith("Minari")), key=lambda n: min(values[n]), default=""
    )
    for name in sides:
        limit = {f"{OURS} warm": 0.1, f"{OURS} cold": 1.0}.get(name)
        if limit is None or not theirs:
            yield Line("window", name, does[name], "ms", values[name])
            continue
        target, met = at_most(limit, f"this/{theirs}")
        found = ratio(values[name], values[theirs])
        yield Line("window", name, does[name], "ms", values[name], found, target, met(found))
    shutil.rmtree(home, ignore_errors=True)


def _places(episodes: int) -> list[tuple[int, int]]:
    rng = np.random.default_rng()
    return list(
        zip(rng.integers(0, episodes, WINDOWS).tolist(), rng.integers(0, 969, WINDOWS).tolist(), strict=True)
    )


def _check_window(found: Any, reference: Columns, episode: int, start: int) -> None:
    rows = slice(episode * 1000 + start, episode * 1000 + start + WINDOW)
    wanted = [getattr(reference, name)[rows] for name in ours.COLUMNS]
    check(all(np.array_equal(a, b) for a, b in zip(found, wanted, strict=True)), "another window")


class _WarmWindows:
    """Windows from one open recording; before the first timing every chunk has been decoded once."""

    def __init__(self, path: Path, reference: Columns) -> None:
        from tupli_mcap import Recording

        self._recording = Recording(path)
        self._reference = reference
        for episode in range(len(self._recording.episodes)):
            ours.window(self._recording, episode, 0, len(self._recording.episodes[episode]))

    def __call__(self) -> float:
        watch = Stopwatch()
        for episode, start in _places(len(self._recording.episodes)):
            with watch:
                found = ours.window(self._recording, episode, start, WINDOW)
            _check_window(found, self._reference, episode, start)
        return watch.seconds / WINDOWS * 1e3

    def close(self) -> None:
        self._recording.close()


def _cold_windows(path: Path, reference: Columns) -> float:
    from tupli_mcap import Recording

    watch = Stopwatch()
    for episode, start in _places(len(reference.episode_lengths)):
        with Recording(path) as recording:  # opening is not counted: Minari's dataset is open, too
            with watch:
                found = ours.window(recording, episode, start, WINDOW)
            _check_window(found, reference, episode, start)
    return watch.seconds / WINDOWS * 1e3


def _minari_windows(dataset: Any, reference: Columns) -> float:
    watch = Stopwatch()
    for number, start in _places(len(dataset)):
        rows = slice(start, start + WINDOW)
        with watch:
            episode = dataset[number]
            found = (
                episode.observations[rows],
                episode.actions[rows],
                episode.rewards[rows],
                episode.terminations[rows],
                episode.truncations[rows],
            )
        with naming("Minari"):
            _check_window(found, reference, number, start)
    return watch.seconds / WINDOWS * 1e3


def listing(run: Run) -> Iterator[Line]:
    """Open a recording of many episodes and list them: number, length, return, end, seed."""
    workload = small(3)
    path = run.fresh("list.mcap")
    ours.record(workload, path, run.episodes)
    blanked = run.fresh("blanked.mcap")
    shutil.copy(path, blanked)
    _blank_chunks(blanked)
    wanted = [(number, 3, 3.0, "timeout") for number in range(run.episodes)]
    for source, name in ((path, "listing"), (blanked, "listing a copy whose step chunks are zeros")):
        with naming(name):
            check(ours.list_episodes(source) == wanted, "other episodes")
    seconds = [seconds_of(lambda: ours.list_episodes(path)) for _ in range(max(run.rounds, 3))]
    columns = [seconds_of(lambda: ours.list_columns(path)) for _ in range(max(run.rounds, 3))]
    limit = statistics.median(seconds)
    does = f"open, iterate {run.episodes:,} Episode objects; works with the step chunks blanked"
    yield Line("list", OURS, does, "s", seconds, None, "median <= 1 s", limit <= 1)
    yield Line("list", f"{OURS}, index", "open, Recording.index as columns", "s", columns)


def _blank_chunks(path: Path) -> None:
    """Overwrite the compressed rows of every chunk of `/step` with zeros."""
    with path.open("r+b") as stream:
        for start, size, *_ in floor.locate(path).places:
            stream.seek(start)
            stream.write(bytes(size))
