"""PPO in one file, as CleanRL writes it, with every step recorded."""

import gymnasium as gym
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical

import tupli_mcap

ENVS, STEPS, UPDATES = 8, 128, 12
torch.manual_seed(1)

envs = gym.make_vec("CartPole-v1", num_envs=ENVS, vectorization_mode="sync")
envs = tupli_mcap.vector.RecordEpisodes(envs, "runs/", name="ppo-seed1", metadata={"lr": 2.5e-3, "seed": 1})
actor = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 2))
critic = nn.Sequential(nn.Linear(4, 64), nn.Tanh(), nn.Linear(64, 1))
optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=2.5e-3)

state, _ = envs.reset(seed=1)
state, done = torch.as_tensor(state), torch.zeros(ENVS)
for _ in range(UPDATES):
    rows = []
    for _ in range(STEPS):
        with torch.no_grad():
            policy, value = Categorical(logits=actor(state)), critic(state)[:, 0]
        action = policy.sample()
        after, reward, terminated, truncated, _ = envs.step(action.numpy())
        rows.append((state, action, policy.log_prob(action), value, torch.as_tensor(reward).float(), done))
        state, done = torch.as_tensor(after), torch.as_tensor(terminated | truncated).float()
    states, actions, log_probs, values, rewards, dones = map(torch.stack, zip(*rows, strict=True))
    with torch.no_grad():
        following, going_on, advantage = critic(state)[:, 0], 1 - done, torch.zeros(ENVS)
    advantages = torch.zeros_like(rewards)
    for t in reversed(range(STEPS)):
        delta = rewards[t] + 0.99 * following * going_on - values[t]
        advantages[t] = advantage = delta + 0.99 * 0.95 * going_on * advantage
        following, going_on = values[t], 1 - dones[t]
    valid = dones.flatten() == 0  # the call after an end is a reset, which ignores its action
    batch = [
        one.flatten(0, 1)[valid] for one in (states, actions, log_probs, advantages, advantages + values)
    ]
    for picked in (part for _ in range(4) for part in torch.randperm(len(batch[0])).split(256)):
        s, a, before, adv, target = (one[picked] for one in batch)
        policy = Categorical(logits=actor(s))
        ratio = (policy.log_prob(a) - before).exp()
        adv = (adv - adv.mean()) / (adv.std() + 1e-8)
        gain = torch.min(ratio * adv, ratio.clamp(0.8, 1.2) * adv).mean() + 0.01 * policy.entropy().mean()
        loss = 0.5 * (critic(s)[:, 0] - target).square().mean() - gain
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
envs.close()

run = tupli_mcap.open(envs.path)
print(run[0].run.name, run)
for part in np.array_split(run.sort("ended").returns, 6):
    print(f"{part.mean():6.1f} " + "#" * int(part.mean() / 4))
