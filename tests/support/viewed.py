"""Recordings like those of users, for the tests of the viewer and the pictures of the README."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap import RecordEpisodes
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes

Policy = Callable[[Any], Any]


def rollout(env: gym.Env[Any, Any], policy: Policy, episodes: int, seed: int = 1) -> None:
    """Whole episodes, seeded one after another."""
    env.action_space.seed(seed)
    for episode in range(episodes):
        state, _ = env.reset(seed=seed + episode)
        over = False
        while not over:
            state, _, terminated, truncated, _ = env.step(policy(state))
            over = terminated or truncated


def cart_pole(path: Path, episodes: int = 6) -> Path:
    """Poles that are balanced for longer and longer, the last ones until the time limit."""
    noise = np.random.default_rng(1)
    with RecordEpisodes(gym.make("CartPole-v1", max_episode_steps=300), path) as env:
        for episode in range(episodes):
            slip = 0.6 * (1 - episode / (episodes - 1)) ** 2

            def policy(state: Any, slip: float = slip) -> int:
                push = state[2] + 0.4 * state[3] + 0.02 * state[0] + 0.04 * state[1] > 0
                return int(push) if noise.random() > slip else int(noise.integers(2))

            rollout(env, policy, 1, seed=episode)
    return path


def atari(path: Path, episodes: int = 2, steps: int = 250) -> Path:
    """Breakout from its pixels: the paddle follows the ball."""
    import ale_py

    gym.register_envs(ale_py)

    def follow(screen: Any) -> int:
        field = screen[93:188, 8:152, 0]
        ball = np.argwhere(field == 200)
        paddle = np.argwhere(screen[189:193, 8:152, 0] == 200)
        if not len(ball) or not len(paddle):
            return 1
        return 2 if ball[:, 1].mean() > paddle[:, 1].mean() else 3

    env = gym.make("ALE/Breakout-v5", frameskip=4, repeat_action_probability=0.0, max_episode_steps=steps)
    with RecordEpisodes(env, path) as recorder:
        rollout(recorder, follow, episodes)
    return path


class Courier(gym.Env[Any, Any]):
    """A small robot brings parcels through a room with pillars: pose, lidar, a camera, what it does, and why."""

    metadata = {"render_modes": [], "render_fps": 20}
    BEAMS = 24
    PILLARS = np.array([[0.3, 0.35], [0.7, 0.6], [0.35, 0.75], [0.72, 0.2]])
    RADIUS = 0.08

    def __init__(self) -> None:
        box = gym.spaces.Box
        self.observation_space = gym.spaces.Dict(
            {
                "position": box(0.0, 1.0, (2,)),
                "velocity": box(-0.05, 0.05, (2,)),
                "goal": box(0.0, 1.0, (2,)),
                "battery": box(0.0, 100.0, (1,)),
                "lidar": box(0.0, 1.5, (self.BEAMS,)),
                "camera": box(0, 255, (64, 64, 3), np.uint8),
                "carrying": gym.spaces.Discrete(2),
                "task": gym.spaces.Text(32),
            }
        )
        self.action_space = gym.spaces.Dict(
            {"thrust": box(-1.0, 1.0, (2,)), "gripper": gym.spaces.Discrete(3)}
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.position = self.np_random.uniform(0.05, 0.15, 2)
        self.velocity = np.zeros(2)
        self.goals = [np.array([0.9, 0.85]), np.array([0.1, 0.9])]
        self.battery = 100.0
        self.carrying = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        thrust = np.asarray(action["thrust"], float)
        before = np.linalg.norm(self.goals[0] - self.position)
        self.velocity = np.clip(0.8 * self.velocity + 0.01 * thrust, -0.05, 0.05)
        ahead = np.clip(self.position + self.velocity, 0.0, 1.0)
        hit = bool((np.linalg.norm(self.PILLARS - ahead, axis=1) < self.RADIUS).any())
        if hit:
            self.velocity *= -0.5
        else:
            self.position = ahead
        self.battery -= 0.1 + 0.3 * float(np.abs(thrust).sum())
        reward = 10 * float(before - np.linalg.norm(self.goals[0] - self.position)) - hit
        there = bool(np.linalg.norm(self.goals[0] - self.position) < 0.06)
        delivered = False
        if there and not self.carrying and action["gripper"] == 1:
            self.carrying, reward = 1, reward + 5
            self.goals.pop(0)
        elif there and self.carrying and action["gripper"] == 2:
            self.carrying, reward, delivered = 0, reward + 10, True
        return self._seen(), reward, delivered, self.battery <= 0, {}

    def _seen(self) -> dict[str, Any]:
        single = np.float32
        return {
            "position": self.position.astype(single),
            "velocity": self.velocity.astype(single),
            "goal": self.goals[0].astype(single),
            "battery": np.array([max(self.battery, 0.0)], single),
            "lidar": self._lidar().astype(single),
            "camera": self._camera(),
            "carrying": self.carrying,
            "task": "deliver the parcel" if self.carrying else "fetch the parcel",
        }

    def _lidar(self) -> Any:
        angles = np.linspace(-np.pi, np.pi, self.BEAMS, endpoint=False)
        reach = np.linspace(0.0, 1.5, 151)
        points = self.position + reach[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
        blocked = ((points < 0) | (points > 1)).any(2)
        apart = np.linalg.norm(points[:, :, None] - self.PILLARS, axis=3)
        blocked |= (apart < self.RADIUS).any(2)
        return reach[np.argmax(blocked, axis=0)]

    def _camera(self) -> Any:
        """The room from above, the robot with its parcel, and the goal."""
        grid = np.stack(np.meshgrid(np.linspace(0, 1, 64), np.linspace(1, 0, 64)), 2)
        picture = np.full((64, 64, 3), (36, 40, 48), np.uint8)
        for pillar in self.PILLARS:
            picture[np.linalg.norm(grid - pillar, axis=2) < self.RADIUS] = (120, 110, 100)
        picture[np.linalg.norm(grid - self.goals[0], axis=2) < 0.05] = (90, 200, 110)
        picture[np.linalg.norm(grid - self.position, axis=2) < 0.05] = (240, 150, 40)
        if self.carrying:
            picture[np.abs(grid - self.position).max(2) < 0.02] = (250, 250, 250)
        return picture


def head_for_goal(state: Any, noise: np.random.Generator) -> Any:
    """The action of a courier that heads for its goal and around pillars, a little unsteadily."""
    way = state["goal"] - state["position"]
    apart = state["position"] - Courier.PILLARS
    distance = np.linalg.norm(apart, axis=1)
    push = (apart / distance[:, None] * np.exp(-((distance - 0.08) / 0.05))[:, None]).sum(0)
    thrust = way / max(float(np.linalg.norm(way)), 0.15) + push + noise.normal(0, 0.25, 2)
    close = np.linalg.norm(way) < 0.06
    gripper = (2 if state["carrying"] else 1) if close else 0
    return {"thrust": np.clip(thrust, -1, 1).astype(np.float32), "gripper": gripper}


def courier(path: Path, episodes: int = 3) -> Path:
    """A courier's trips."""
    noise = np.random.default_rng(2)
    labels = {
        **{f"state[{name!r}]": ("x", "y") for name in ("position", "velocity", "goal")},
        "state.carrying": ("empty", "loaded"),
        "action.thrust": ("x", "y"),
        "action.gripper": ("rest", "grasp", "release"),
    }
    with RecordEpisodes(gym.wrappers.TimeLimit(Courier(), 200), path, labels=labels) as env:
        rollout(env, lambda state: head_for_goal(state, noise), episodes)
    return path


