"""The tutorial: from a custom environment to a policy trained offline on its recordings.

It stores a benchmark, records random steps, trains a policy on them with discrete CQL, tests the policy, and
cleans up. Run it with `tools/tutorial`, which first installs d3rlpy and PyTorch.
"""

from __future__ import annotations

import argparse
import io
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.wrappers import TimeLimit

from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.dataset import NumpyTupleParser, TupliDataset
from tupli_mcap.schema import ArtifactMetadata, EpisodeMetadataCallback, FilterEQ, RLTuple
from tupli_mcap.storage import FileStorage, TupliStorage

MAX_EPISODE_STEPS = 999
RANDOM_STEPS = 2_000
WIND_ROWS = 1_000  # one more than an episode has steps
DRAG = 5e-5  # change of velocity per step and m/s of head wind; the car's own force is 1e-3

# --- a custom environment ---


def write_wind(path: Path) -> None:
    """Write a CSV of the head wind in m/s at each step t = 0..999, rounded to a thousandth:

    2 + 1.2 sin(2 pi t / 250) + 0.8 sin(2 pi t / 37)

    a breeze that comes and goes, with gusts: never below 0 nor above 4.
    """
    t = np.arange(WIND_ROWS)
    speed = 2 + 1.2 * np.sin(2 * np.pi * t / 250) + 0.8 * np.sin(2 * np.pi * t / 37)
    pd.DataFrame({"step": t, "wind": speed.round(3)}).to_csv(path, index=False)


def read_wind(source: Path | io.BytesIO) -> pd.DataFrame:
    return pd.read_csv(source, index_col="step")


class CustomMountainCarEnv(MountainCarEnv):
    """MountainCar, slowed down by a head wind that is read from a CSV, a row a step."""

    def __init__(self, data_path: Path, render_mode: str | None = None) -> None:
        super().__init__(render_mode)
        self.data = read_wind(data_path)
        self.current_step = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self.current_step = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        position, velocity = self.state
        wind = self.data["wind"].iloc[self.current_step]
        self.state = (position, velocity - DRAG * wind * math.cos(position))
        self.current_step += 1
        return super().step(action)


# --- its data as an artifact ---


class MyTupliEnvWrapper(TupliEnvWrapper):
    """Keeps the wind beside the environment, where other benchmarks can use the same file."""

    def _serialize(self, env: Any) -> tuple[gym.Env, list[str]]:
        content = env.unwrapped.data.to_csv().encode()
        metadata = ArtifactMetadata(name="wind.csv", description="head wind (m/s) at each step")
        artifact = self.storage.store_artifact(artifact=content, metadata=metadata)
        env.unwrapped.data = artifact.id
        return env, [artifact.id]

    @classmethod
    def _deserialize(cls, env: Any, storage: TupliStorage) -> gym.Env:
        env.unwrapped.data = read_wind(io.BytesIO(storage.load_artifact(env.unwrapped.data)))
        return env


class MyCallback(EpisodeMetadataCallback):
    """Notes an episode's return, and that no expert played it."""

    def __init__(self, is_expert: bool = False) -> None:
        self.is_expert = is_expert
        self.reset()

    def reset(self) -> None:
        self.cum_reward = 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.cum_reward += tuple.reward
        return {"cum_eps_reward": self.cum_reward, "is_expert": self.is_expert}


def store_benchmark(storage: TupliStorage, wind: Path) -> str:
    """Store the environment; returns the benchmark's id."""
    env = TimeLimit(CustomMountainCarEnv(data_path=wind), max_episode_steps=MAX_EPISODE_STEPS)
    tupli_env = MyTupliEnvWrapper(env, storage=storage)
    tupli_env.store(name="windy-mountain-car", description="MountainCar slowed down by wind")
    return tupli_env.id


def list_benchmarks(place: str) -> None:
    """The same as `tupli-mcap list-benchmarks --storage PLACE` on the command line."""
    code = "from tupli_mcap.cli import main; main()"
    subprocess.run([sys.executable, "-c", code, "list-benchmarks", "--storage", place], check=True)


# --- recording ---


def record_random_steps(env: gym.Env, steps: int = RANDOM_STEPS, hold: int = 1, seed: int = 42) -> None:
    """A random policy's steps, each action kept for `hold` of them; the environment records them by itself."""
    np.random.seed(seed)
    env.reset(seed=seed)
    for step in range(steps):
        if step % hold == 0:
            action = np.int64(np.random.randint(low=0, high=3))
        _, _, done, truncated, _ = env.step(action)
        if done or truncated:
            print(f"Episode finished after {step + 1} timesteps")
            env.reset()


# --- offline training ---


