"""What is rolled out: CartPole and environments that cost next to nothing, with prepared actions.

Every side gets the same environment, the same first seed and the same prepared actions, so that all record
the same steps and the policy's own time is left out.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

SEED = 7
TABLE_ROWS = 4096


@dataclass(frozen=True)
class Columns:
    """Steps as arrays, one row each, and the length of every episode."""

    states: NDArray[Any]
    actions: NDArray[Any]
    rewards: NDArray[Any]
    terminals: NDArray[Any]
    timeouts: NDArray[Any]
    next_states: NDArray[Any]
    episode_lengths: NDArray[np.int64]

    def head(self, episodes: int) -> Columns:
        """The first `episodes` episodes."""
        steps = int(self.episode_lengths[:episodes].sum())
        return Columns(
            self.states[:steps],
            self.actions[:steps],
            self.rewards[:steps],
            self.terminals[:steps],
            self.timeouts[:steps],
            self.next_states[:steps],
            self.episode_lengths[:episodes],
        )

    @property
    def steps(self) -> int:
        """Number of rows."""
        return len(self.rewards)

    def episodes_for(self, steps: int) -> int:
        """How many whole episodes make up at least `steps` steps (all of them where there are fewer)."""
        ends = np.cumsum(self.episode_lengths)
        return min(int(np.searchsorted(ends, steps)) + 1, len(ends))


@dataclass(frozen=True)
class Workload:
    """An environment and the actions taken in it, repeated without end."""

    name: str
    make: Callable[[], gym.Env[Any, Any]]
    actions: list[Any]

    def rollout(self, env: gym.Env[Any, Any], episodes: int) -> int:
        """The ordinary loop: seed the first reset, leave the others alone. Returns the number of steps."""
        next_action = itertools.cycle(self.actions).__next__
        steps = 0
        for episode in range(episodes):
            env.reset(seed=SEED if episode == 0 else None)
            done = False
            while not done:
                _, _, terminal, timeout, _ = env.step(next_action())
                steps += 1
                done = terminal or timeout
        return steps

    def reference(self, steps: int) -> Columns:
        """What a recording of at least `steps` steps must hold, from whole episodes."""
        log = Log(self.make())
        next_action = itertools.cycle(self.actions).__next__
        while len(log.rewards) < steps:
            log.reset(seed=SEED if not log.rewards else None)
            done = False
            while not done:
                _, _, terminal, timeout, _ = log.step(next_action())
                done = terminal or timeout
        return log.columns()


class Log(gym.Wrapper[Any, Any, Any, Any]):
    """Keeps every step in lists: what the recorders are checked against."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.states: list[Any] = []
        self.actions: list[Any] = []
        self.rewards: list[Any] = []
        self.terminals: list[bool] = []
        self.timeouts: list[bool] = []
        self.next_states: list[Any] = []
        self.lengths: list[int] = []
        self._state: Any = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        self.lengths.append(0)
        return self._state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        self.states.append(self._state)
        self.actions.append(action)
        self.rewards.append(result[1])
        self.terminals.append(result[2])
        self.timeouts.append(result[3])
        self._state = result[0]
        self.next_states.append(self._state)
        self.lengths[-1] += 1
        return result

    def columns(self) -> Columns:
        """Everything logged so far."""
        return Columns(
            np.array(self.states),
            np.array(self.actions),
            np.array(self.rewards),
            np.array(self.terminals),
            np.array(self.timeouts),
            np.array(self.next_states),
            np.array(self.lengths, np.int64),
        )


