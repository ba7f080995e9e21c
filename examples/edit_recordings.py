"""Keep the good episodes of a recording: filter, sort, annotate, delete, split and save them."""

import gymnasium as gym

import tupli_mcap

with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), "all.mcap") as env:
    env.action_space.seed(1)
    env.reset(seed=1)
    for _ in range(3000):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()

dataset = tupli_mcap.open("all.mcap")
print("recorded ", dataset)

best = dataset.sort("return", descending=True)[0]
# the same as `tupli-mcap tag all.mcap --episodes best success=true note='the longest one'`
best.annotate(success=True, note="the longest one")
print("annotated", tupli_mcap.open("all.mcap").filter("metadata.success")[0].metadata)

# the same as `tupli-mcap delete all.mcap --filter 'return <= 25'`; tupli_mcap.restore_episodes("all.mcap") undoes it
print("deleted  ", dataset.filter("return <= 25").delete())

good = tupli_mcap.open("all.mcap").filter("end == 'terminal'")
print("good     ", good)
train, test = good.split(0.8, seed=0)
for name, part in (("train", train), ("test", test)):
    path = part.save(f"{name}.mcap")
    print("saved    ", tupli_mcap.open(path))

# the same as `tupli-mcap split train.mcap -o parts/train.mcap --episodes 10`
parts = tupli_mcap.split_recording("train.mcap", "parts/train.mcap", episodes=10)
print("split    ", *(f"{part.path} ({part.steps} steps)" for part in parts))
