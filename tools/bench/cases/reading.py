"""Reading beside its floor, windows of recordings just opened, listing, and rows that nothing compresses."""

from __future__ import annotations

import shutil
import statistics
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench import floor
from tools.bench.contenders.mcap import Mcap
from tools.bench.contenders.ours import Ours, leaves
from tools.bench.data import Data, check_same
from tools.bench.epochs import places_of
from tools.bench.measure import Run, Stopwatch, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_least, at_most
from tools.bench.workloads import WORKLOADS, reference

FIELDS = {
    "states": "state",
    "actions": "action",
    "rewards": "reward",
    "terminals": "terminal",
    "timeouts": "timeout",
}


def _recorded(run: Run, work: str, steps: int) -> tuple[Path, Data]:
    path, data = run.fresh(f"{work}.mcap"), reference(work, steps)
    Ours().record(WORKLOADS[work], path, len(data.lengths))
    return path, data


def floor_speed(run: Run) -> Iterator[Target]:
    """Decompressing the same chunks and copying them with strides, with the same threads, checking nothing."""
    path, data = _recorded(run, "cartpole", run.part(1_000_000))
    chunks = floor.locate(path)
    sides: dict[str, Callable[[], float]] = {}
    for threads in (1, 2):
        sides[f"ours {threads}"] = partial(_ours, path, data, threads)
        sides[f"floor {threads}"] = partial(_floor, chunks, data, threads)
    alternate(sides, 1)
    values = alternate(sides, max(run.rounds, 5))
    for threads in (1, 2):
        mine, under = values[f"ours {threads}"], values[f"floor {threads}"]
        note = f"{statistics.median(mine):.1f} of {statistics.median(under):.1f} M steps/s, CRCs checked"
        what = f"CartPole to NumPy, {threads} thread{'s' * (threads > 1)}, over zstd and strided copies"
        yield at_least(what, 0.7, ratio(mine, under), note, "x")


def over_mcap(run: Run) -> Iterator[Target]:
    """All steps with as many threads as it takes by itself, over `iter_messages` of a file of the `mcap` package."""
    path, data = _recorded(run, "cartpole", run.part(1_000_000))
    package, other = Mcap(), run.fresh("mcap.mcap")
    package.write(other, data)

    def theirs() -> float:
        found: list[Any] = []
        seconds = seconds_of(lambda: found.append(package.read(other)))
        check_same(found[0][0], data.leaves)
        return data.steps / seconds / 1e6

    sides: dict[str, Callable[[], float]] = {"ours": partial(_ours, path, data, None), "mcap": theirs}
    alternate(sides, 1)
    values = alternate(sides, max(run.rounds, 3))
    mine, package_speed = statistics.median(values["ours"]), statistics.median(values["mcap"])
    note = f"{mine:.1f} of {package_speed:.3f} M steps/s"
    what = f"CartPole to NumPy, {data.steps / 1e6:.1g} M steps, over mcap"
    yield at_least(what, 50, ratio(values["ours"], values["mcap"]), note, "x")


def _ours(path: Path, data: Data, threads: int | None) -> float:
    from tupli_mcap import Recording

    found: list[Any] = []

    def read() -> None:
        with Recording(path) as recording:
            found.append(recording.read(threads=threads))

    seconds = seconds_of(read)
    check_same(leaves(found[0]), data.leaves)
    return data.steps / seconds / 1e6


def _floor(chunks: floor.Chunks, data: Data, threads: int) -> float:
    found: list[Any] = []
    seconds = seconds_of(lambda: found.append(floor.read(chunks, tuple(FIELDS.values()), threads)))
    check_same(dict(zip(FIELDS, found[0], strict=True)), data.leaves)
    return data.steps / seconds / 1e6


def cold_windows(run: Run) -> Iterator[Target]:
    """A window of a recording just opened, against Minari's best, whose dataset is open."""
    from tools.bench.contenders import ENTRIES
    from tools.bench.fleet import NoAnswerError, Process
    from tupli_mcap import Recording

    path, data = _recorded(run, "floats", run.part(1_000_000, 4000))
    watch, count = Stopwatch(), 50
    places = places_of(data, 32, 1)
    for episode, start in places[np.random.default_rng().integers(0, len(places), count)].tolist():
        with Recording(path) as recording:
            with watch:
                found = leaves(recording.episodes[episode][start : start + 32])
            check_same(found, data.rows(episode, start, 32))
    mine = watch.seconds / count * 1e6
    theirs = {}
    for name in (name for name in ENTRIES if name.startswith("Minari")):
        process = Process(name, run.directory)
        try:
            arguments = {"work": "floats", "path": str(run.fresh(name.replace(" ", "-")))}
            process.ask("build", steps=run.part(50_000, 3000), **arguments)
            theirs[name] = min(process.ask("window", **arguments) for _ in range(3))
        except NoAnswerError:
            continue
        finally:
            process.stop()
    what = "window of 32 steps in 1 M, recording just opened, over Minari's best"
    if not theirs:
        yield at_most(what, 1, None, "Minari is not installed")
        return
    best = min(theirs, key=lambda name: theirs[name])
    yield at_most(what, 1, mine / theirs[best], f"{mine:.0f} µs; {best} {theirs[best]:.0f} µs")


def listing(run: Run) -> Iterator[Target]:
    """Open a recording of many episodes and go through them, with the step chunks blanked, too."""
    from tupli_mcap import Recording

    episodes = run.part(100_000)
    path, data = _recorded(run, "growth", 22 * episodes)
    blanked = run.fresh("blanked.mcap")
    shutil.copy(path, blanked)
    with blanked.open("r+b") as stream:
        for start, size, *_ in floor.locate(blanked).places:
            stream.seek(start)
            stream.write(bytes(size))

    def listed(path: Path) -> list[tuple[int, int, float, str]]:
        with Recording(path) as recording:
            return [(e.number, len(e), e.return_, e.end) for e in recording.episodes]

    found = listed(path)
    check(listed(blanked) == found, "another listing where the step chunks are zeros")
    check([length for _, length, _, _ in found] == data.lengths.tolist(), "other lengths")
    check(np.allclose([total for _, _, total, _ in found], data.returns), "other returns")
    values = [seconds_of(lambda: listed(path)) for _ in range(3)]
    note = "the same with the step chunks blanked: none is decompressed"
    yield at_most(f"open and list {episodes:,} episodes", 1, statistics.median(values), note, "s")


def incompressible(run: Run) -> Iterator[Target]:
    """Rows of 256 bytes of noise: the file over the rows, and what the message indexes take of it."""
    path, data = _recorded(run, "noise", run.part(40_000, 4000))
    check_same(leaves_of(path), data.leaves)
    raw = data.leaves["states"].nbytes
    size, parts = path.stat().st_size, _bytes_of_records(path)
    index = parts[0x07] / data.steps
    note = (
        f"{size / data.steps:.0f} bytes a step, of which message indexes {index:.1f} ({parts[0x07] / size:.1%}); "
        f"{path.stat().st_blocks * 512 / data.steps:.0f} allocated"
    )
    yield at_most("size of 256 incompressible bytes a step, over these bytes", 1.3, size / raw, note, "x")


def leaves_of(path: Path) -> dict[str, Any]:
    """All of a recording."""
    return Ours().read(path)[0]


def _bytes_of_records(path: Path) -> Counter[int]:
    """Bytes of the records outside of chunks, by opcode."""
    found: Counter[int] = Counter()
    with path.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(9)) == 9:
            length = int.from_bytes(head[1:], "little")
            found[head[0]] += 9 + length
            stream.seek(length, 1)
    return found
