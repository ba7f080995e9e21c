"""What a live view costs the rollout: recording with one over recording without, viewers connected and not.

The viewers run in processes of their own, on the same machine. Making the recorder and closing it are left out: the one
imports what the viewer needs, the other waits until the viewer has the rest. Rollouts take several seconds, because a
view's beginning (the panels are made and sent) costs about 0.2 s of a core, once.
"""

from __future__ import annotations

import contextlib
import socket
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from tools.bench.measure import Run, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_most
from tools.bench.workloads import WORKLOADS, Workload, reference

_LIMIT = 1.10
_LISTENER = Path(__file__).with_name("listener.py")


def live(run: Run) -> Iterator[Target]:
    """CartPole under a random policy, and an environment that returns a screen of 210 x 160 x 3 at once."""
    for name, steps in (("cartpole", 200_000), ("images", 20_000)):
        data = reference(name, run.part(steps, 1000))
        yield from _compare(run, WORKLOADS[name], len(data.lengths))


def _compare(run: Run, workload: Workload, episodes: int) -> Iterator[Target]:
    with _viewers() as places:
        sides: dict[str, str | None] = {"no view": None}
        for name, port in places.items():
            url = f"rerun+http://127.0.0.1:{port}/proxy" if "Rerun" in name else f"ws://127.0.0.1:{port}"
            sides[name] = url

        def side(name: str, target: str | None) -> Callable[[], float]:
            return lambda: _seconds(run, workload, episodes, name, target) * 1e6

        calls = {name: side(name, target) for name, target in sides.items()}
        for call in calls.values():
            call()
        values = alternate(calls, run.rounds)
    bare = statistics.median(values["no view"])
    for name in places:
        note = f"{statistics.median(values[name]):.2f} µs a step; {bare:.2f} without"
        found = ratio(values[name], values["no view"])
        yield at_most(f"live view of {workload.name}, {name}, over none", _LIMIT, found, note, "x")


def _seconds(run: Run, workload: Workload, episodes: int, name: str, target: str | None) -> float:
    """Seconds per step of the rollout."""
    from tupli_mcap import RecordEpisodes, Recording

    path, steps = run.fresh("live.mcap"), 0

    def rollout() -> None:
        nonlocal steps
        steps = workload.rollout(env, episodes)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # no viewer answers: that is one of the sides
        env = RecordEpisodes(workload.make(), path, live=target)
        if target is not None:
            time.sleep(1.0 if "connected" in name else 0.2)  # for listeners to connect
        seconds = seconds_of(rollout)
        env.close()
    with Recording(path) as recording:
        check(recording.num_steps == steps, f"{recording.num_steps} steps instead of {steps}")
    path.unlink()
    return seconds / steps


@contextlib.contextmanager
def _viewers() -> Iterator[dict[str, int]]:
    """By side, the port of its viewer; "connected" ones are listened to, for as long as the context lasts."""
    ports = {name: _free_port() for name in ("Rerun, connected", "Rerun, no viewer", "Foxglove, connected")}
    ports["Foxglove, nobody there"] = _free_port()
    rerun = [sys.executable, "-m", "rerun", "--serve-grpc", "--bind", "127.0.0.1"]
    commands = [
        [*rerun, "--port", str(ports["Rerun, connected"]), "--server-memory-limit", "256MB"],
        [sys.executable, str(_LISTENER), str(ports["Foxglove, connected"])],
    ]
    quiet = subprocess.DEVNULL
    with contextlib.ExitStack() as stack:
        for command in commands:
            process = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
            stack.callback(_end, process)
        time.sleep(3.0)
        yield ports


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
