"""What a live view costs the rollout, in wall time: steps that it shows over steps of a recorder without one.

The viewers run in processes of their own, on the same machine. Virtual machines change their speed by a tenth from
one moment to the next, so two recorders take turns, in slices of some 20 ms: one with a view, and one without. In the
slices of the one without, the view is held in its rest, which then goes on where it stopped: put together, the slices
with the view are a rollout with a view, look by look, and what viewers do in the 10 ms after a look counts. A figure
is the median of several pairs of recorders; beside it is that of pairs without a view, which is 1 but for chance.

Left out are making the recorder, which imports what the viewer needs; the view's beginning (the panels are made and
sent, which costs about 0.2 s of a core, once); and closing, which waits until the viewer has the rest.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import socket
import statistics
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from tools.bench.measure import Run, alternate, check
from tools.bench.targets import Target, at_most
from tools.bench.workloads import SEED, WORKLOADS, Workload

_LIMIT = 1.10
_LISTENER = Path(__file__).with_name("listener.py")
_CONTROL = "no view, again"
_SLICE = 0.02  # seconds, at least
_SLICES = 75  # with the view, of a recorder
_AFTER = 0.01  # seconds after a look that are in the same slice
_HANDLE = 0.002  # seconds for the view's thread to see that it is held or let go
_WARM = 0.5  # seconds of steps before the first slice, at least
_LOOKS = 3  # of a view that has begun
_BEGINNING = 10.0  # seconds for that, at most


class _Place(NamedTuple):
    """Where a side's view goes, and whether somebody is there."""

    url: str
    connected: bool


class _Hold:
    """In place of the event that a session's thread rests on: rests pass only while the view may work."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._over = False
        self._free = True
        self._since = math.inf  # when it began to rest; infinite during a look
        self.looks = 0

    def let(self, free: bool) -> None:
        with self._changed:
            self._free = free
            self._changed.notify_all()
        time.sleep(_HANDLE)

    def rested(self, seconds: float) -> bool:
        """Whether the last look ended that long ago."""
        return time.perf_counter() - self._since >= seconds

    def none(self) -> None:
        """There is no view to hold."""
        self._since = -math.inf

    def set(self) -> None:
        with self._changed:
            self._over = True
            self._changed.notify_all()

    def wait(self, seconds: float) -> bool:
        with self._changed:
            self._since = time.perf_counter()
            while not self._over and (seconds > 0 or not self._free):
                began, passes = time.perf_counter(), self._free
                self._changed.wait(seconds if passes else None)
                if passes:
                    seconds -= time.perf_counter() - began
            self._since = math.inf
            self.looks += 1
            return self._over


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

    def slice(self, hold: _Hold | None = None) -> _Slice:
        """The next one, with the view that is held."""
        if hold is not None:
            hold.let(True)
        first, began = self.steps, time.perf_counter()
        seconds = 0.0
        while seconds < _SLICE or not (hold is None or hold.rested(_AFTER)):
            self.go_on()
            seconds = time.perf_counter() - began
        if hold is not None:
            hold.let(False)
        return _Slice(seconds, self.steps - first)


def live(run: Run) -> Iterator[Target]:
    """CartPole under a random policy, and an environment that returns a screen of 210 x 160 x 3 at once."""
    for name in ("cartpole", "images"):
        yield from compare(run, WORKLOADS[name])


def compare(run: Run, workload: Workload) -> Iterator[Target]:
    """All sides of a workload."""
    per_step: dict[str, list[float]] = {}

    def side(name: str, place: _Place | None) -> Callable[[], float]:
        def ratio() -> float:
            bare, watched = _slices(run, workload, place)
            per_step.setdefault(name, []).append(watched * 1e6)
            return watched / bare

        return ratio

    with _viewers() as places:
        values = alternate({name: side(name, place) for name, place in places.items()}, run.rounds)
    control = values.pop(_CONTROL)
    for name, found in values.items():
        figure = statistics.median(found)
        note = (
            f"{min(found):.2f} to {max(found):.2f}, {statistics.median(per_step[name]):.2f} µs a step; {_CONTROL}: "
            f"{statistics.median(control):.2f}, {min(control):.2f} to {max(control):.2f}"
        )
        yield at_most(f"live view of {workload.name}, {name}, over none", _LIMIT, figure, note, "x")


def _slices(run: Run, workload: Workload, place: _Place | None) -> tuple[float, float]:
    """Seconds per step of a recorder without a view, and of another with its view at work."""
    from tupli_mcap import RecordEpisodes

    bare_path, path, hold = run.fresh("bare.mcap"), run.fresh("live.mcap"), _Hold()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no viewer answers: that is one of the sides
        bare_env = RecordEpisodes(workload.make(), bare_path)
        env = RecordEpisodes(workload.make(), path, live=place and place.url)
        bare, watched = _Rollout(bare_env, workload), _Rollout(env, workload)
        _begin(bare, None, hold, None)
        _begin(watched, env._live, hold, place)
        hold.let(False)
        taken = [(bare.slice(), watched.slice(hold)) for _ in range(run.part(_SLICES))]
        bare_env.close()
        env.close()
    _check_steps(bare_path, bare.steps)
    _check_steps(path, watched.steps)
    return _per_step([one for one, _ in taken]), _per_step([other for _, other in taken])


def _check_steps(path: Path, steps: int) -> None:
    from tupli_mcap import Recording

    with Recording(path) as recording:
        check(recording.num_steps == steps, f"{recording.num_steps} steps instead of {steps}")
    path.unlink()


def _per_step(slices: list[_Slice]) -> float:
    """Seconds."""
    return sum(one.seconds for one in slices) / sum(one.steps for one in slices)


def _begin(rollout: _Rollout, session: Any, hold: _Hold, place: _Place | None) -> None:
    """Takes steps until the recorder is warm, the view has begun and whoever is to listen does."""
    warm = time.monotonic() + _WARM
    if place is None:
        hold.none()
    else:
        session._stopping = hold
    while time.monotonic() < warm:
        rollout.go_on()
    end = warm + _BEGINNING
    while place and not _has_begun(session, hold, place):
        check(time.monotonic() < end, "the view did not begin")
        rollout.go_on()


def _has_begun(session: Any, hold: _Hold, place: _Place) -> bool:
    return hold.looks >= _LOOKS and hold.rested(_AFTER) and _is_seen(session._view) == place.connected


def _is_seen(view: Any) -> bool:
    """Whether somebody takes what a view shows."""
    if hasattr(view, "_stream"):
        return view._stream is not None
    return any(channel.has_sinks() for channel in list(view._channels.values()))


@contextlib.contextmanager
def _viewers() -> Iterator[dict[str, _Place | None]]:
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
        yield {
            "Rerun, connected": _Place(f"rerun+http://127.0.0.1:{ports[0]}/proxy", connected=True),
            "Rerun, no viewer": _Place(f"rerun+http://127.0.0.1:{ports[1]}/proxy", connected=False),
            "Foxglove, connected": _Place(f"ws://127.0.0.1:{ports[2]}", connected=True),
            "Foxglove, nobody there": _Place(f"ws://127.0.0.1:{ports[3]}", connected=False),
            _CONTROL: None,
        }


def _end(process: subprocess.Popen[bytes]) -> None:
    import os
    import signal

    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
