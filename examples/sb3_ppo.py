"""PPO of Stable-Baselines3, trained and evaluated; both are recorded."""

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import tupli_mcap
from tupli_mcap.sb3 import VecRecordEpisodes

with VecRecordEpisodes(make_vec_env("CartPole-v1", n_envs=4, seed=1), "runs/train/") as env:
    model = PPO("MlpPolicy", env, n_steps=256, n_epochs=4, learning_rate=1e-3, device="cpu", seed=1)
    model.learn(4_000)

with VecRecordEpisodes(make_vec_env("CartPole-v1", seed=100), "runs/eval/") as env:
    evaluate_policy(model, env, n_eval_episodes=5)

train, test = tupli_mcap.open("runs/train/"), tupli_mcap.open("runs/eval/")
print(train, "\n  best return", train.returns.max())
print(test, "\n  mean return", test.filter("end != 'interrupted'").returns.mean())
