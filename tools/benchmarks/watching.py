"""What a live view costs the rollout: recording with one over recording without, viewers connected and not.

The viewers run in processes of their own, on the same machine. Making the recorder and closing it are left out: the one
imports what the viewer needs, the other waits until the viewer has the rest. Rollouts take several seconds, because a
view's beginning (the panels are made and sent) costs about 0.2 s of a core, once.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from benchmarks.measure import Line, Run, alternate, at_most, check, seconds_of
from benchmarks.workloads import Workload, cartpole, screens

_LIMIT = 1.10
_LISTENER = Path(__file__).with_name("listener.py")


def live(run: Run) -> Iterator[Line]:
    """CartPole under a random policy, and an environment that returns a screen of 210 x 160 x 3 at once."""
    long, screen_steps = 4 * run.steps, max(run.steps // 3, 1000)
    for workload, steps in ((cartpole(long), long), (screens(), screen_steps)):
        yield from _compare(run, workload, steps)


def _compare(run: Run, workload: Workload, steps: int) -> Iterator[Line]:
    episodes = workload.reference(steps).episodes_for(steps) if workload.name == "cartpole" else steps // 1000
    case = f"live view, {workload.name}"
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
    yield Line(case, "no view", f"RecordEpisodes; {episodes:,} episodes", "µs/step", values["no view"])
    words, met = at_most(_LIMIT, "with/without")
    for name in places:
        shares = sorted(a / b for a, b in zip(values[name], values["no view"], strict=True))
        found = shares[len(shares) // 2]
        yield Line(case, name, "RecordEpisodes(live=)", "µs/step", values[name], found, words, met(found))


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
