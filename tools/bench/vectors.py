"""A vector environment that hands out prepared batches, and what each env-step of it costs to record."""

from __future__ import annotations

import functools
import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from tools.bench.contenders.base import Contender
from tools.bench.data import Array, check_same
from tools.bench.measure import Stopwatch, seconds_of
from tools.bench.workloads import NUM_ENVS, ROWS, SEED, small4

LENGTH = 1000  # steps of an episode, where contenders are compared


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


@functools.cache
def _actions() -> list[Any]:
    return list(np.random.default_rng(SEED).integers(0, 2, (ROWS, NUM_ENVS)))


def _rollout(env: Any, steps: int) -> None:
    env.reset(seed=SEED)
    for action in itertools.islice(itertools.cycle(_actions()), steps):
        env.step(action)


@functools.lru_cache(1)
def _wanted(length: int, steps: int) -> dict[str, Array]:
    """All leaves of `steps` vector steps, and `is_step`: False where a sub-environment was reset instead."""
    env = TableVectorEnv(NUM_ENVS, length)
    step = np.arange(steps)
    after = (step + 1) % len(env.phase)
    return {
        "states": np.stack(env._states)[step % len(env._states)],
        "actions": np.stack(_actions())[step % ROWS],
        "rewards": np.stack(env._rewards)[after],
        "terminals": np.zeros((steps, NUM_ENVS), np.bool_),
        "timeouts": np.stack(env.ends)[after],
        "is_step": ~np.stack(env.resets)[after],
    }


def record(contender: Contender, path: Path, length: int, steps: int) -> tuple[float, int]:
    """Microseconds an env-step over the same rollout without a recorder, and the number of env-steps; all checked."""
    wanted, watch = _wanted(length, steps), Stopwatch()
    contender.prepare_vector(wanted)

    def bare() -> float:
        env = gym.vector.VectorWrapper(TableVectorEnv(NUM_ENVS, length))
        return seconds_of(lambda: _rollout(env, steps))

    inner = TableVectorEnv(NUM_ENVS, length)
    before = bare()
    with watch:
        recorder = contender.wrap_vector(inner, path)
        _rollout(recorder, steps)
        recorder.close()
    after = bare()
    check_vector(contender.read_vector(path), wanted)
    env_steps = int(wanted["is_step"].sum())
    return (watch.seconds - (before + after) / 2) / env_steps * 1e6, env_steps


def read(contender: Contender, path: Path, length: int, steps: int) -> float:
    """Million env-steps a second, opening counted; all checked."""
    wanted, found = _wanted(length, steps), list[dict[str, Any]]()
    seconds = seconds_of(lambda: found.append(contender.read_vector(path)))
    check_vector(found[0], wanted)
    return int(wanted["is_step"].sum()) / seconds / 1e6


def check_vector(found: dict[str, Any], wanted: dict[str, Array]) -> None:
    """Compares vector steps; or, where there is `env`, the steps of each sub-environment in their order."""
    if "env" in found:
        order = np.argsort(found["env"], kind="stable")
        found = {name: leaf[order] for name, leaf in found.items()}
        steps, number = np.nonzero(wanted["is_step"])
        by_env = np.argsort(number, kind="stable")
        rows = steps[by_env], number[by_env]
        wanted = {name: leaf[rows] for name, leaf in wanted.items() if name != "is_step"} | {"env": rows[1]}
    check_same(found, wanted)
