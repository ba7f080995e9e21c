"""Record Breakout with stacked frames: each frame is stored once, and comes back stacked."""

import ale_py
import gymnasium as gym
from gymnasium.wrappers import FrameStackObservation

import tupli_mcap

gym.register_envs(ale_py)
env = FrameStackObservation(gym.make("ALE/Breakout-v5", obs_type="grayscale"), 4)

with tupli_mcap.RecordEpisodes(env, "breakout.mcap", record_info=["lives"]) as env:
    env.action_space.seed(1)
    env.reset(seed=1)
    for _ in range(400):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()

dataset = tupli_mcap.open("breakout.mcap")
episode = dataset.sort("return", descending=True)[0]
print(dataset, "in", env.path.stat().st_size // 1000, "kB")
print("best:", episode, "states", episode.states.shape, episode.states.dtype)
print("lives left", [info["lives"] for info in episode.infos][::40])

batch = next(iter(dataset.loader(batch_size=32, seed=1)))
print(
    "a batch of transitions:",
    {name: tuple(batch[name].shape) for name in ("states", "actions", "next_states")},
)
