"""What a contender can be asked to do; what it leaves out is a "-" in the table, with its reason as a footnote."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.data import Array, Data, flat
from tools.bench.measure import Stopwatch
from tools.bench.workloads import STEPS, Workload

BLOCK = 4096  # rows that are kept before they are written
LOADED = ("states", "actions", "rewards")  # what a loader reads; the names of leaves begin so


class CannotError(Exception):
    """A contender has no such operation; says why."""


class Session:
    """An opened dataset. Episodes are numbered in the order they were recorded."""

    def __init__(self, lengths: Array | None = None) -> None:
        self.lengths = lengths

    def episode(self, number: int) -> dict[str, Any]:
        """All leaves of an episode."""
        raise CannotError("has no episodes")

    def window(self, number: int, start: int, length: int) -> dict[str, Any]:
        """All leaves of a part of an episode."""
        return {name: leaf[start : start + length] for name, leaf in self.episode(number).items()}

    def windows(
        self, places: Sequence[tuple[int, int]], length: int
    ) -> list[dict[str, Any]] | dict[str, Any]:
        """`LOADED` of several windows: all leaves one by one, unless there is a quicker way; then stacked."""
        return [self.window(number, start, length) for number, start in places]

    def close(self) -> None:
        """Closes it."""


class Contender:
    """Defaults: it can do nothing, and says so."""

    note = ""  # what a reader of the table should know

    def record(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        """Seconds of making the recorder, rolling out and closing it (not of making the environment), and steps."""
        env, watch = work.make(), Stopwatch()
        with watch:
            recorder = self.wrap(env, work, path)
            steps = work.rollout(recorder, episodes)
            recorder.close()
        return watch.seconds, steps

    def wrap(self, env: gym.Env[Any, Any], work: Workload, path: Path) -> gym.Env[Any, Any]:
        """The environment, recorded to `path` (a file or a directory that is not there yet)."""
        raise CannotError("records nothing")

    def prepare_vector(self, leaves: dict[str, Array]) -> None:
        """Before the clock runs: all leaves of the vector steps to come, and `is_step`."""

    def wrap_vector(self, env: gym.vector.VectorEnv[Any, Any, Any], path: Path) -> Any:
        """The vector environment, recorded to `path`."""
        raise CannotError("records no vector environment")

    def read_vector(self, path: Path) -> dict[str, Any]:
        """All leaves: a row a vector step, with `is_step`, or a row a step, with its sub-environment in `env`."""
        return self.read(path)[0]

    def append(self, work: Workload, path: Path, episodes: int) -> tuple[float, int]:
        """The same to what is there already."""
        raise CannotError("a file is written once")

    def listing(self, path: Path) -> Array:
        """Opens it and gives the length of every episode."""
        raise CannotError("keeps no episodes")

    def read(self, path: Path) -> tuple[dict[str, Any], Array | None]:
        """Opens it and gives all leaves, and the lengths of the episodes where it knows them."""
        raise CannotError("reads nothing")

    def field(self, path: Path) -> Array:
        """Opens it and gives the actions."""
        raise CannotError("has no columns")

    def open(self, path: Path) -> Session:
        """Opens it to read episodes and windows."""
        raise CannotError("reads nothing")

    def select(self, path: Path, least: float) -> dict[str, Any]:
        """Opens it and gives the leaves of all episodes whose return is at least `least`."""
        raise CannotError("has no filter")

    def wanted(self, data: Data) -> Data:
        """What it should give back of `data`: the same, unless it keeps other things than it was given."""
        return data


def joined(parts: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Leaves of several episodes, one after the other."""
    return {name: np.concatenate([np.asarray(part[name]) for part in parts]) for name in parts[0]}