class TableEnv(gym.Env[Any, Any]):
    """Returns the rows of a prepared table in turn; every episode has the same length.

    Args:
        table: a function of this module that makes the rows.
        action_space: any space.
        length: steps of an episode.
    """

    def __init__(self, table: Callable[[], NDArray[Any]], action_space: gym.Space[Any], length: int) -> None:
        states = table()
        low, high = (0, 255) if states.dtype == np.uint8 else (-np.inf, np.inf)
        self.observation_space = gym.spaces.Box(low, high, states.shape[1:], states.dtype.type)
        self.action_space = action_space
        self._table = table
        self._rows = itertools.cycle(list(states)).__next__
        self._length = length
        self._left = 0

    def __reduce__(self) -> tuple[Any, ...]:
        # A recorder that keeps the environment need not keep the table: real environments are small, too.
        return TableEnv, (self._table, self.action_space, self._length)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = self._length
        return self._rows(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._left -= 1
        return self._rows(), 1.0, False, self._left == 0, {}


@functools.cache
def walk17() -> NDArray[np.float64]:
    """Rows of 17 float64: a random walk, so about as compressible as joint angles are."""
    return np.cumsum(np.random.default_rng(SEED).normal(0, 0.01, (TABLE_ROWS, 17)), axis=0)


@functools.cache
def noise4_batches(num_envs: int) -> NDArray[np.float32]:
    """The same for a vector environment."""
    return np.random.default_rng(SEED).normal(size=(TABLE_ROWS, num_envs, 4)).astype(np.float32)


@functools.cache
def noise4() -> NDArray[np.float32]:
    """Rows of CartPole's four float32."""
    return np.random.default_rng(SEED).normal(size=(TABLE_ROWS, 4)).astype(np.float32)


class TableVectorEnv(VectorEnv[Any, Any, Any]):
    """The vector counterpart of TableEnv: NEXT_STEP autoreset, episodes of the sub-environments staggered.

    The step after an episode's end is the reset of that sub-environment and no step of an episode.
    """

    def __init__(self, num_envs: int, length: int) -> None:
        states = noise4_batches(num_envs)
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, states.shape[2:], states.dtype.type)
        self.single_action_space = gym.spaces.Discrete(2)
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, num_envs)
        period = length + 1
        # phase[k, i]: steps sub-environment i has done of its period after vector step k (0: just reset).
        self.phase = (np.arange(period)[:, None] + np.arange(num_envs) * length // num_envs) % period
        self.ends = list(self.phase == length)
        self.resets = list(self.phase == 0)
        self._length = length
        self._states = list(states)
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


def cartpole(steps: int) -> Workload:
    """CartPole-v1 under a random policy: episodes of about 22 steps."""
    actions = list(np.random.default_rng(SEED).integers(0, 2, steps))
    return Workload("cartpole", lambda: gym.make("CartPole-v1", disable_env_checker=True), actions)


def floats(length: int = 1000) -> Workload:
    """17 float64 in, 6 float32 out."""
    actions = list(np.random.default_rng(SEED).uniform(-1, 1, (TABLE_ROWS, 6)).astype(np.float32))
    space = gym.spaces.Box(-1, 1, (6,), np.float32)
    return Workload("floats", lambda: TableEnv(walk17, space, length), actions)


@functools.cache
def screen_frames() -> NDArray[np.uint8]:
    """Screens of 210 x 160 x 3: blocks that move before a still background, about as compressible as an arcade game."""
    rng = np.random.default_rng(SEED)
    frames = np.repeat(rng.integers(0, 256, (1, 21, 16, 3), np.uint8), 64, axis=0).repeat(10, 1).repeat(10, 2)
    for i, frame in enumerate(frames):
        for top, left in ((i, 2 * i), (150 - i, i), (100, 3 * i % 140)):
            frame[top : top + 12, left : left + 12] = 255
    return frames


def screens(length: int = 1000) -> Workload:
    """An image of 210 x 160 x 3 as observation, from a table."""
    actions = list(np.random.default_rng(SEED).integers(0, 6, TABLE_ROWS))
    return Workload("screens", lambda: TableEnv(screen_frames, gym.spaces.Discrete(6), length), actions)


def small(length: int) -> Workload:
    """CartPole's layout from a table, with episodes of exactly `length` steps."""
    actions = list(np.random.default_rng(SEED).integers(0, 2, TABLE_ROWS))
    return Workload(f"small-{length}", lambda: TableEnv(noise4, gym.spaces.Discrete(2), length), actions)


def small_vector(length: int, num_envs: int) -> tuple[Callable[[], TableVectorEnv], list[NDArray[np.int64]]]:
    """The same for `num_envs` sub-environments: a factory, and the batches of actions to repeat."""
    actions = list(np.random.default_rng(SEED).integers(0, 2, (TABLE_ROWS, num_envs)))
    return lambda: TableVectorEnv(num_envs, length), actions
