"""Recorded episodes as tables: one row per episode, and one row per step."""

import gymnasium as gym

import tupli_mcap

with tupli_mcap.RecordEpisodes(gym.make("Pendulum-v1"), "pendulum.mcap") as env:
    env.action_space.seed(1)
    for seed in range(5):
        env.reset(seed=seed)
        truncated = False
        while not truncated:
            *_, truncated, _ = env.step(env.action_space.sample())

dataset = tupli_mcap.open("pendulum.mcap")

episodes = dataset.to_pandas("episodes").set_index("number")
print(episodes[["seed", "steps", "return", "end", "ended"]].sort_values("return", ascending=False), "\n")

steps = dataset.to_pandas()  # dimensions have the names that the environment documents
print("columns:", *steps.columns, sep="  ")

speed = steps["state.Angular Velocity"].abs()
print("\nfastest turn of each episode:", speed.groupby(steps["seed"]).max(), sep="\n")
print("\nreward by torque:", steps.groupby(steps["action.Torque"].round())["reward"].mean(), sep="\n")