class Blocks(gym.Wrapper[Any, Any, Any, Any]):
    """Recording by hand: every step goes into preallocated arrays, which go to `write` when they are full.

    `write(leaves)` gets arrays of up to `BLOCK` rows, its own; `finish(lengths, returns, finals)` comes last.
    """

    def __init__(self, env: gym.Env[Any, Any], sink: Any, block: int | None = None) -> None:
        super().__init__(env)
        self._sink = sink
        space: Any = env.observation_space
        self._keys = None if not isinstance(space, gym.spaces.Dict) else list(space.spaces)
        boxes = [space] if self._keys is None else [space[key] for key in self._keys]
        row = sum(box.dtype.itemsize * int(np.prod(box.shape)) for box in boxes if box.shape is not None)
        self._rows = min(block or BLOCK, max(16, (4 << 20) // max(1, row)))
        self._empty = {name: _column(box, self._rows) for name, box in zip(self._names(), boxes, strict=True)}
        action: Any = env.action_space
        self._empty["actions"] = np.empty((self._rows, *action.shape), action.dtype)
        self._empty |= {"rewards": np.empty(self._rows), "terminals": np.empty(self._rows, np.bool_)}
        self._empty["timeouts"] = np.empty(self._rows, np.bool_)
        self._lengths: list[int] = []
        self._returns: list[float] = []
        self._finals: list[Any] = []
        self._fresh()

    def _names(self) -> list[str]:
        return ["states"] if self._keys is None else [f"states.{key}" for key in self._keys]

    def _fresh(self) -> None:
        self._leaves = {name: np.empty_like(leaf) for name, leaf in self._empty.items()}
        columns = [self._leaves[name] for name in self._names()]
        self._states = columns[0] if self._keys is None else list(zip(self._keys, columns, strict=True))
        self._others = [self._leaves[name] for name in STEPS]
        self._at = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        self._length, self._return = 0, 0.0
        return self._state, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        result = self.env.step(action)
        i = self._at
        if self._keys is None:
            self._states[i] = self._state
        else:
            for key, column in self._states:
                column[i] = self._state[key]
        actions, rewards, terminals, timeouts = self._others
        self._state, reward, terminal, timeout, _ = result
        actions[i], rewards[i], terminals[i], timeouts[i] = action, reward, terminal, timeout
        self._length += 1
        self._return += float(reward)
        self._at = i + 1
        if self._at == self._rows:
            self._sink.write(self._leaves)
            self._fresh()
        if terminal or timeout:
            self._lengths.append(self._length)
            self._returns.append(self._return)
            self._finals.append(self._state)
        return result

    def close(self) -> None:
        if self._at:
            self._sink.write({name: leaf[: self._at] for name, leaf in self._leaves.items()})
        finals = self._finals
        if self._keys is not None:
            finals = {key: np.array([final[key] for final in finals]) for key in self._keys}  # type: ignore[assignment]
        leaves = flat(finals if self._keys is not None else np.array(finals))
        self._sink.finish(np.array(self._lengths), np.array(self._returns), leaves)
        super().close()


class VectorBlocks(gym.vector.VectorWrapper):
    """The same of a vector environment whose states are arrays: a row a vector step.

    `is_step` is False where a sub-environment was reset instead: its state there is the last one of its episode.
    """

    def __init__(self, env: gym.vector.VectorEnv[Any, Any, Any], sink: Any) -> None:
        super().__init__(env)
        self._sink = sink
        shape, actions = (BLOCK, env.num_envs), env.action_space
        self._empty = {"states": _column(env.observation_space, BLOCK), "actions": _column(actions, BLOCK)}
        self._empty["rewards"] = np.empty(shape)
        self._empty |= {name: np.empty(shape, np.bool_) for name in ("terminals", "timeouts", "is_step")}
        self._lengths, self._returns = np.zeros(env.num_envs, np.int64), np.zeros(env.num_envs)
        self._fresh()

    def _fresh(self) -> None:
        self._leaves = {name: np.empty_like(leaf) for name, leaf in self._empty.items()}
        self._columns = list(self._leaves.values())
        self._at = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._state, info = self.env.reset(**kwargs)
        self._running = np.ones(self.num_envs, np.bool_)
        return self._state, info

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        result = after, rewards, terminals, timeouts, _ = self.env.step(actions)
        row = self._state, actions, rewards, terminals, timeouts, self._running
        for column, values in zip(self._columns, row, strict=True):
            column[self._at] = values
        self._state, self._running = after, ~(terminals | timeouts)
        self._at += 1
        if self._at == BLOCK:
            self._write()
        return result

    def _write(self) -> None:
        self._sink.write({name: leaf[: self._at] for name, leaf in self._leaves.items()})
        self._lengths += self._at
        self._returns += self._leaves["rewards"][: self._at].sum(0)
        self._fresh()

    def close(self, **kwargs: Any) -> None:
        if self._at:
            self._write()
        # Of each sub-environment: rows, the sum of its rewards, the state it is left in.
        self._sink.finish(self._lengths, self._returns, {"states": self._state})
        super().close(**kwargs)


class ByHand(Contender):
    """Who writes blocks of whole columns: `sink(path)` gets them."""

    sink: type[Any]

    def wrap(self, env: gym.Env[Any, Any], work: Workload, path: Path) -> gym.Env[Any, Any]:
        return Blocks(env, self.sink(path))

    def wrap_vector(self, env: gym.vector.VectorEnv[Any, Any, Any], path: Path) -> Any:
        return VectorBlocks(env, self.sink(path))


def _column(space: Any, rows: int) -> Array:
    if isinstance(space, gym.spaces.Text):
        return np.empty(rows, f"U{space.max_length}")
    return np.empty((rows, *space.shape), space.dtype)
