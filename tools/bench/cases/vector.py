"""Recording vector environments: what an env-step costs beside one of a single environment of the same layout."""

from __future__ import annotations

import functools
import itertools
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from tools.bench.contenders.ours import Ours
from tools.bench.data import Array
from tools.bench.measure import Run, Stopwatch, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_most
from tools.bench.workloads import ROWS, SEED, WORKLOADS, Workload, small4

NUM_ENVS = 64


@functools.cache
def _states(num_envs: int) -> Array:
    """As `small4` has them, no two alike: whoever keeps sub-environments side by side need not compress better."""
    return np.random.default_rng(SEED).normal(size=(1024, num_envs, 4)).astype(np.float32)


class TableVectorEnv(VectorEnv[Any, Any, Any]):
    """Hands out prepared batches: NEXT_STEP autoreset, episodes of the sub-environments staggered.

    The step after an episode's end is the reset of that sub-environment and no step of an episode.
    """

    def __init__(self, num_envs: int, length: int) -> None:
        table = small4()
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space, self.single_action_space = table.space, table.actions
        self.observation_space = gym.vector.utils.batch_space(table.space, num_envs)
        self.action_space = gym.vector.utils.batch_space(table.actions, num_envs)
        period = length + 1
        # phase[k, i]: steps sub-environment i has done of its period after vector step k (0: just reset).
        self.phase = (np.arange(period)[:, None] + np.arange(num_envs) * length // num_envs) % period
        self.ends, self.resets = list(self.phase == length), list(self.phase == 0)
        self._length = length
        self._states = list(_states(num_envs))
        self._no_ends = np.zeros(num_envs, bool)
        self._rewards = [np.where(reset, 0.0, 1.0) for reset in self.resets]
        self._step = 0

    def __reduce__(self) -> tuple[Any, ...]:
        return TableVectorEnv, (self.num_envs, self._length)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._step = 0
        return self._states[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self._step = step = self._step + 1
        at = step % len(self.ends)
        return self._states[step % len(self._states)], self._rewards[at], self._no_ends, self.ends[at], {}


def _actions(num_envs: int) -> list[Any]:
    return list(np.random.default_rng(SEED).integers(0, 2, (ROWS, num_envs)))


def _rollout(env: Any, actions: list[Any], steps: int) -> None:
    env.reset(seed=SEED)
    for action in itertools.islice(itertools.cycle(actions), steps):
        env.step(action)


def _check(length: int, actions: list[Any], path: Path, steps: int) -> int:
    """Every sub-environment's steps are there, its reset steps are not. Returns the number of env-steps."""
    from tupli_mcap import Recording

    env = TableVectorEnv(NUM_ENVS, length)
    after = np.arange(steps) + 1
    reset_step = env.phase[after % len(env.phase)] == 0  # [step, sub-environment]
    taken = np.stack([actions[step % len(actions)] for step in range(steps)])
    states = np.stack([env._states[step % len(env._states)] for step in range(steps)])
    with Recording(path) as recording:
        columns = recording.read(fields=["states", "actions"])
        env_of_row = np.repeat(recording.index["env"], recording.index["length"].astype(np.int64))
        check(recording.num_steps == int((~reset_step).sum()), f"{recording.num_steps} steps")
        for number in range(NUM_ENVS):
            chosen, there = env_of_row == number, ~reset_step[:, number]
            check(np.array_equal(columns.actions[chosen], taken[there, number]), f"other actions of {number}")
            check(np.array_equal(columns.states[chosen], states[there, number]), f"other states of {number}")
        return int(recording.num_steps)


def record_vector(run: Run) -> Iterator[Target]:
    """64 sub-environments, per env-step, over a single one, episodes of 1,000 and of 22 steps."""
    for name, limit in (("long", 0.3), ("growth", 0.5)):
        yield _compare(run, WORKLOADS[name], limit)


def _compare(run: Run, work: Workload, limit: float) -> Target:
    length, actions = work.length, _actions(NUM_ENVS)
    steps = max(run.part(400_000) // NUM_ENVS, 2 * length)
    single_steps = run.part(100_000, 2000)
    episodes = -(-single_steps // length)

    def bare_vector() -> float:
        env = gym.vector.VectorWrapper(TableVectorEnv(NUM_ENVS, length))
        return seconds_of(lambda: _rollout(env, actions, steps))

    def vector() -> float:
        from tupli_mcap.vector import RecordEpisodes

        path = run.fresh("vector.mcap")
        inner, watch = TableVectorEnv(NUM_ENVS, length), Stopwatch()
        before = bare_vector()
        with watch:
            env = RecordEpisodes(inner, path)
            _rollout(env, actions, steps)
            env.close()
        after = bare_vector()
        env_steps = _check(length, actions, path, steps)
        path.unlink()
        return (watch.seconds - (before + after) / 2) / env_steps * 1e6

    def single() -> float:
        path = run.fresh("single.mcap")
        with work.beside() as bare:
            seconds, count = Ours().record(work, path, episodes)
        path.unlink()
        return (seconds - 2 * bare.seconds) / count * 1e6

    alternate({"vector": vector, "single": single}, 1)
    values = alternate({"vector": vector, "single": single}, max(run.rounds, 3))
    mine, other = statistics.median(values["vector"]), statistics.median(values["single"])
    note = f"{mine:.2f} µs of {other:.2f}; 64 sub-environments"
    what = f"record a vector environment, episodes of {length:,} steps, per env-step over a single one"
    return at_most(what, limit, ratio(values["vector"], values["single"]), note, "x")
