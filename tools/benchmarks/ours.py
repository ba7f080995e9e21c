"""tupli-mcap's side of every comparison."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Stopwatch, check
from benchmarks.workloads import SEED, Columns, Log, TableVectorEnv, Workload

COLUMNS = ("states", "actions", "rewards", "terminals", "timeouts")


def record(workload: Workload, path: Path, episodes: int) -> tuple[float, int]:
    """Seconds of constructing RecordEpisodes, rolling out and closing it, and the number of steps."""
    from tupli_mcap import RecordEpisodes

    inner = workload.make()
    watch = Stopwatch()
    with watch:
        env = RecordEpisodes(inner, path)
        steps = workload.rollout(env, episodes)
        env.close()
    return watch.seconds, steps


def record_with_reference(workload: Workload, path: Path, steps: int) -> Columns:
    """Record at least `steps` steps of whole episodes, untimed, and return what the file must hold."""
    from tupli_mcap import RecordEpisodes

    log = Log(RecordEpisodes(workload.make(), path))
    next_action = itertools.cycle(workload.actions).__next__
    while len(log.rewards) < steps:
        log.reset(seed=SEED if not log.rewards else None)
        done = False
        while not done:
            _, _, terminal, timeout, _ = log.step(next_action())
            done = terminal or timeout
    log.close()
    return log.columns()


def record_vector(
    make: Callable[[], TableVectorEnv], actions: list[NDArray[np.int64]], path: Path, steps: int
) -> float:
    """Seconds of recording `steps` vector steps, constructing and closing counted."""
    from tupli_mcap.vector import RecordEpisodes

    inner = make()
    watch = Stopwatch()
    with watch:
        env = RecordEpisodes(inner, path)
        rollout_vector(env, actions, steps)
        env.close()
    return watch.seconds


def rollout_vector(env: Any, actions: list[NDArray[np.int64]], steps: int) -> None:
    """Reset once and step: the vector environment resets its sub-environments itself."""
    env.reset(seed=SEED)
    for action in itertools.islice(itertools.cycle(actions), steps):
        env.step(action)


def read(path: Path, threads: int | None = None) -> Any:
    """The whole recording as columns, opening included."""
    from tupli_mcap import Recording

    with Recording(path) as recording:
        return recording.read(threads=threads)


def check_columns(found: Any, reference: Columns) -> None:
    """Every column equal to the reference, to the bit and the dtype's width."""
    check(np.array_equal(found.episode_lengths, reference.episode_lengths), "other episode lengths")
    for name in COLUMNS:
        check(np.array_equal(getattr(found, name), getattr(reference, name)), f"other {name}")


def check_recording(path: Path, reference: Columns) -> None:
    """The recording at `path` holds exactly the reference."""
    check_columns(read(path), reference)


def check_vector(
    make: Callable[[], TableVectorEnv], actions: list[NDArray[np.int64]], path: Path, steps: int
) -> int:
    """Every sub-environment's steps are there, its reset steps are not. Returns the number of env-steps."""
    from tupli_mcap import Recording

    env = make()
    period = len(env.phase)
    reset_step = env.phase[(np.arange(steps) + 1) % period] == 0  # [step, sub-environment]
    taken = np.stack([actions[step % len(actions)] for step in range(steps)])
    with Recording(path) as recording:
        columns = recording.read(fields=["actions"])
        env_of_row = np.repeat(recording.index["env"], recording.index["length"].astype(np.int64))
        check(recording.num_steps == int((~reset_step).sum()), f"{recording.num_steps} steps")
        for number in range(env.num_envs):
            mine = columns.actions[env_of_row == number]
            check(np.array_equal(mine, taken[~reset_step[:, number], number]), f"other actions of {number}")
        return int(recording.num_steps)


def window(recording: Any, episode: int, start: int, length: int) -> tuple[NDArray[Any], ...]:
    """`length` steps of an episode, all five columns."""
    found = recording.episodes[episode][start : start + length]
    return found.states, found.actions, found.rewards, found.terminals, found.timeouts


def list_episodes(path: Path) -> list[tuple[int, int, float, str]]:
    """Open and go through all episodes, one object each."""
    from tupli_mcap import Recording

    with Recording(path) as recording:
        return [(e.number, len(e), e.return_, e.end) for e in recording.episodes]


def list_columns(path: Path) -> list[NDArray[Any]]:
    """Open and take the index as columns."""
    from tupli_mcap import Recording

    with Recording(path) as recording:
        return [recording.index[name].copy() for name in ("episode", "length", "return", "end", "seed")]
