"""What is recorded of Stable-Baselines3's environments is what an independent wrapper sees."""

from __future__ import annotations

import copy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Fails, Sampler, Scripted, same
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from tupli_mcap import (
    RecordEpisodes,
    Recording,
    RecordingError,
    StepError,
    TupliEnvWrapper,
    open as open_dataset,
    verify_recording,
)
from tupli_mcap.reexecute import certify
from tupli_mcap.vector import RecordEpisodes as RecordVector

pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
)

from tupli_mcap.sb3 import VecRecordEpisodes

DICT = spaces.Dict(
    {
        "camera": spaces.Box(0, 255, (40, 40, 3), np.uint8),
        "pose": spaces.Box(-1, 1, (2,)),
        "gear": spaces.Discrete(4),
    }
)
N = 3


class Witness(VecEnvWrapper):
    """Keeps a copy of every episode of every sub-environment: its states, actions, rewards, end and final state."""

    def __init__(self, venv: Any) -> None:
        super().__init__(venv)
        self.episodes: list[list[dict[str, Any]]] = [[] for _ in range(venv.num_envs)]

    def reset(self) -> Any:
        found = copy.deepcopy(self.venv.reset())
        for i, episodes in enumerate(self.episodes):
            self._leave(i, "interrupted")
            episodes.append({"states": [at(found, i)], "actions": [], "rewards": [], "end": "interrupted"})
        return found

    def step_async(self, actions: Any) -> None:
        self.actions = copy.deepcopy(actions)
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        states, rewards, dones, infos = self.venv.step_wait()
        for i, episodes in enumerate(self.episodes):
            running, state = episodes[-1], at(copy.deepcopy(states), i)
            running["actions"].append(self.actions[i])
            running["rewards"].append(rewards[i])
            if not dones[i]:
                running["states"].append(state)
                continue
            running["states"].append(copy.deepcopy(infos[i]["terminal_observation"]))
            self._leave(i, "timeout" if infos[i]["TimeLimit.truncated"] else "terminal")
            episodes.append({"states": [state], "actions": [], "rewards": [], "end": "interrupted"})
        return states, rewards, dones, infos

    def _leave(self, i: int, end: str) -> None:
        if self.episodes[i]:
            self.episodes[i][-1]["end"] = end

    def check(self, path: Path) -> Recording:
        """The recording holds the same."""
        assert verify_recording(path).ok
        recording = Recording(path)
        for i, expected in enumerate(self.episodes):
            found = [episode for episode in recording.episodes if episode.env == i]
            expected = [episode for episode in expected if episode["actions"]]
            assert [episode.end for episode in found] == [episode["end"] for episode in expected]
            for one, other in zip(found, expected, strict=True):
                assert np.array_equal(one.actions, other["actions"])
                assert one.rewards.tolist() == [float(reward) for reward in other["rewards"]]
                for k, state in enumerate([*(at(one.states, k) for k in range(len(one))), one.final_state]):
                    assert same_values(state, other["states"][k]), (i, k)
        return recording


def at(states: Any, i: int) -> Any:
    """One of a batch of states."""
    return {key: one[i] for key, one in states.items()} if isinstance(states, dict) else states[i]


def same_values(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same_values(one[key], other[key]) for key in one)
    return same(np.asarray(one), np.asarray(other, np.asarray(one).dtype))


