"""Environments for tests: of any spaces, and with the deviations from their spaces that real ones have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np


class Fails(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose step raises once it is told to."""

    fails = False

    def step(self, action: Any) -> Any:
        if self.fails:
            raise TimeoutError("no answer")
        return self.env.step(action)


class Sampler(gym.Env[Any, Any]):
    """Returns samples of its spaces; an episode has `length` steps, every third one ends by timeout."""

    def __init__(
        self, observation_space: gym.Space[Any], action_space: gym.Space[Any], length: int = 7
    ) -> None:
        self.observation_space = observation_space
        self.action_space = action_space
        self.length = length
        self.steps = 0
        self.episodes = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.steps = 0
        self.episodes += 1
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        done = self.steps == self.length
        timeout = done and self.episodes % 3 == 0
        return self.observation_space.sample(), 0.5 * self.steps, done and not timeout, timeout, {}


class Scripted(gym.Env[Any, Any]):
    """Returns `observe(step)` and `reward(step)`, even if they are not in its spaces."""

    def __init__(
        self,
        observe: Callable[[int], Any],
        observation_space: gym.Space[Any],
        action_space: gym.Space[Any] | None = None,
        *,
        reward: Callable[[int], Any] = lambda step: 1.0,
        info: Callable[[int], dict[str, Any]] = lambda step: {},
        length: int = 10,
    ) -> None:
        self.observation_space = observation_space
        self.action_space = action_space or gym.spaces.Discrete(3)
        self._observe, self._reward, self._info, self._length = observe, reward, info, length
        self._step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step = 0
        return self._observe(0), {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self._step += 1
        n = self._step
        return self._observe(n), self._reward(n), n >= self._length, False, self._info(n)


def same(a: Any, b: Any) -> bool:
    """Whether two values are equal in type, dtype, shape and bits, at any nesting."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray | np.generic):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def roll(env: gym.Env[Any, Any], steps: int, seed: int = 1) -> list[tuple[Any, ...]]:
    """Random steps with resets: (state, action, reward, terminal, timeout, next state) of each, copied."""
    import copy

    env.action_space.seed(seed)
    state, _ = env.reset(seed=seed)
    state = copy.deepcopy(state)
    taken = []
    for _ in range(steps):
        action = env.action_space.sample()
        after, reward, terminal, timeout, _ = env.step(action)
        after = copy.deepcopy(after)
        taken.append((state, copy.deepcopy(action), reward, terminal, timeout, after))
        state = after
        if terminal or timeout:
            state = copy.deepcopy(env.reset()[0])
    return taken


class Counter(gym.Env[Any, Any]):
    """Counts its steps from `start`."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, start: float = 0.0) -> None:
        self.start = start

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.value = self.start
        return np.array([self.value]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.value += 1
        return np.array([self.value]), 1.0, False, False, {}


class Winning(gym.Env[Any, Any]):
    """Says at its end whether it was won, as many goal environments do."""

    observation_space = gym.spaces.Discrete(10)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, key: str = "is_success") -> None:
        self.key = key

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return 0, {}

    def step(self, action: Any) -> Any:
        return 1, 1.0, True, False, {self.key: bool(action)}