def make_d3rlpy_dataset(dataset: TupliDataset) -> Any:
    """The dataset as d3rlpy's."""
    from d3rlpy.constants import ActionSpace
    from d3rlpy.dataset import MDPDataset

    obs, act, rew, terminal, timeout = dataset.convert_to_tensors(parser=NumpyTupleParser)
    return MDPDataset(
        observations=obs,
        actions=act,
        rewards=rew,
        terminals=terminal,
        timeouts=timeout,
        action_space=ActionSpace.DISCRETE,
        action_size=3,
    )


def make_algorithm() -> Any:
    """Discrete CQL. A value travels back by one step at each update of the target, and the flag is some 150
    steps away: hence many updates. Speeds are a twentieth of positions: hence the scaler."""
    from d3rlpy.algos import DiscreteCQLConfig
    from d3rlpy.models import VectorEncoderFactory
    from d3rlpy.preprocessing import StandardObservationScaler

    config = DiscreteCQLConfig(
        batch_size=64,
        alpha=0.1,
        learning_rate=5e-4,
        target_update_interval=50,
        encoder_factory=VectorEncoderFactory([64, 64]),
        observation_scaler=StandardObservationScaler(),
    )
    return config.create(device="cpu")


def train(d3rlpy_dataset: Any, steps: int, seed: int = 1) -> Any:
    """Fit an algorithm with `steps` gradient steps; returns it."""
    import d3rlpy

    d3rlpy.seed(seed)
    algo = make_algorithm()
    algo.fit(
        d3rlpy_dataset,
        n_steps=steps,
        n_steps_per_epoch=max(1, steps // 10),
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        show_progress=False,
    )
    return algo


def store_policy(storage: TupliStorage, algo: Any, benchmark_id: str) -> str:
    """Store the trained policy as an artifact that is linked to the benchmark; returns its id."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "policy.d3")
        algo.save(str(path))
        metadata = ArtifactMetadata(
            name="trained_cql_policy", description="Discrete CQL, trained offline", benchmark_id=benchmark_id
        )
        return storage.store_artifact(artifact=path.read_bytes(), metadata=metadata).id


def load_policy(storage: TupliStorage, benchmark_id: str) -> Any:
    """The policy that is linked to a benchmark. Loading one is running code: only do it with your own."""
    import d3rlpy

    (found,) = storage.list_artifacts(filter=FilterEQ(key="benchmark_id", value=benchmark_id))
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory, "policy.d3")
        path.write_bytes(storage.load_artifact(found.id))
        return d3rlpy.load_learnable(str(path), device="cpu")


def play(algo: Any, env: gym.Env, episodes: int = 10) -> list[int | None]:
    """Play episodes with seeds 0, 1, …: the number of steps to the flag of each, None where it was missed."""
    results: list[int | None] = []
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        steps, done, truncated = 0, False, False
        while not (done or truncated):
            action = np.int64(algo.predict(np.expand_dims(obs, axis=0))[0])
            obs, _, done, truncated, _ = env.step(action)
            steps += 1
        results.append(steps if done else None)
    return results


# --- all of it ---


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=20_000, help="gradient steps (default: %(default)s)")
    parser.add_argument(
        "--hold",
        type=int,
        default=30,
        help="steps that the random policy keeps an action for (default: %(default)s). With 1, as in PyTupli's "
        "introduction, no episode gets near the flag, and what can be learned from them is luck",
    )
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        follow(Path(directory), arguments.steps, arguments.hold)


def follow(directory: Path, steps: int, hold: int = 1) -> None:
    """Everything in order, in a storage that is made below `directory` and is empty again at the end."""
    write_wind(directory / "wind.csv")
    storage = FileStorage(directory / "storage")

    benchmark_id = store_benchmark(storage, directory / "wind.csv")
    list_benchmarks(str(storage.root))

    env = MyTupliEnvWrapper.load(storage=storage, benchmark_id=benchmark_id, metadata_callback=MyCallback())
    record_random_steps(env, hold=hold)

    dataset = TupliDataset(storage=storage).with_benchmark_filter(FilterEQ(key="id", value=env.id))
    for header in dataset.preview():
        print(f"{header.n_tuples} steps, {header.end}, {header.metadata}")
    dataset.load()
    print(dataset)

    start = time.perf_counter()
    algo = train(make_d3rlpy_dataset(dataset), steps)
    print(f"{steps} gradient steps took {time.perf_counter() - start:.0f} s")
    policy_id = store_policy(storage, algo, env.id)

    env.deactivate_recording()
    results = play(load_policy(storage, env.id), env)
    reached = [result for result in results if result is not None]
    print(f"The policy reached the flag in {len(reached)} of {len(results)} episodes; steps: {results}")
    env.close()

    storage.delete_artifact(policy_id)
    print(env.delete(delete_artifacts=True))
    left = [*storage.list_benchmarks(), *storage.list_artifacts(), *storage.list_episodes()]
    print(f"{len(left)} benchmarks, artifacts and episodes are left.")


if __name__ == "__main__":
    main()
