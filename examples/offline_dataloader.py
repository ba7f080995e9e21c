"""Behaviour cloning: windows of recorded steps, in shuffled batches of tensors."""

import gymnasium as gym
import torch
from torch import nn

import tupli_mcap

with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), "expert.mcap") as env:
    env.action_space.seed(1)
    for seed in range(40):
        state, _ = env.reset(seed=seed)
        done = False
        while not done:
            action = int(state[2] + 0.5 * state[3] > 0)  # pushes the way the pole falls
            if seed % 4 == 0:
                action = env.action_space.sample()
            state, _, terminated, truncated, _ = env.step(action)
            done = terminated or truncated

dataset = tupli_mcap.open("expert.mcap")
print("recorded", dataset, "with returns from", dataset.returns.min(), "to", dataset.returns.max())
train, test = dataset.filter("return > 100").split(0.8, seed=0)

scale = train.stats(["states"])["states"]
mean, std = (torch.as_tensor(value, dtype=torch.float32) for value in (scale.mean, scale.std))
inputs, outputs = 8 * train.observation_space.shape[0], int(train.action_space.n)
policy = nn.Sequential(nn.Linear(inputs, 64), nn.ReLU(), nn.Linear(64, outputs))
optimizer = torch.optim.Adam(policy.parameters(), lr=1e-3)


def logits(batch):
    """The action to take at the end of each window of 8 states."""
    return policy(((batch["states"] - mean) / std).flatten(1))


for epoch in range(3):
    for batch in train.loader(length=8, batch_size=256, fields=["states", "actions"], seed=epoch):
        loss = nn.functional.cross_entropy(logits(batch), batch["actions"][:, -1])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        batch = next(iter(test.loader(length=8, batch_size=10_000)))
        right = (logits(batch).argmax(1) == batch["actions"][:, -1]).float().mean()
    print(f"epoch {epoch}: loss {loss:.3f}, right about {right:.1%} of the actions of other episodes")
