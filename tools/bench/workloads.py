"""What is rolled out: the same environments, seeds and prepared actions for every contender.

CartPole is Gymnasium's own under a random policy. The other environments hand out prepared rows and cost next to
nothing, so that what is left is the recorder. What a recording must hold is known without recording.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleEnv

from tools.bench.data import Array, Data, flat

SEED = 7
ROWS = 4096
DATA = "TUPLI_MCAP_BENCH_DATA"  # the directory of what the processes of one run share
VECTOR = "vector"  # the workload of a vector environment, see vectors.py
NUM_ENVS = 64
STEPS = ("actions", "rewards", "terminals", "timeouts")


class SteadyCartPole(CartPoleEnv):
    """CartPole whose first reset is always seeded alike, and no other one is: some recorders seed every reset."""

    _first = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        seed, self._first = SEED if self._first else None, False
        return super().reset(seed=seed, options=options)


gym.register("SteadyCartPole-v1", entry_point="tools.bench.workloads:SteadyCartPole", max_episode_steps=500)


class TableEnv(gym.Env[Any, Any]):
    """Hands out the rows of a table in turn; every episode has the same length.

    Args:
        table: the name of a function of this module that makes the rows.
    """

    def __init__(self, table: str, length: int) -> None:
        made = globals()[table]()
        self.observation_space, self.action_space = made.space, made.actions
        self._names = table, length
        self._rows = itertools.cycle(made.states).__next__
        self._rewards = itertools.cycle(made.rewards.tolist()).__next__
        self._length = length
        self._left = 0

    def __reduce__(self) -> tuple[Any, ...]:
        # A recorder that keeps the environment need not keep the table: real environments are small, too.
        return TableEnv, self._names

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._left = self._length
        return self._rows(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._left -= 1
        return self._rows(), self._rewards(), False, self._left == 0, {}


@dataclass(frozen=True)
class Table:
    """Rows of states, rewards, and the spaces."""

    space: spaces.Space[Any]
    actions: spaces.Space[Any]
    leaves: dict[str, Array]
    states: list[Any]
    rewards: Array


def _table(space: spaces.Space[Any], actions: spaces.Space[Any], states: Any) -> Table:
    rewards = (
        np.random.default_rng(SEED + 1).normal(size=ROWS - 1).round(3)
    )  # of another period than the states
    leaves = flat(states)
    if "states" in leaves:
        return Table(space, actions, leaves, list(states), rewards)
    keys = list(states)
    columns = [states[key].tolist() if states[key].dtype.kind == "U" else list(states[key]) for key in keys]
    return Table(
        space,
        actions,
        leaves,
        [dict(zip(keys, row, strict=True)) for row in zip(*columns, strict=True)],
        rewards,
    )


@functools.cache
def walk17() -> Table:
    """17 float64 that walk at random, about as compressible as joint angles; 6 float32 of action."""
    states = np.cumsum(np.random.default_rng(SEED).normal(0, 0.01, (ROWS, 17)), axis=0)
    return _table(spaces.Box(-np.inf, np.inf, (17,), np.float64), spaces.Box(-1, 1, (6,), np.float32), states)


@functools.cache
def small4() -> Table:
    """CartPole's layout: four float32, two actions."""
    states = np.random.default_rng(SEED).normal(size=(ROWS, 4)).astype(np.float32)
    return _table(spaces.Box(-np.inf, np.inf, (4,), np.float32), spaces.Discrete(2), states)


@functools.cache
def noise256() -> Table:
    """Rows of 256 bytes that nothing compresses."""
    states = np.random.default_rng(SEED).integers(0, 256, (ROWS, 256), np.uint8)
    return _table(spaces.Box(0, 255, (256,), np.uint8), spaces.Discrete(2), states)


