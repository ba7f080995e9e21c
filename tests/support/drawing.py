"""Small, fast environments that render: each state has a picture of its own."""

from __future__ import annotations

import os
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np


def drawn(state: Any) -> Any:
    """The picture of a state: 8 x 12 pixels that no other state has."""
    seen = np.frombuffer(np.asarray(state, np.float64).tobytes(), np.uint8)
    return np.resize(seen, (8, 12, 3)).copy()


class Drawing(gym.Env[Any, Any]):
    """A walk; an episode ends after `length` steps, every third one by timeout."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, length: int = 6, render_mode: str | None = "rgb_array") -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gym.spaces.Discrete(3)
        self.render_mode = render_mode
        self.length = length
        self.episodes = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = self.np_random.normal(size=2)
        self.steps = 0
        self.episodes += 1
        return self.state.copy(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.state = self.state + np.array([float(action) - 1.0, self.np_random.normal()])
        self.steps += 1
        done = self.steps == self.length
        timeout = done and self.episodes % 3 == 0
        return self.state.copy(), float(self.state[0]), done and not timeout, timeout, {}

    def render(self) -> Any:
        return drawn(self.state)


class Drifting(Drawing):
    """A walk that changes from step `DRIFT` (an environment variable) on."""

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        state, reward, terminal, timeout, info = super().step(action)
        if "DRIFT" in os.environ and self.steps > int(os.environ["DRIFT"]):
            self.state = state = self.state + 1e-12
        return state.copy(), reward, terminal, timeout, info


class Blank(Drawing):
    """Takes no `render_mode`, as it draws nothing."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": []}

    def __init__(self) -> None:
        super().__init__(render_mode=None)
