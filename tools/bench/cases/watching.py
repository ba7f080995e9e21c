"""What a live view costs the rollout, in wall time: steps that it shows over steps of a recorder without one.

The view and the viewers run in processes of their own, on the same machine. Virtual machines change their speed by a
tenth from one moment to the next, so two recorders take turns, in slices of a second: one with a view, and one
without. In the slices of the one without, the view's process is stopped. A figure is the median of several pairs of
recorders; beside it is that of pairs without a view, which is 1 but for chance, and what the view's process takes of a
core.

Left out is the view's beginning (its process imports what it needs, the panels are made and sent, which costs about a
second of a core, once), and closing, which waits until the viewer has the rest.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tools.bench.measure import Run, alternate, check
from tools.bench.targets import Target, at_most
from tools.bench.workloads import SEED, WORKLOADS, Workload

_LIMIT = 1.10
_LISTENER = Path(__file__).with_name("listener.py")
_CONTROL = "no view, again"
_SLICE = 1.0  # seconds
_SLICES = 5  # with the view, of a recorder
_WARM = 3.0  # seconds of steps before the first slice, at least: the view's process starts
_BEGINNING = 30.0  # seconds for that, at most
_ESTABLISHED = "01"


class _ViewPlace(NamedTuple):
    """Where a side's view goes, and whether somebody is there."""

    url: str
    port: int
    connected: bool


class _Slice(NamedTuple):
    seconds: float
    steps: int


class _Rollout:
    """The ordinary loop, a few steps at a time."""

    def __init__(self, env: Any, workload: Workload) -> None:
        self._env = env
        self._next_action = itertools.cycle(list(workload.actions)).__next__
        self._at_once = 100 if workload.table is None else 20
        self.steps = 0
        env.reset(seed=SEED)

    def go_on(self) -> None:
        step, next_action = self._env.step, self._next_action
        for _ in range(self._at_once):
            _, _, terminal, timeout, _ = step(next_action())
            if terminal or timeout:
                self._env.reset()
        self.steps += self._at_once

    def slice(self) -> _Slice:
        """The next one."""
        first, began = self.steps, time.perf_counter()
        while (seconds := time.perf_counter() - began) < _SLICE:
            self.go_on()
        return _Slice(seconds, self.steps - first)


def live(run: Run) -> Iterator[Target]:
    """CartPole under a random policy, and an environment that returns a screen of 210 x 160 x 3 at once."""
    for name in ("cartpole", "images"):
        yield from compare(run, WORKLOADS[name])


def compare(run: Run, workload: Workload) -> Iterator[Target]:
    """All sides of a workload."""
    per_step: dict[str, list[float]] = {}
    cores: dict[str, list[float]] = {}

    def side(name: str, place: _ViewPlace | None) -> Callable[[], float]:
        def ratio() -> float:
            bare, watched, core = _slices(run, workload, place)
            per_step.setdefault(name, []).append(watched * 1e6)
            cores.setdefault(name, []).append(core)
            return watched / bare

        return ratio

    with _viewers() as places:
        values = alternate({name: side(name, place) for name, place in places.items()}, run.rounds)
    control = values.pop(_CONTROL)
    for name, found in values.items():
        figure = statistics.median(found)
        note = (
            f"{min(found):.2f} to {max(found):.2f}, {statistics.median(per_step[name]):.2f} µs a step, "
            f"{statistics.median(cores[name]):.1%} of a core; {_CONTROL}: "
            f"{statistics.median(control):.2f}, {min(control):.2f} to {max(control):.2f}"
        )
        yield at_most(f"live view of {workload.name}, {name}, over none", _LIMIT, figure, note, "x")


def _slices(run: Run, workload: Workload, place: _ViewPlace | None) -> tuple[float, float, float]:
    """Seconds per step of a recorder without a view, and of another with its view at work; and how much of a core the
    view's process takes meanwhile."""
    from tupli_mcap import RecordEpisodes

    bare_path, path = run.fresh("bare.mcap"), run.fresh("live.mcap")
    bare_env = RecordEpisodes(workload.make(), bare_path)
    env = RecordEpisodes(workload.make(), path, live=place and place.url)
    bare, watched = _Rollout(bare_env, workload), _Rollout(env, workload)
    view = None if place is None else env._live.process.pid
    _begin(bare, None)
    _begin(watched, place)
    taken, before = [], _cpu_seconds(view)
    for _ in range(run.part(_SLICES)):
        _signal(view, signal.SIGSTOP)
        one = bare.slice()
        _signal(view, signal.SIGCONT)
        taken.append((one, watched.slice()))
    busy = _cpu_seconds(view) - before
    bare_env.close()
    env.close()
    _check_steps(bare_path, bare.steps)
    _check_steps(path, watched.steps)
    with_view = [other for _, other in taken]
    return (
        _per_step([one for one, _ in taken]),
        _per_step(with_view),
        busy / sum(one.seconds for one in with_view),
    )


def _signal(process: int | None, number: int) -> None:
    if process is not None:
        os.kill(process, number)


def _cpu_seconds(process: int | None) -> float:
    """CPU time of a process."""
    if process is None:
        return 0.0
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _check_steps(path: Path, steps: int) -> None:
    from tupli_mcap import Recording

    with Recording(path) as recording:
        check(recording.n_steps == steps, f"{recording.n_steps} steps instead of {steps}")
    path.unlink()


def _per_step(slices: list[_Slice]) -> float:
    """Seconds."""
    return sum(one.seconds for one in slices) / sum(one.steps for one in slices)


def _begin(rollout: _Rollout, place: _ViewPlace | None) -> None:
    """Takes steps until the recorder is warm, the view has begun and whoever is to listen does."""
    warm = time.monotonic() + _WARM
    while time.monotonic() < warm:
        rollout.go_on()
    end = warm + _BEGINNING
    while place is not None and place.connected and not _is_connected(place.port):
        check(time.monotonic() < end, "the view did not begin")
        rollout.go_on()


def _is_connected(port: int) -> bool:
    """Whether somebody is connected to a port of this machine, and not only to look whether it answers."""
    for _ in range(2):
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        if not any(row[1].endswith(f":{port:04X}") and row[3] == _ESTABLISHED for row in rows):
            return False
        time.sleep(0.1)
    return True


@contextlib.contextmanager
def _viewers() -> Iterator[dict[str, _ViewPlace | None]]:
    """By side, where its view goes; what is connected is listened to for as long as the context lasts."""
    ports = [_free_port() for _ in range(4)]
    rerun = [sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1"]
    commands = [
        [*rerun, "--port", str(ports[0]), "--server-memory-limit", "256MB"],
        [sys.executable, str(_LISTENER), str(ports[2])],
    ]
    quiet = subprocess.DEVNULL
    with contextlib.ExitStack() as stack:
        for command in commands:
            process = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
            stack.callback(_end, process)
        time.sleep(3.0)
        rerun_urls = [f"rerun+http://127.0.0.1:{port}/proxy" for port in ports[:2]]
        yield {
            "Rerun, connected": _ViewPlace(rerun_urls[0], ports[0], connected=True),
            "Rerun, no viewer": _ViewPlace(rerun_urls[1], ports[1], connected=False),
            "Foxglove, connected": _ViewPlace(f"ws://127.0.0.1:{ports[2]}", ports[2], connected=True),
            "Foxglove, nobody there": _ViewPlace(f"ws://127.0.0.1:{ports[3]}", ports[3], connected=False),
            _CONTROL: None,
        }


def _end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
