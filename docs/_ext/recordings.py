"""The recordings that pages of how-tos work on: CartPole, balanced by hand in several ways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym

import tupli_mcap


def make(directory: Path) -> None:
    """Writes run.mcap, and runs/gain-0.0.mcap and two others, which differ in the gain of their policy."""
    record(directory / "run.mcap", 0.5, 0, 12, name="balance", metadata={"gain": 0.5}, tags=["baseline"])
    for seed, gain in enumerate((0.0, 0.1, 0.5), 1):
        run = {"name": f"gain-{gain}", "metadata": {"gain": gain, "seed": seed}}
        record(directory / "runs" / f"gain-{gain}.mcap", gain, seed, 8, **run)


def record(path: Path, gain: float, seed: int, episodes: int, **run: Any) -> None:
    """Episodes of a policy that pushes the way the pole falls; each fourth one is random."""
    env = gym.make("CartPole-v1", max_episode_steps=200)
    tilt = {"step_callback": lambda step: {"tilt": abs(float(step.state[2]))}}
    with tupli_mcap.RecordEpisodes(
        env, path, metadata_callback=lambda step: {"success": bool(step.timeout)}, **tilt, **run
    ) as recorder:
        recorder.action_space.seed(seed)
        for i in range(episodes):
            state, _ = recorder.reset(seed=100 * seed + i)
            done = False
            while not done:
                action = recorder.action_space.sample() if i % 4 == 0 else int(state[2] + gain * state[3] > 0)
                state, _, terminated, truncated, _ = recorder.step(action)
                done = terminated or truncated


if __name__ == "__main__":
    make(Path())