@functools.cache
def mission() -> Table:
    """A grid, a direction and a text, as MiniGrid gives them."""
    rng = np.random.default_rng(SEED)
    grids = np.zeros((ROWS, 7, 7, 3), np.uint8)
    grids[..., 0] = rng.choice([1, 1, 1, 1, 2, 2, 5, 8], (ROWS, 7, 7))
    grids[..., 1] = np.where(grids[..., 0] > 2, rng.integers(0, 6, (ROWS, 7, 7)), 0)
    colours, things = ["red", "green", "blue", "grey"], ["key", "ball", "door", "box"]
    goals = [f"go to the {c} {t} and pick up the {d} ball" for c in colours for t in things for d in colours]
    texts = np.repeat(np.array(goals), ROWS // len(goals))
    states = {"direction": rng.integers(0, 4, ROWS), "image": grids, "mission": texts}
    space = spaces.Dict(
        direction=spaces.Discrete(4),
        image=spaces.Box(0, 255, (7, 7, 3), np.uint8),
        mission=spaces.Text(64, charset="abcdefghijklmnopqrstuvwxyz "),
    )
    return _table(space, spaces.Discrete(7), states)


@functools.cache
def screens() -> Table:
    """Screens of Breakout (210 x 160 x 3), which the benchmark's own process has played before."""
    states = np.load(Path(os.environ[DATA]) / "frames.npy", mmap_mode="r")
    return _table(spaces.Box(0, 255, states.shape[1:], np.uint8), spaces.Discrete(4), states)


def play(path: Path, frames: int) -> str:
    """Writes `frames` screens to `path`; returns what they are of."""
    try:
        import ale_py

        gym.register_envs(ale_py)
        env = gym.make("ALE/Breakout-v5", frameskip=4)
        title = "Breakout"
    except (ImportError, gym.error.Error):
        rng = np.random.default_rng(SEED)
        made = rng.integers(0, 256, (1, 21, 16, 3), np.uint8).repeat(frames, 0).repeat(10, 1).repeat(10, 2)
        for i, frame in enumerate(made):
            for top, left in ((i % 150, 2 * i % 140), (150 - i % 150, i % 140)):
                frame[top : top + 12, left : left + 12] = 255
        np.save(path, made)
        return "moving blocks: ale-py is not installed"
    env.action_space.seed(SEED)
    screen, _ = env.reset(seed=SEED)
    made = np.empty((frames, *screen.shape), np.uint8)
    for i in range(frames):
        made[i] = screen
        screen, _, terminal, timeout, _ = env.step(env.action_space.sample())
        if terminal or timeout:
            screen, _ = env.reset()
    env.close()
    np.save(path, made)
    return title


def _roll(env: Any, next_action: Callable[[], Any], episodes: range) -> int:
    steps = 0
    for episode in episodes:
        env.reset(seed=SEED if episode == 0 else None)
        done = False
        while not done:
            _, _, terminal, timeout, _ = env.step(next_action())
            steps += 1
            done = terminal or timeout
    return steps


class Bare:
    """The environment in a wrapper that does nothing. `seconds` it took so far."""

    def __init__(self, env: gym.Env[Any, Any], actions: list[Any]) -> None:
        self._env, self._next_action = gym.Wrapper(env), itertools.cycle(actions).__next__
        self.seconds = 0.0

    def roll(self, episodes: range) -> None:
        """Goes on with these episodes."""
        began = time.perf_counter()
        _roll(self._env, self._next_action, episodes)
        self.seconds += time.perf_counter() - began


_TURN = 350  # steps, about: a machine that changes its speed changes it for both
_beside: list[Bare] = []


@dataclass(frozen=True)
class Workload:
    """An environment and the actions taken in it, repeated without end."""

    name: str
    title: str
    length: int  # steps of an episode of a table; about that in CartPole
    window: int  # steps of a window
    table: str | None = None

    def make(self) -> gym.Env[Any, Any]:
        """A new environment; it gives the same steps each time."""
        if self.table is None:
            return gym.make("SteadyCartPole-v1", disable_env_checker=True)
        return TableEnv(self.table, self.length)

    @functools.cached_property
    def actions(self) -> Array:
        """What is done, over and over."""
        rng = np.random.default_rng(SEED)
        space = self.make().action_space
        if isinstance(space, spaces.Box):
            return rng.uniform(-1, 1, (ROWS, *space.shape)).astype(np.float32)
        return rng.integers(0, space.n, ROWS)  # type: ignore[attr-defined]

    def rollout(self, env: Any, episodes: int) -> int:
        """The ordinary loop: seed the first reset, leave the others alone. Returns the number of steps.

        Within `beside`, some episodes of it and as many of the bare environment take turns.
        """
        next_action = itertools.cycle(list(self.actions)).__next__
        steps, turn = 0, max(1, _TURN // self.length)
        for first in range(0, episodes, turn):
            part = range(first, min(first + turn, episodes))
            steps += _roll(env, next_action, part)
            if _beside:
                _beside[-1].roll(part)
        return steps

    @contextlib.contextmanager
    def beside(self) -> Iterator[Bare]:
        """A bare environment that takes turns with the one that is rolled out meanwhile."""
        _beside.append(Bare(self.make(), list(self.actions)))
        try:
            yield _beside[-1]
        finally:
            _beside.pop()

    def data(self, steps: int) -> Data:
        """What a recording of at least `steps` steps of whole episodes must hold."""
        return _rolled_out(self, steps) if self.table is None else _looked_up(self, self.table, steps)


def _looked_up(work: Workload, name: str, steps: int) -> Data:
    table: Table = globals()[name]()
    episodes = -(-steps // work.length)
    within = np.arange(episodes)[:, None] * (work.length + 1) + np.arange(work.length + 1)
    size = len(table.states)
    rows = within[:, :-1].reshape(-1) % size
    count = episodes * work.length
    leaves: dict[str, Array] = {key: leaf[rows] for key, leaf in table.leaves.items()}
    number = np.arange(count)
    leaves["actions"] = work.actions[number % len(work.actions)]
    leaves["rewards"] = table.rewards[number % len(table.rewards)]
    leaves["terminals"] = np.zeros(count, np.bool_)
    leaves["timeouts"] = (number + 1) % work.length == 0
    finals = {key: leaf[within[:, -1] % size] for key, leaf in table.leaves.items()}
    return Data(leaves, np.full(episodes, work.length), finals)


def _rolled_out(work: Workload, steps: int) -> Data:
    env = work.make()
    actions = itertools.cycle(list(work.actions))
    columns: list[list[Any]] = [[], [], [], [], []]
    lengths: list[int] = []
    finals: list[Any] = []
    while sum(lengths) < steps:
        state, _ = env.reset(seed=SEED)
        done, count = False, 0
        while not done:
            action = next(actions)
            after, reward, terminal, timeout, _ = env.step(action)
            for column, value in zip(columns, (state, action, reward, terminal, timeout), strict=True):
                column.append(value)
            state, done, count = after, terminal or timeout, count + 1
        lengths.append(count)
        finals.append(state)
    leaves = dict(zip(("states", *STEPS), map(np.array, columns), strict=True))
    return Data(leaves, np.array(lengths), {"states": np.array(finals)})


WORKLOADS: dict[str, Workload] = {
    work.name: work
    for work in (
        Workload("cartpole", "CartPole, random policy: episodes of about 22 steps", 22, 8),
        Workload("floats", "17 + 6 floats, episodes of 1,000 steps", 1000, 32, "walk17"),
        Workload("images", "screens of 210 x 160 x 3, episodes of 200 steps", 200, 4, "screens"),
        Workload("dict", "Dict of grid, direction and text, episodes of 100 steps", 100, 16, "mission"),
        Workload("growth", "four floats, episodes of 22 steps", 22, 8, "small4"),
        Workload("long", "four floats, episodes of 1,000 steps", 1000, 32, "small4"),
        Workload("noise", "256 bytes that nothing compresses", 1000, 32, "noise256"),
    )
}


def reference(name: str, steps: int) -> Data:
    """The data of a workload; kept in the shared directory where they take long to make."""
    work = WORKLOADS[name]
    if work.table is not None:
        return work.data(steps)
    kept = Path(os.environ[DATA]) / f"{name}-{steps}.npz"
    if not kept.exists():
        work.data(steps).save(kept)
    return Data.load(kept)