def roll(venv: Any, steps: int) -> None:
    """Random actions, with a reset in between."""
    venv.action_space.seed(1)
    for _ in range(2):
        venv.reset()
        for _ in range(steps // 2):
            venv.step(np.array([venv.action_space.sample() for _ in range(venv.num_envs)]))


def sampler(observation: gym.Space[Any], action: gym.Space[Any]) -> Callable[..., gym.Env[Any, Any]]:
    return lambda **kwargs: Sampler(observation, action)


BOX = spaces.Box(-1, 1, (3,))
MADE: list[Any] = [
    "CartPole-v1",
    "Pendulum-v1",
    sampler(DICT, spaces.Discrete(3)),
    sampler(spaces.Discrete(9), BOX),
]
NAMES = ["terminals", "truncations", "dict", "discrete"]


@pytest.mark.parametrize("env", MADE, ids=NAMES)
def test_random_rollouts(tmp_path: Path, env: Any) -> None:
    witness = Witness(make_vec_env(env, n_envs=N, seed=5))
    with VecRecordEpisodes(witness, tmp_path / "run.mcap") as venv:
        roll(venv, 450)
    recording = witness.check(tmp_path / "run.mcap")
    assert recording.n_steps == N * 450
    assert [episode.seed for episode in recording.episodes[:N]] == [5, 6, 7]
    ends = {"CartPole-v1": {"terminal"}, "Pendulum-v1": {"timeout"}}.get(str(env), {"terminal", "timeout"})
    assert {episode.end for episode in recording.episodes} == {*ends, "interrupted"}


@pytest.mark.parametrize(
    "env", ["CartPole-v1", "Pendulum-v1", sampler(DICT, BOX)], ids=["cartpole", "pendulum", "dict"]
)
def test_ppo(tmp_path: Path, env: Any) -> None:
    witness = Witness(make_vec_env(env, n_envs=4, seed=1))
    with VecRecordEpisodes(witness, tmp_path / "run.mcap") as venv:
        policy = "MlpPolicy" if isinstance(env, str) else "MultiInputPolicy"
        model = PPO(policy, venv, n_steps=125, batch_size=125, n_epochs=1, device="cpu")
        model.learn(1000)
        model.learn(1000, reset_num_timesteps=False)
    assert witness.check(tmp_path / "run.mcap").n_steps == 2000


def test_processes(tmp_path: Path) -> None:
    forked = {"start_method": "fork"}  # others import PyTorch anew
    venv = make_vec_env("CartPole-v1", n_envs=2, seed=5, vec_env_cls=SubprocVecEnv, vec_env_kwargs=forked)
    witness = Witness(venv)
    with VecRecordEpisodes(witness, f"{tmp_path}/runs/") as venv:
        assert venv.path.name.startswith("CartPole-v1_")
        venv.set_options({"low": -0.01, "high": 0.01})
        roll(venv, 100)
    recording = witness.check(venv.path)
    assert [episode.options for episode in recording.episodes[:3]] == [{"low": -0.01, "high": 0.01}] * 2 + [
        None
    ]
    assert recording.benchmark.record.name == "CartPole-v1"
    assert recording.benchmark.record.spec["additional_wrappers"] == []


def test_inside_and_around_other_wrappers(tmp_path: Path) -> None:
    inner = Witness(make_vec_env("Pendulum-v1", n_envs=N, seed=5))
    raw = VecRecordEpisodes(inner, tmp_path / "raw.mcap")
    outer = Witness(VecNormalize(raw))
    with VecRecordEpisodes(outer, tmp_path / "normalized.mcap") as venv:
        roll(venv, 450)
    states = [witness.check(path).read().states for witness, path in ((inner, raw.path), (outer, venv.path))]
    assert not np.array_equal(*states)


def test_stacked_frames_are_stored_once(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (16, 16, 1), np.uint8)
    witness = Witness(VecFrameStack(make_vec_env(sampler(space, spaces.Discrete(2)), n_envs=2, seed=1), 4))
    with VecRecordEpisodes(witness, tmp_path / "run.mcap") as venv:
        roll(venv, 60)
    recording = witness.check(tmp_path / "run.mcap")
    assert recording.layout.stacks


def test_infos_of_steps_and_resets(tmp_path: Path) -> None:
    class Telling(Sampler):
        def reset(self, **kwargs: Any) -> Any:
            return super().reset(**kwargs)[0], {"start": self.episodes}

        def step(self, action: Any) -> Any:
            return *super().step(action)[:4], {"n": self.steps}

    witness = Witness(DummyVecEnv([lambda: Telling(BOX, BOX)] * 2))
    with VecRecordEpisodes(
        witness, tmp_path / "run.mcap", record_info=True, step_callback=lambda step: {"i": step.env}
    ) as venv:
        venv.seed(3)
        roll(venv, 40)
    for episode in witness.check(tmp_path / "run.mcap").episodes:
        assert episode.reset_info["start"] >= 1
        last = {"TimeLimit.truncated": episode.end == "timeout"}
        expected = [{"n": k + 1, "i": episode.env} for k in range(len(episode))]
        assert [{key: info[key] for key in ("n", "i")} for info in episode.infos] == expected
        assert {**episode.infos[-1]} == {**expected[-1], **last}


def test_final_states_of_another_dtype_are_cast_as_the_others_are(tmp_path: Path) -> None:
    space = spaces.Box(-np.inf, np.inf, (2,))
    made = [lambda: Scripted(lambda step: np.full(2, step / 3), space, length=3)] * 2
    with VecRecordEpisodes(DummyVecEnv(made), tmp_path / "run.mcap") as venv:
        roll(venv, 20)
    finals = [
        episode.final_state
        for episode in Recording(tmp_path / "run.mcap").episodes
        if episode.end == "terminal"
    ]
    assert all(np.array_equal(state, np.full(2, 1, np.float32)) for state in finals)


def test_both_ends_at_once_are_a_terminal(tmp_path: Path) -> None:
    venv = DummyVecEnv(
        [lambda: TimeLimit(Scripted(lambda step: np.zeros(2), spaces.Box(-1, 1, (2,)), length=5), 5)]
    )
    with VecRecordEpisodes(venv, tmp_path / "run.mcap") as venv:
        roll(venv, 20)
    assert {episode.end for episode in Recording(tmp_path / "run.mcap").episodes} == {"terminal"}


def test_a_step_that_raises_is_followed_by_a_reset(tmp_path: Path) -> None:
    last = Fails(Sampler(BOX, BOX))
    venv = DummyVecEnv([lambda: Sampler(BOX, BOX), lambda: last])
    with VecRecordEpisodes(venv, tmp_path / "run.mcap") as venv:
        action = np.stack([BOX.sample()] * 2)
        venv.reset()
        venv.step(action)
        last.fails = True
        with pytest.raises(TimeoutError, match="no answer"):
            venv.step(action)
        last.fails = False
        with pytest.raises(StepError, match="call env.reset"):
            venv.step(action)
        venv.reset()
        venv.step(action)
    found = Recording(tmp_path / "run.mcap").episodes
    assert [(len(episode), episode.end) for episode in found] == [(1, "interrupted")] * 4


def test_an_environment_without_final_states(tmp_path: Path) -> None:
    class Forgetful(VecEnvWrapper):
        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            *result, infos = self.venv.step_wait()
            return *result, [{} for _ in infos]

    venv = VecRecordEpisodes(Forgetful(make_vec_env("CartPole-v1", n_envs=2, seed=1)), tmp_path / "a.mcap")
    with pytest.raises(StepError, match="expected the final state of sub-environment"):
        roll(venv, 100)
    venv.close()
    venv = Forgetful(make_vec_env("CartPole-v1", n_envs=2, seed=1))
    with VecRecordEpisodes(venv, tmp_path / "b.mcap", autoreset_mode="SameStep") as recorded:
        with pytest.warns(UserWarning, match="without final states"):
            roll(recorded, 100)
    assert {episode.end for episode in Recording(tmp_path / "b.mcap").episodes} == {"terminal", "interrupted"}


def test_frames(tmp_path: Path) -> None:
    with VecRecordEpisodes(make_vec_env("CartPole-v1", n_envs=2), tmp_path / "run.mcap", frames=5) as venv:
        roll(venv, 20)
    assert Recording(tmp_path / "run.mcap").episodes[0].frames[0].shape == (400, 600, 3)


def test_rewards_in_the_precision_of_a_vec_env_agree(tmp_path: Path) -> None:
    """`DummyVecEnv` rounds rewards to float32."""
    path = tmp_path / "run.mcap"
    with VecRecordEpisodes(make_vec_env("Pendulum-v1", n_envs=2, seed=1), path) as venv:
        roll(venv, 30)
    assert certify(path).agrees
    open_dataset(path).map(lambda episode: np.nextafter(episode.rewards, 1), tmp_path / "other.mcap")
    assert certify(tmp_path / "other.mcap").first.leaf == "reward"


def test_evaluation(tmp_path: Path) -> None:
    train = VecRecordEpisodes(make_vec_env("CartPole-v1", n_envs=2, seed=1), f"{tmp_path}/train/")
    test = VecRecordEpisodes(make_vec_env("CartPole-v1", seed=2), f"{tmp_path}/eval/", split="eval")
    model = PPO("MlpPolicy", VecNormalize(train), n_steps=64, n_epochs=1, device="cpu")
    model.learn(
        256, EvalCallback(VecNormalize(test, training=False), n_eval_episodes=2, eval_freq=64, verbose=0)
    )
    train.close(), test.close()
    assert open_dataset(tmp_path / "train").n_steps == 256
    assert len(open_dataset(tmp_path / "eval").filter("run.split == 'eval'")) >= 2


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
def test_a_file_of_each_sub_environment(tmp_path: Path, kind: Any) -> None:
    given = {"path": tmp_path / "runs", "mode": "x"}
    given["path"].mkdir()
    venv = make_vec_env(
        "CartPole-v1", n_envs=N, seed=5, vec_env_cls=kind, wrapper_class=RecordEpisodes, wrapper_kwargs=given
    )
    roll(venv, 100)
    venv.close()
    files = [Recording(path) for path in (tmp_path / "runs").iterdir()]
    assert sorted(one.episodes[0].seed for one in files) == [5, 6, 7]
    assert [one.n_steps for one in files] == [100] * N


def test_one_path_of_many_sub_environments_names_the_directory(tmp_path: Path) -> None:
    given = {"path": tmp_path / "run.mcap"}
    with pytest.raises(RecordingError, match="a directory gets a new file each time"):
        make_vec_env("CartPole-v1", n_envs=2, wrapper_class=RecordEpisodes, wrapper_kwargs=given)


def test_wrong_pairings_name_the_right_one(tmp_path: Path) -> None:
    class Parallel:
        __module__ = "pettingzoo.utils.env"

    path, cartpole = tmp_path / "run.mcap", gym.make("CartPole-v1")
    venv: Any = make_vec_env("CartPole-v1")
    for wrapper, env, message in (
        (
            RecordEpisodes,
            venv,
            "expected a single environment, found the VecEnv DummyVecEnv.*sb3.VecRecordEpisodes",
        ),
        (
            RecordVector,
            venv,
            "expected a vector environment, found the VecEnv DummyVecEnv.*sb3.VecRecordEpisodes",
        ),
        (
            VecRecordEpisodes,
            cartpole,
            "expected a VecEnv of Stable-Baselines3, found the single .*tupli_mcap.Record",
        ),
        (
            VecRecordEpisodes,
            gym.make_vec("CartPole-v1"),
            "found the vector environment .*tupli_mcap.vector.Record",
        ),
        (
            RecordEpisodes,
            gym.make_vec("CartPole-v1"),
            "found the vector environment .*tupli_mcap.vector.Record",
        ),
        (
            RecordEpisodes,
            Parallel(),
            r"the PettingZoo environment Parallel; there is no recorder of several agents yet, .*EpisodeWriter",
        ),
        (RecordEpisodes, "CartPole-v1", r"found 'CartPole-v1'; make it: gymnasium.make\('CartPole-v1'\)"),
        (RecordVector, "CartPole-v1", r"make it: gymnasium.make_vec\('CartPole-v1'\)"),
        (RecordVector, None, "found NoneType, which is no gymnasium.Env"),
        (RecordEpisodes, lambda: cartpole, "found function <lambda>; give the environment that it makes"),
        (TupliEnvWrapper, Parallel(), "there is no recorder of several agents yet"),
    ):
        with pytest.raises(RecordingError, match=message):
            wrapper(env, path)
    assert not path.exists()


def test_an_unknown_option_is_one_of_the_class_that_was_called(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"^VecRecordEpisodes\(\) has no option 'nmae' \(did you mean 'name'"):
        VecRecordEpisodes(make_vec_env("CartPole-v1", 2), tmp_path, nmae="ppo")


def test_without_stable_baselines3_the_extra_is_named() -> None:
    code = "import sys; sys.modules['stable_baselines3.common.monitor'] = None\nimport tupli_mcap; tupli_mcap.sb3"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "MissingExtraError: tupli_mcap.sb3 needs stable-baselines3" in done.stderr
    assert "[sb3]" in done.stderr
