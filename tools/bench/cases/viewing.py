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
_TIMES = ("step", "time", "episode_time")
_Columns = dict[str, dict[str, Any]]  # entity -> timelines and "values"


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
        seconds = seconds_of(lambda: viewer.save(path, goal, "all"))
        return _checked("tupli-mcap", goal, columns, seconds)

    def by_hand() -> float:
        goal = run.fresh("bare.rrd")
        seconds = seconds_of(lambda: _send(rerun, columns, goal))
        return _checked("send_columns", goal, columns, seconds)

    values = alternate({"ours": mine, "bare": by_hand}, max(run.rounds, 5))
    note = f"{data.steps:,} steps; reading, blueprint, card and overview are counted on this side only"
    yield at_most(what, 1.5, ratio(values["ours"], values["bare"]), note, "x")


def _columns(path: Path) -> _Columns:
    """What a replay shows, by entity, with its places on the timelines: made before the clock runs."""
    from tupli_mcap import Recording

    with Recording(path) as recording:
        read = recording.read(fields=["states", "actions", "rewards", "times"])
        finals = recording.final_states(np.arange(len(recording)))
        seconds = recording.labels.step_seconds
        lengths = read.episode_lengths
    ends = np.cumsum(lengths)
    sums = np.cumsum(read.rewards)
    before = np.repeat(np.concatenate([[0.0], sums[ends[:-1] - 1]]), lengths)
    wall = np.insert(read.times, ends, read.times[ends - 1] + 1).astype("datetime64[ns]")
    step = np.arange(len(wall))
    of_steps = np.delete(step, ends + np.arange(len(ends)))  # a row each is left for the final states

    def placed(values: Any, rows: Any, starts: Any) -> dict[str, Any]:
        values = np.insert(values, starts, np.nan, axis=0)  # lines break where an episode begins
        rows = np.insert(rows, starts, rows[starts])
        times = [step[rows], wall[rows], None if seconds is None else step[rows] * seconds]
        return {**dict(zip(_TIMES, times, strict=True)), "values": values}

    return {
        "/state": placed(
            np.insert(read.states, ends, finals, axis=0).astype(np.float64),
            step,
            (ends + np.arange(1, len(ends) + 1))[:-1],
        ),
        "/action": placed(read.actions.astype(np.float64)[:, None], of_steps, ends[:-1]),
        "/reward": placed(read.rewards[:, None], of_steps, ends[:-1]),
        "/return": placed((sums - before)[:, None], of_steps, ends[:-1]),
    }


def _send(rr: Any, columns: _Columns, goal: Path) -> None:
    stream = rr.RecordingStream("bare")
    stream.save(goal)
    for entity, column in columns.items():
        for first in range(0, len(column["values"]), _ROWS):
            rows = slice(first, first + _ROWS)
            times = [
                rr.TimeColumn("step", sequence=column["step"][rows]),
                rr.TimeColumn("time", timestamp=column["time"][rows]),
            ]
            if column["episode_time"] is not None:
                times.append(rr.TimeColumn("episode_time", duration=column["episode_time"][rows]))
            values = column["values"][rows]
            scalars = rr.Scalars.columns(scalars=values.reshape(-1))
            stream.send_columns(entity, times, scalars.partition([values.shape[1]] * len(values)))
    stream.flush()
    stream.disconnect()


def _checked(side: str, goal: Path, columns: _Columns, seconds: float) -> float:
    """`seconds`, if all values are in the file, on their steps."""
    from rerun.chunk import RrdReader

    found: dict[str, list[tuple[Any, Any]]] = {}
    for chunk in RrdReader(str(goal)).stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names and "step" in batch.schema.names:
            values = batch.column("Scalars:scalars").flatten().to_numpy(zero_copy_only=False)
            found.setdefault(chunk.entity_path, []).append((batch.column("step").to_numpy(), values))
    for entity, column in columns.items():
        parts = sorted(found.get(entity, []), key=lambda part: int(part[0][0]))
        check(bool(parts), f"{side}: nothing at {entity}")
        steps, values = (np.concatenate(kind) for kind in zip(*parts, strict=True))
        check(
            np.array_equal(values, column["values"].reshape(-1), equal_nan=True),
            f"{side}: other values at {entity}",
        )
        check(np.array_equal(steps, column["step"]), f"{side}: other steps at {entity}")
    goal.unlink()
    return seconds
