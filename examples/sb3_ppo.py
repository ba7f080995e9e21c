"""Record the training and the evaluation of Stable-Baselines3's PPO."""

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import tupli_mcap
from tupli_mcap.sb3 import VecRecordEpisodes

settings = {"n_steps": 256, "n_epochs": 4, "learning_rate": 1e-3}

train = make_vec_env("CartPole-v1", n_envs=4, seed=1)
with VecRecordEpisodes(train, "runs/", name="ppo", metadata=settings, split="train") as env:
    model = PPO("MlpPolicy", env, **settings, device="cpu", seed=1)
    model.learn(4_000)

test = make_vec_env("CartPole-v1", seed=100)
with VecRecordEpisodes(test, "runs/", name="ppo-eval", metadata=settings, split="eval") as env:
    evaluate_policy(model, env, n_eval_episodes=5)

recorded = tupli_mcap.open("runs/").filter("end != 'interrupted'")
for split in ("train", "eval"):
    returns = recorded.filter(f"run.split == {split!r}").returns
    print(f"{split}: {len(returns)} episodes, mean return {returns.mean():.1f}, best {returns.max():.0f}")
