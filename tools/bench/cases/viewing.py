"""Making files for the viewer: a replay beside the same columns sent by hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.bench.contenders.ours import Ours
from tools.bench.measure import Run, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_most
from tools.bench.workloads import WORKLOADS, reference

INSTALL_RERUN = "rerun-sdk is not installed"
_ROWS = 65_536


def replay_cartpole(run: Run) -> Iterator[Target]:
    """`.rrd` files of one recording; reading it, blueprint, card and overview are counted on our side only."""
    what = "replay of CartPole as a file for Rerun, over the same columns sent by hand"
    try:
        import rerun
    except ImportError:
        yield at_most(what, 1.5, None, INSTALL_RERUN)
        return
    from tupli_mcap import viewer

    path = run.fresh("replay.mcap")
    data = reference("cartpole", run.part(1_000_000))
    Ours().record(WORKLOADS["cartpole"], path, len(data.lengths))
    columns = _columns(path)

    def mine() -> float:
        goal = run.fresh("ours.rrd")
        seconds = seconds_of(lambda: viewer.save(path, goal))
        return _checked("tupli-mcap", goal, columns, seconds)

    def by_hand() -> float:
        goal = run.fresh("bare.rrd")
        seconds = seconds_of(lambda: _send(rerun, columns, goal))
        return _checked("send_columns", goal, columns, seconds)

    values = alternate({"ours": mine, "bare": by_hand}, max(run.rounds, 5))
    note = f"{data.steps:,} steps; reading, blueprint, card and overview are counted on this side only"
    yield at_most(what, 1.5, ratio(values["ours"], values["bare"]), note, "x")


def _columns(path: Path) -> dict[str, Any]:
    """What a replay shows, by entity, and the timelines: made before the clock runs."""
    from tupli_mcap import Recording

    with Recording(path) as recording:
        read = recording.read(fields=["states", "actions", "rewards", "times"])
        seconds = recording.labels.step_seconds
        lengths = read.episode_lengths
    ends = np.cumsum(lengths)
    sums = np.cumsum(read.rewards)
    before = np.repeat(np.concatenate([[0.0], sums[ends[:-1] - 1]]), lengths)
    step = np.arange(len(read))
    return {
        "step": step,
        "time": read.times.astype("datetime64[ns]"),
        "episode_time": None if seconds is None else step * seconds,
        "/state": read.states.astype(np.float64),
        "/action": read.actions.astype(np.float64)[:, None],
        "/reward": read.rewards[:, None],
        "/return": (sums - before)[:, None],
    }


def _send(rr: Any, columns: dict[str, Any], goal: Path) -> None:
    stream = rr.RecordingStream("bare")
    stream.save(goal)
    total = len(columns["step"])
    for first in range(0, total, _ROWS):
        rows = slice(first, min(first + _ROWS, total))
        times = [
            rr.TimeColumn("step", sequence=columns["step"][rows]),
            rr.TimeColumn("time", timestamp=columns["time"][rows]),
        ]
        if columns["episode_time"] is not None:
            times.append(rr.TimeColumn("episode_time", duration=columns["episode_time"][rows]))
        for entity in ("/state", "/action", "/reward", "/return"):
            values = columns[entity][rows]
            scalars = rr.Scalars.columns(scalars=values.reshape(-1))
            stream.send_columns(entity, times, scalars.partition([values.shape[1]] * len(values)))
    stream.flush()
    stream.disconnect()


def _checked(side: str, goal: Path, columns: dict[str, Any], seconds: float) -> float:
    """`seconds`, if all values are in the file."""
    from rerun.chunk import RrdReader

    found: dict[str, list[tuple[int, Any]]] = {}
    for chunk in RrdReader(str(goal)).stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names and "step" in batch.schema.names:
            values = batch.column("Scalars:scalars").flatten().to_numpy(zero_copy_only=False)
            found.setdefault(chunk.entity_path, []).append((batch.column("step")[0].as_py(), values))
    for entity in ("/state", "/action", "/reward", "/return"):
        parts = [values for _, values in sorted(found.get(entity, []), key=lambda part: part[0])]
        check(bool(parts), f"{side}: nothing at {entity}")
        same = np.array_equal(np.concatenate(parts), columns[entity].reshape(-1))
        check(same, f"{side}: other values at {entity}")
    goal.unlink()
    return seconds