class Legged(gym.Env[Any, Any]):
    """A gait in many joints: a wide state, as in robotics."""

    def __init__(self, joints: int = 40) -> None:
        self.observation_space = gym.spaces.Box(-2.0, 2.0, (joints,), np.float64)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.time = 0
        return self._joints(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        self.time += 1
        return self._joints(), float(np.cos(self.time / 9)), False, self.time == 120, {}

    def _joints(self) -> Any:
        phase = np.arange(self.observation_space.shape[0]) * 0.4
        return np.sin(self.time / 8 + phase) + self.np_random.normal(0, 0.1, len(phase))


def legged(path: Path) -> Path:
    """Forty dimensions."""
    with RecordEpisodes(Legged(), path) as env:
        rollout(env, lambda _: env.action_space.sample(), 3)
    return path


class Talk(gym.Env[Any, Any]):
    """Sentences in, sentences out."""

    SAID = ("How do I open the door?", "Where is the key?", "Is it under the mat?", "Thank you.")

    def __init__(self) -> None:
        self.observation_space = gym.spaces.Text(64, charset="".join(map(chr, range(32, 127))))
        self.action_space = gym.spaces.Text(64, charset="".join(map(chr, range(32, 127))))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        super().reset(seed=seed)
        self.turn = 0
        return self.SAID[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, Any]:
        self.turn += 1
        return self.SAID[min(self.turn, 3)], float(self.turn == 3), self.turn == 4, False, {}


def talk(path: Path) -> Path:
    """Text, observed and acted."""
    answers = dict(
        zip(Talk.SAID, ("With a key.", "Not in my pocket.", "Yes, look there!", "Good bye."), strict=True)
    )
    with RecordEpisodes(Talk(), path) as env:
        rollout(env, answers.__getitem__, 3)
    return path


def pendulums(path: Path, number: int = 4) -> Path:
    """A vector environment."""
    with RecordVectorEpisodes(
        gym.make_vec("Pendulum-v1", num_envs=number, max_episode_steps=80), path
    ) as envs:
        envs.reset(seed=1)
        envs.action_space.seed(1)
        for _ in range(170):
            envs.step(envs.action_space.sample())
    return path
