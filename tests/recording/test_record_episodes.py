"""The wrapper: what it records of real environments, what it leaves alone, and how episodes end."""

from __future__ import annotations

import gc
import inspect
import re
import subprocess
import sys
import threading
import warnings
from contextlib import nullcontext
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from environments import Sampler, Scripted, roll, same
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from interruptions import Counting
from sample_spaces import SPACES, space_id

from tupli_mcap import (
    EpisodeData,
    EpisodeWriter,
    RecordEpisodes,
    Recording,
    RecordingError,
    SpaceError,
    StepError,
    verify_recording,
    write_recording,
)
from tupli_mcap.recording.write.options import RecordOptions
from tupli_mcap.reexecute import certify
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes as RecordVectorEpisodes

BOX = spaces.Box(-1.0, 1.0, (2,), np.float32)


def check_against(path: Path, taken: list[tuple[Any, ...]]) -> Recording:
    """Every step of the recording is the one taken, next states included."""
    recording = Recording(path)
    steps = [(step, episode, i) for episode in recording.episodes for i, step in enumerate(episode)]
    assert len(steps) == len(taken)
    for (step, _, _), (state, action, reward, terminal, timeout, _) in zip(steps, taken, strict=True):
        assert same(step.state, state)
        assert same(step.action, action)
        assert step.reward == reward
        assert (step.terminal, step.timeout) == (terminal, timeout)
    at = 0
    for episode in recording.episodes:
        at += len(episode)
        assert same(episode.final_state, taken[at - 1][5])
    return recording


@pytest.mark.parametrize("side", ["state", "action"])
@pytest.mark.parametrize("space", SPACES, ids=space_id)
def test_every_space_comes_back_exactly(tmp_path: Path, space: gym.Space[Any], side: str) -> None:
    other = spaces.Discrete(3, start=-1)
    env = Sampler(space, other) if side == "state" else Sampler(other, space)
    with RecordEpisodes(env, tmp_path / "r.mcap", chunk_size=1500) as recorded:
        taken = roll(recorded, 23)
    recording = check_against(tmp_path / "r.mcap", taken)
    assert (recording.observation_space, recording.action_space) == (env.observation_space, env.action_space)
    assert [episode.end for episode in recording.episodes] == [
        "terminal",
        "terminal",
        "timeout",
        "interrupted",
    ]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize(
    "env_id", ["CartPole-v1", "MountainCarContinuous-v0", "FrozenLake-v1", "Blackjack-v1"]
)
def test_real_environments(tmp_path: Path, env_id: str, compression: str) -> None:
    path = tmp_path / "r.mcap"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with RecordEpisodes(gym.make(env_id), path, compression=compression, chunk_size=4000) as env:
            taken = roll(env, 300)
    recording = Recording(path)
    columns = recording.read(fields=["rewards", "terminals", "timeouts"])
    assert columns.rewards.tolist() == [step[2] for step in taken]
    assert columns.terminals.tolist() == [step[3] for step in taken]
    assert columns.timeouts.tolist() == [step[4] for step in taken]
    states = [step.state for episode in recording.episodes for step in episode]
    assert all(np.array_equal(a, b) for a, b in zip(states, [step[0] for step in taken], strict=True))


def test_the_policy_sees_the_same_objects(tmp_path: Path) -> None:
    class Keeper(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            self.last = self.env.step(action)
            return self.last

    keeper = Keeper(gym.make("CartPole-v1"))
    with RecordEpisodes(keeper, tmp_path / "r.mcap") as env:
        env.reset(seed=1)
        assert env.step(0) is keeper.last
        assert env.spec is keeper.spec
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "s.mcap") as env:
        assert env.spec is not None
        assert isinstance(gym.make(env.spec).unwrapped, type(env.unwrapped))


def test_gymnasiums_own_check_passes(tmp_path: Path) -> None:
    env = RecordEpisodes(gym.make("CartPole-v1", disable_env_checker=True).unwrapped, tmp_path / "r.mcap")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about wrappers and infinite bounds
        check_env(env, skip_render_check=True, skip_close_check=True)
    env.close()
    assert Recording(tmp_path / "r.mcap").n_steps > 0


def test_under_and_over_other_wrappers(tmp_path: Path) -> None:
    inner = gym.wrappers.RescaleAction(gym.make("MountainCarContinuous-v0"), np.float32(-2), np.float32(2))
    env = gym.wrappers.RecordEpisodeStatistics(RecordEpisodes(inner, tmp_path / "r.mcap"))
    taken = roll(env, 50)
    env.close()
    check_against(tmp_path / "r.mcap", taken)


@pytest.mark.parametrize("chunk_size", [1000, 200_000])
def test_large_arrays(tmp_path: Path, chunk_size: int) -> None:
    space = spaces.Dict(
        {
            "a": spaces.Box(-1, 1, (3,), np.float32),
            "large": spaces.Box(-1, 1, (700,), np.float64),
            "larger": spaces.Box(0, 255, (80, 70), np.uint8),
        }
    )
    with RecordEpisodes(Sampler(space, space), tmp_path / "r.mcap", chunk_size=chunk_size) as env:
        taken = roll(env, 40)
    check_against(tmp_path / "r.mcap", taken)
    last = spaces.Tuple((spaces.Discrete(3), spaces.Box(-1, 1, (1000,), np.float32)))
    with RecordEpisodes(Sampler(last, last), tmp_path / "s.mcap", chunk_size=chunk_size) as env:
        taken = roll(env, 40)
    check_against(tmp_path / "s.mcap", taken)


def test_environments_may_reuse_their_arrays(tmp_path: Path) -> None:
    buffer = np.zeros(2, np.float32)

    def observe(step: int) -> Any:
        buffer[:] = step / 16
        return buffer

    with RecordEpisodes(Scripted(observe, BOX), tmp_path / "r.mcap") as env:
        env.reset()
        for _ in range(10):
            env.step(0)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert (episode.states[:, 0] * 16).tolist() == list(range(10))
    assert (episode.final_state * 16).tolist() == [10, 10]


# ---- values that stray from their space


def test_float64_observations_are_kept_with_one_warning(tmp_path: Path) -> None:
    env = Scripted(lambda step: np.array([0.1, step]), BOX)
    with pytest.warns(UserWarning, match=r"state is declared float32, but the values are float64") as caught:
        with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
            taken = roll(recorded, 15)
    assert len(caught) == 1
    recording = check_against(tmp_path / "r.mcap", taken)
    assert recording.episodes[0].states.dtype == np.float64
    assert recording.observation_space == BOX


def test_python_floats_are_not_rounded(tmp_path: Path) -> None:
    env = Scripted(lambda step: step * 0.1, spaces.Box(0, 1, (), np.float32))
    with pytest.warns(UserWarning, match="float64"), RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        recorded.reset()
        recorded.step(0)
        recorded.step(1)
    assert Recording(tmp_path / "r.mcap").episodes[0].states.tolist() == [0.0, 0.1]


def test_python_scalars_are_fine(tmp_path: Path) -> None:
    env = Scripted(lambda step: step, spaces.Discrete(100), reward=lambda step: step)
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        recorded.reset()
        for action in (1, True, np.int8(2), np.array(0)):
            recorded.step(action)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert episode.actions.tolist() == [1, 1, 2, 0]
    assert episode.actions.dtype == np.int64
    assert episode.rewards.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert episode.states.tolist() == [0, 1, 2, 3]


def test_values_outside_the_bounds_and_nan_are_kept(tmp_path: Path) -> None:
    odd = np.array([0x7FC01234, 0xFF800000], np.uint32).view(np.float32)  # a NaN with a payload, and -inf
    with RecordEpisodes(
        Scripted(lambda step: odd, BOX, reward=lambda step: np.nan), tmp_path / "r.mcap"
    ) as env:
        taken = roll(env, 3)
    episode = Recording(tmp_path / "r.mcap").episodes[0]
    assert episode.states[0].tobytes() == odd.tobytes()
    assert np.isnan(episode.rewards).all()
    assert len(taken) == len(episode)


def test_columns_are_shown_in_short(tmp_path: Path) -> None:
    space = spaces.Dict({"x": BOX, "t": spaces.Tuple((spaces.Discrete(3), spaces.Text(5)))})
    state = {"x": BOX.low, "t": (np.int64(1), "a")}
    info = {f"key{i}": "v" * 100 for i in range(25)}
    with RecordEpisodes(
        Scripted(lambda n: state, space, info=lambda n: info), tmp_path / "r.mcap", record_info=True
    ) as env:
        roll(env, 30, 1)
    with Recording(tmp_path / "r.mcap") as recording:
        shown = repr(recording.read(fields=["observations", "rewards", "infos"]))
    assert shown.startswith("<Columns of 30 steps of ")
    assert "'x': float32 (30, 2)" in shown and "'t': (int64 (30,), 30 values)" in shown
    assert (
        "; rewards: float64 (30,); infos: 30 dicts of key0, key1, " in shown and "key19 and 5 more>" in shown
    )
    assert len(shown) < 400


def test_names_that_no_info_has_are_warned_of_once(tmp_path: Path) -> None:
    env = RecordEpisodes(
        Scripted(lambda n: BOX.low, BOX, info=lambda n: {"force": 1.0}),
        tmp_path / "r.mcap",
        record_info=["forc", "force"],
    )
    env.reset()
    env.step(env.action_space.sample())
    with pytest.warns(UserWarning, match=r"no step's info had 'forc' \(did you mean 'force'\?\)$") as told:
        env.close()
        env.close()
    assert len(told) == 1
    RecordEpisodes(Scripted(lambda n: BOX.low, BOX), tmp_path / "none.mcap", record_info=["x"]).close()


BAD_STATES = [
    (BOX, np.zeros(3, np.float32), r"state: expected shape \(2,\), found shape \(3,\)"),
    (BOX, np.zeros((1, 2), np.float32), r"state: expected shape \(2,\), found shape \(1, 2\)"),
    (BOX, np.array([0.1, 0.2]), r"state: expected values that float32 holds exactly, found float64"),
    (BOX, "text", r"state: expected float32\[2\], found 'text'"),
    (BOX, None, r"state: expected float32\[2\], found None"),
    (spaces.Discrete(3), 1.5, r"state: expected values that int64 holds exactly, found float64 1.5"),
    (spaces.Discrete(3), 2**70, r"state: expected"),
    (
        spaces.Dict({"a": BOX}),
        {"b": np.zeros(2, np.float32)},
        r"state: expected an entry for each of \['a'\], found \['b'\]",
    ),
    (spaces.Tuple((BOX, BOX)), (np.zeros(2, np.float32),), r"state: expected a tuple of 2 entries"),
    (spaces.Tuple((BOX,)), [np.zeros(2, np.float32)], r"state: expected a tuple of 1 entries, found \["),
    (
        spaces.Box(0, 255, (4, 4, 3), np.uint8),
        np.zeros((4, 4), np.uint8),
        r"state: expected shape \(4, 4, 3\)",
    ),
    (spaces.Text(5), 7, r"state: expected"),
    pytest.param(BOX, 10**5000, r"state: expected float32\[2\], found <builtins\.int>", id="huge"),
]


@pytest.mark.parametrize(("space", "bad", "message"), BAD_STATES)
def test_what_cannot_be_stored_is_refused_and_the_rest_is_safe(
    tmp_path: Path, space: gym.Space[Any], bad: Any, message: str
) -> None:
    good = space.sample()
    env = RecordEpisodes(Scripted(lambda step: bad if step == 3 else good, space), tmp_path / "r.mcap")
    env.reset()
    env.step(0)
    env.step(1)
    with pytest.raises(StepError, match=message):
        env.step(2)
    with pytest.raises(StepError, match="could not be recorded; call env.reset"):
        env.step(0)
    env.reset()
    env.step(2)
    env.close()
    first, second = Recording(tmp_path / "r.mcap").episodes
    assert (len(first), first.end) == (2, "interrupted")
    assert same(first.final_state, good)
    assert first.actions.tolist() == [0, 1]
    assert len(second) == 1


def test_an_action_that_does_not_fit_names_the_leaf(tmp_path: Path) -> None:
    space = spaces.Dict({"move": spaces.Box(-1, 1, (2,), np.float32), "grip": spaces.Discrete(2)})
    env = RecordEpisodes(Scripted(lambda step: 0, spaces.Discrete(1), space), tmp_path / "r.mcap")
    env.reset()
    env.step(space.sample())
    with pytest.raises(StepError, match=r"action\.move: expected shape \(2,\)"):
        env.step({"move": np.zeros(3, np.float32), "grip": 0})
    env.close()


def test_array_rewards_need_a_reward_space(tmp_path: Path) -> None:
    reward = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    env = Scripted(lambda step: 0, spaces.Discrete(1), reward=lambda step: np.arange(3.0) * step)
    with RecordEpisodes(env, tmp_path / "r.mcap", reward_space=reward) as recorded:
        taken = roll(recorded, 4)
    episode = Recording(tmp_path / "r.mcap").episodes[0]
    assert np.array_equal(episode.rewards, [step[2] for step in taken])
    assert episode.return_ == 30.0
    refused = RecordEpisodes(env, tmp_path / "s.mcap")
    refused.reset()
    with pytest.raises(StepError, match=r"reward: expected shape \(\), found shape \(3,\)"):
        refused.step(0)
    refused.close()


def test_unknown_spaces_are_refused_before_a_file_is_made(tmp_path: Path) -> None:
    class MyBox(spaces.Box):
        pass

    space = spaces.Dict({"ok": BOX, "mine": spaces.Tuple((MyBox(0, 1, (2,)),))})
    with pytest.raises(
        SpaceError, match=r"state\.mine\[0\]: expected a space of Gymnasium itself, found .*MyBox"
    ):
        RecordEpisodes(Scripted(lambda step: None, space), tmp_path / "r.mcap")
    with pytest.raises(
        SpaceError, match=r"state: dtype 'longdouble' cannot be stored|state: dtype 'float128'"
    ):
        RecordEpisodes(
            Scripted(lambda step: None, spaces.Box(0, 1, (2,), np.longdouble)), tmp_path / "r.mcap"
        )
    assert list(tmp_path.iterdir()) == []


class Missions(spaces.Space[str]):
    """Texts of another library, as MiniGrid's MissionSpace."""

    def __init__(self) -> None:
        super().__init__(dtype=str)

    def sample(self, mask: Any = None, probability: Any = None) -> str:
        return f"get the {self.np_random.choice(['red', 'blaß'])} ball"

    def contains(self, x: Any) -> bool:
        return isinstance(x, str)


def test_a_space_of_texts_of_another_library_becomes_a_text(tmp_path: Path) -> None:
    space = spaces.Dict({"mission": Missions(), "pair": spaces.Tuple((Missions(), BOX))})
    env = Sampler(space, spaces.Discrete(2))
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        taken = roll(recorded, 5)
    recording = Recording(tmp_path / "r.mcap")
    states = [step[0] for step in taken]
    assert recording.episodes[0].states["mission"] == [state["mission"] for state in states]
    assert list(recording.episodes[0].states["pair"][0]) == [state["pair"][0] for state in states]
    assert type(recording.observation_space["mission"]) is spaces.Text
    assert env.observation_space is space and type(space["mission"]) is Missions


def test_too_many_leaves_are_refused(tmp_path: Path) -> None:
    """Code is generated for each, also from the spaces of a stranger's file that is written anew."""
    space = spaces.Dict({f"key{i}": spaces.Discrete(2) for i in range(4095)})
    with RecordEpisodes(Sampler(space, spaces.Discrete(2)), tmp_path / "r.mcap") as env:
        env.reset(seed=0)
        with pytest.raises(
            SpaceError, match="at most 4,096 leaves in the spaces of a step, found 4,097; join"
        ):
            env.step(0)


COLUMNS = ("states", "actions", "rewards", "terminals", "timeouts")


def test_keys_of_a_space_are_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    run = "open('ran', 'w').close()"
    keys = [
        f"'] + [{run}] + ['",
        f'"] + [{run}] + ["',
        f"\n    {run}\n",
        f"{{{run}}}",
        "\\'] #",
        "\u2028'",
        ("'", run),
    ]
    space = spaces.Dict({key: spaces.Discrete(5) for key in keys})
    with RecordEpisodes(Sampler(space, space), tmp_path / "a.mcap") as env:
        roll(env, 2)
    with Recording(tmp_path / "a.mcap") as old:
        steps = list(old.episodes[0])
        columns = {name: [getattr(step, name[:-1]) for step in steps] for name in COLUMNS}
        write_recording(
            tmp_path / "b.mcap",
            [EpisodeData(**columns, final_state=old.episodes[0].final_state)],
            observation_space=old.observation_space,
            action_space=old.action_space,
        )
        with Recording(tmp_path / "b.mcap") as new:
            assert all(same(a.state, b.state) for a, b in zip(steps, new.episodes[0], strict=True))
    assert not (tmp_path / "ran").exists()


# ---- how episodes end


def test_a_reset_in_mid_episode_interrupts(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        env.reset(seed=1)
        env.step(0)
        after = env.step(1)[0]
        env.reset(seed=2)
        env.reset(seed=3)  # a reset without a step is no episode
        env.step(0)
    first, second = Recording(tmp_path / "r.mcap").episodes
    assert (len(first), first.end, first.seed) == (2, "interrupted", 1)
    assert same(first.final_state, after)
    assert (len(second), second.end, second.seed) == (1, "interrupted", 3)


def test_garbage_collection_closes(tmp_path: Path) -> None:
    env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap")
    env.reset()
    env.step(0)
    del env
    gc.collect()
    recording = Recording(tmp_path / "r.mcap")
    assert recording.complete
    assert [len(episode) for episode in recording.episodes] == [1]
    assert not (tmp_path / "r.mcap.journal").exists()


def test_the_end_of_the_interpreter_closes(tmp_path: Path) -> None:
    code = (
        "import sys, gymnasium as gym\nfrom tupli_mcap import RecordEpisodes\n"
        "env = RecordEpisodes(gym.make('CartPole-v1'), sys.argv[1])\nenv.reset()\nenv.step(0)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "r.mcap")], check=True, timeout=60)
    recording = Recording(tmp_path / "r.mcap")
    assert recording.complete
    assert recording.episodes[0].end == "interrupted"


def test_an_exception_out_of_step_leaves_a_valid_file(tmp_path: Path) -> None:
    class Fails(gym.Wrapper[Any, Any, Any, Any]):
        def step(self, action: Any) -> Any:
            if action == 1:
                raise RuntimeError("motor failure")
            return self.env.step(action)

    with pytest.raises(RuntimeError, match="motor failure"):
        with RecordEpisodes(Fails(gym.make("CartPole-v1")), tmp_path / "r.mcap") as env:
            env.reset()
            env.step(0)
            env.step(1)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert (len(episode), episode.end) == (1, "interrupted")


def test_steps_after_an_end_are_an_episode_of_their_own(tmp_path: Path) -> None:
    with RecordEpisodes(
        Scripted(lambda step: step, spaces.Discrete(99), length=3), tmp_path / "r.mcap"
    ) as env:
        env.reset()
        for _ in range(4):
            env.step(0)
    first, second = Recording(tmp_path / "r.mcap").episodes
    assert (first.states.tolist(), first.final_state) == ([0, 1, 2], 3)
    assert (second.states.tolist(), second.final_state, second.start.continued) == ([3], 4, True)


def test_data_is_written_before_the_environment_is_closed(tmp_path: Path) -> None:
    class Inner(gym.Wrapper[Any, Any, Any, Any]):
        def close(self) -> None:
            self.found = Recording(tmp_path / "r.mcap").n_steps
            super().close()

    inner = Inner(gym.make("CartPole-v1"))
    env = RecordEpisodes(inner, tmp_path / "r.mcap")
    env.reset()
    env.step(0)
    env.close()
    env.close()
    assert inner.found == 1
    with pytest.raises(RecordingError, match="is closed; make another recorder"):
        env.step(0)


# ---- resets, infos, metadata


def test_seeds_options_and_reset_infos(tmp_path: Path) -> None:
    class Informed(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **kwargs: Any) -> Any:
            return self.env.reset(**kwargs)[0], {"start": np.arange(2), "nan": np.nan, "none": None}

    options = {"low": -0.01, "high": 0.01}
    with RecordEpisodes(Informed(gym.make("CartPole-v1")), tmp_path / "r.mcap") as env:
        env.reset(seed=2**40, options=options)
        env.step(0)
        env.reset()
        env.step(0)
    first, second = Recording(tmp_path / "r.mcap").episodes
    assert (first.seed, first.options, first.start.seed_given) == (2**40, options, True)
    assert first.reset_info["start"].tolist() == [0, 1]
    assert np.isnan(first.reset_info["nan"])
    assert first.reset_info["none"] is None
    assert (second.seed, second.options) == (None, None)


def test_options_that_the_environment_takes_out_are_recorded(tmp_path: Path) -> None:
    class Takes(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            assert options.pop("start") == 3
            return self.env.reset(seed=seed, options=options)

    with RecordEpisodes(Takes(gym.make("CartPole-v1")), tmp_path / "r.mcap") as env:
        env.reset(options={"start": 3, "low": -0.01})
        env.step(0)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert episode.options == {"start": 3, "low": -0.01}


def test_the_seed_of_an_unseeded_first_reset_is_found(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        state, _ = env.reset()
        env.step(0)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert not episode.start.seed_given
    assert np.array_equal(gym.make("CartPole-v1").reset(seed=episode.seed)[0], state)


INFOS = [
    {"x": 0.5, "text": "a", "array": np.arange(3, dtype=np.int16)},
    {"x": None, "nan": np.float32(np.nan), "nested": {"t": (1, 2)}},
    {},
    {"x": np.float64(2.5)},
]


@pytest.mark.parametrize(
    "how", [True, ["x", "text"], lambda info: {"n": len(info)}], ids=["all", "named", "callable"]
)
def test_infos(tmp_path: Path, how: Any) -> None:
    env = Scripted(lambda step: 0, spaces.Discrete(1), info=lambda step: INFOS[step - 1], length=4)
    with RecordEpisodes(env, tmp_path / "r.mcap", record_info=how) as recorded:
        roll(recorded, 4)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    found = episode.infos
    assert found is not None
    if how is True:
        for a, b in zip(found, INFOS, strict=True):
            assert repr(a) == repr(b)
    elif isinstance(how, list):
        assert found == [{"x": 0.5, "text": "a"}, {"x": None}, {}, {"x": 2.5}]
    else:
        assert found == [{"n": 3}, {"n": 3}, {"n": 0}, {"n": 1}]


def test_infos_are_left_out_unless_asked_for(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        roll(env, 30)
    assert Recording(tmp_path / "r.mcap").episodes[0].infos is None


def test_a_step_callback_adds_to_the_info(tmp_path: Path) -> None:
    with RecordEpisodes(
        gym.make("CartPole-v1"),
        tmp_path / "r.mcap",
        step_callback=lambda step: {"angle": float(step.state[2])},
    ) as env:
        taken = roll(env, 30)
    infos = [info for episode in Recording(tmp_path / "r.mcap").episodes for info in episode.infos or []]
    assert [info["angle"] for info in infos if info] == [float(step[0][2]) for step in taken]


class Totals(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.total, self.first = 0.0, None

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.total += tuple.reward
        self.first = self.first if self.first is not None else tuple.state
        return {"total": np.float64(self.total), "first": self.first, "good": self.total > 20}


def test_metadata_callbacks(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", metadata_callback=Totals()) as env:
        roll(env, 200)
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert episode.metadata["total"] == episode.return_ == len(episode)
        assert episode.metadata["first"] == episode.states[0].tolist()
        assert episode.metadata["good"] is (len(episode) > 20)


@pytest.mark.parametrize("mode", ["x", "a"])
def test_a_callback_that_another_recorder_has_left_in_mid_episode(tmp_path: Path, mode: Any) -> None:
    """Whether that recorder was closed, or not yet."""
    callback = Totals()
    unclosed = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "unclosed.mcap", metadata_callback=callback)
    paths = [tmp_path / "0.mcap", tmp_path / ("1.mcap" if mode == "x" else "0.mcap")]
    roll(unclosed, 3)
    for path in paths:
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode=mode, metadata_callback=callback) as env:
            roll(env, 5)
        assert callback.total == 0
    unclosed.close()
    for path in [tmp_path / "unclosed.mcap", *paths]:
        for episode in Recording(path).episodes:
            assert (episode.end, episode.metadata["total"]) == ("interrupted", len(episode))


@pytest.mark.parametrize("given", ["text", 5, [1, 2], [(1, 2)]])
def test_infos_and_entries_that_are_no_dicts(tmp_path: Path, given: Any) -> None:
    """The step is recorded all the same."""
    odd: Any = Scripted(lambda step: np.zeros(2, np.float32), BOX, info=lambda step: given)
    cases: list[tuple[Any, dict[str, Any], str]] = [
        (odd, {"record_info": True}, "info"),
        (odd, {"record_info": ["a"]}, "info"),
        (odd, {"record_info": lambda info: {}}, "info"),
        (None, {"record_info": lambda info: given}, "record_info: what the function returns"),
        (None, {"step_callback": lambda step: given}, "step_callback: what it returns"),
    ]
    for env, options, what in cases:
        inner = Scripted(lambda step: np.zeros(2, np.float32), BOX) if env is None else env
        with RecordEpisodes(inner, tmp_path / "r.mcap", mode="w", **options) as recorded:
            recorded.reset()
            with pytest.raises(RecordingError, match=f"^{what}: expected a dict, found "):
                recorded.step(0)
        assert Recording(tmp_path / "r.mcap").n_steps == 1


# ---- files


@pytest.mark.parametrize("options", [{}, {"mode": "w"}, {"mode": "a"}, {"max_bytes": 1000}])
def test_a_nul_in_a_path_is_refused(options: dict[str, Any]) -> None:
    for wrap, env in (
        (RecordEpisodes, gym.make("CartPole-v1")),
        (RecordVectorEpisodes, gym.make_vec("CartPole-v1", 2)),
    ):
        with pytest.raises(
            RecordingError, match=r"expected a path to record to, found 'a\\x00b', which holds a NUL"
        ):
            wrap(env, "a\0b", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("now", [0, -1, 1 << 34, 1 << 64])
def test_a_clock_that_rows_cannot_hold_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, now: int
) -> None:
    env = gym.make("CartPole-v1")
    monkeypatch.setattr("time.time", lambda: now)
    with pytest.raises(RecordingError, match=f"expected a clock between 1970 and 2262, found {now} s"):
        RecordEpisodes(env, tmp_path / "r.mcap")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_too_little_memory_to_compress_is_one_error(compression: str) -> None:
    """In a process of its own that may take so much more, and no more."""
    script = f"""
import resource
import numpy as np
from tupli_mcap import RecordingError
from tupli_mcap.mcap.container import Container
container = Container(-1, "r.mcap", {compression!r})
data = [np.random.default_rng(i).bytes(1 << 17) for i in range(64)]
container.pack_all(data[:2])
used = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmSize")) * 1024
for pack, value in ((container.pack, b"".join(data)), (container.pack_all, data)):
    for more in range(0, 3 << 20, 1 << 18):
        resource.setrlimit(resource.RLIMIT_AS, (used + more, resource.RLIM_INFINITY))
        try:
            pack(value)
        except RecordingError as err:
            print(err)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) > 12
    told = r"r\.mcap: could not compress \d+ bytes: .+; what was recorded before stays readable"
    assert all(re.fullmatch(told, line) for line in lines)


@pytest.mark.parametrize("limits", [{}, {"max_bytes": 10**6}])
@pytest.mark.parametrize("vector", [False, True])
def test_appending_makes_a_missing_file(tmp_path: Path, vector: bool, limits: dict[str, Any]) -> None:
    path, steps = tmp_path / "r.mcap", np.zeros(2, np.int64) if vector else 0
    for _ in range(2):
        envs: Any = gym.make_vec("CartPole-v1", 2, "sync") if vector else gym.make("CartPole-v1")
        wrap: Any = RecordVectorEpisodes if vector else RecordEpisodes
        with wrap(envs, path, mode="a", **limits) as env:
            env.reset(seed=1)
            env.step(steps)
    assert len(Recording(path)) == (4 if vector else 2)
    assert Recording(path).benchmark.make_env().spec.id == "CartPole-v1"


@pytest.mark.parametrize("vector", [False, True])
def test_a_directory_gets_a_new_file_each_time(tmp_path: Path, vector: bool) -> None:
    """As a cell of a notebook is run twice, or ten workers start in the same second."""
    paths = []
    for folder in (tmp_path / "runs", f"{tmp_path}/new/runs/"):
        if isinstance(folder, Path):
            folder.mkdir()
        for mode in ("x", "x", "w", "a"):
            envs: Any = gym.make_vec("CartPole-v1", 2, "sync") if vector else gym.make("CartPole-v1")
            wrap: Any = RecordVectorEpisodes if vector else RecordEpisodes
            with wrap(envs, folder, mode=mode) as env:
                env.reset(seed=1)
                env.step(env.action_space.sample())
                paths.append(env.path)
        assert {path.parent for path in paths[-4:]} == {Path(folder)}
        assert sorted(paths[-4:]) == paths[-4:]
    assert len(set(paths)) == 8
    for path in paths:
        assert re.fullmatch(r"CartPole-v1_\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(_\d\d)?\.mcap", path.name)
        assert len(Recording(path)) == (2 if vector else 1)


@pytest.mark.parametrize("mode", ["x", "w", "a"])
def test_a_new_file_of_another_suffix_is_refused(tmp_path: Path, mode: Any) -> None:
    for name in ("f.foo", "runs.v2", "r.MCAP"):
        with pytest.raises(
            RecordingError, match=rf"ends in \.mcap, or a directory, found .*{name}; add \.mcap, or /"
        ):
            RecordEpisodes(gym.make("CartPole-v1"), tmp_path / name, mode=mode)
    assert list(tmp_path.iterdir()) == []
    with RecordEpisodes(gym.make("CartPole-v1"), f"{tmp_path}/runs.v2/", mode=mode) as env:
        env.reset(seed=1)
        env.step(0)
    old = env.path.rename(tmp_path / "old.rec")
    if mode == "a":
        with RecordEpisodes(gym.make("CartPole-v1"), old, mode=mode) as env:
            env.reset(seed=1)
            env.step(0)
        assert len(Recording(old)) == 2


def test_workers_that_start_at_once_get_files_of_their_own(tmp_path: Path) -> None:
    code = (
        "import gymnasium as gym, sys, tupli_mcap\n"
        "with tupli_mcap.RecordEpisodes(gym.make('CartPole-v1'), sys.argv[1]) as env:\n"
        "    env.reset(seed=1); env.step(0); sys.stdin.read()"
    )
    workers = [
        subprocess.Popen([sys.executable, "-c", code, tmp_path], stdin=subprocess.PIPE) for _ in range(4)
    ]
    for worker in workers:
        worker.communicate(b"", timeout=120)
    assert [worker.returncode for worker in workers] == [0] * 4
    assert len([Recording(path) for path in tmp_path.glob("*.mcap")]) == 4


def test_names_of_environments_become_names_of_files(tmp_path: Path) -> None:
    env = gym.make("CartPole-v1")
    env.unwrapped.spec.id = "ALE/Pong v5"  # type: ignore[union-attr]
    with RecordEpisodes(env, tmp_path) as recorder:
        assert recorder.path.name.startswith("ALE_Pong_v5_")


def test_missing_directories_are_made(tmp_path: Path) -> None:
    for mode in ("x", "w", "a"):
        path = tmp_path / mode / "deep" / "r.mcap"
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode=mode) as env:  # type: ignore[arg-type]
            roll(env, 1)
        assert len(Recording(path)) == 1


def test_a_function_makes_metadata(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(
        gym.make("CartPole-v1"), path, metadata_callback=lambda step: {"success": step.state[2] > 0}
    ) as env:
        roll(env, 100)
    recording = Recording(path)
    *ended, _ = recording.episodes
    assert [one.metadata for one in ended] == [{"success": bool(one.states[-1, 2] > 0)} for one in ended]
    assert len({one.metadata["success"] for one in ended}) == 2


def test_what_is_no_callback_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match="metadata_callback: expected a function of a step, or an Episode"
    ):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", metadata_callback={"a": 1})  # type: ignore[arg-type]
    assert not any(tmp_path.iterdir())
    with pytest.raises(RecordingError, match="step_callback: expected a function, found 3"):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", step_callback=3)  # type: ignore[arg-type]


def test_wrong_arguments_name_the_class_that_was_called(tmp_path: Path) -> None:
    class Mine(RecordEpisodes):
        pass

    env, path = gym.make("CartPole-v1"), tmp_path / "r.mcap"
    calls: dict[str, Any] = {
        "RecordEpisodes": lambda **options: RecordEpisodes(env, path, **options),
        "Mine": lambda **options: Mine(env, path, **options),
        "EpisodeWriter": lambda **options: EpisodeWriter(path, BOX, BOX, **options),
    }
    for name, call in calls.items():
        with pytest.raises(TypeError, match=rf"^{name}\(\) has no option 'nmae' \(did you mean 'name'\?\)"):
            call(nmae="ppo")
        for other, meant in (("overwrite", "mode"), ("config", "metadata"), ("run_name", "name")):
            with pytest.raises(TypeError, match=rf"has no option '{other}' \(did you mean '{meant}'\?\)"):
                call(**{other: 1})
        video = "; it has " if name == "EpisodeWriter" else r" \(did you mean 'frames'\?\)"
        with pytest.raises(TypeError, match=f"has no option 'video'{video}"):
            call(video=True)
        with pytest.raises(TypeError, match=rf"^{name}\(\) has no option 'zzz'; it has .*, chunk_size, "):
            call(zzz=1)
    with pytest.raises(TypeError, match=r"^RecordEpisodes\(\): missing a required argument: 'path'"):
        RecordEpisodes(env)  # type: ignore[call-arg]
    assert list(inspect.signature(Mine).parameters)[:2] == ["env", "path"]
    assert not any(tmp_path.iterdir())


def test_existing_files_and_bad_places_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        roll(env, 1)
    with pytest.raises(
        RecordingError, match='exists and is not overwritten; choose another path, or mode="a"'
    ):
        RecordEpisodes(gym.make("CartPole-v1"), path)
    with pytest.raises(RecordingError, match="cannot be recorded to"):
        RecordEpisodes(gym.make("CartPole-v1"), "/proc/r.mcap")
    with pytest.raises(RecordingError, match="mode: expected"):
        RecordEpisodes(gym.make("CartPole-v1"), path, mode="r")  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match="compression: expected one of"):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "x.mcap", compression="gzip")
    assert not (tmp_path / "x.mcap").exists()


def test_two_writers_of_one_file_are_refused(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        roll(env, 10)
        for mode in ("a", "w"):
            with pytest.raises(RecordingError, match="is being recorded by another writer"):
                RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", mode=mode)  # type: ignore[arg-type]
        roll(env, 10)
    assert Recording(tmp_path / "r.mcap").n_steps == 20


def test_a_recording_is_readable_while_it_grows(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", chunk_size=2000) as env:
        for round_ in range(1, 5):
            roll(env, 40)
            recording = Recording(tmp_path / "r.mcap")
            assert (recording.n_steps, recording.complete) == (40 * round_, False)


def test_flush_in_any_state(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        env.flush()
        env.reset()
        env.flush()
        taken = []
        for seed in range(5):
            state, _ = env.reset(seed=seed)
            env.flush()
            env.flush()
            if seed % 2:
                env.reset(seed=99)
                env.flush()
                state, _ = env.reset(seed=seed)
            for _ in range(3):
                after, reward, terminal, timeout, _ = env.step(0)
                taken.append((state, np.int64(0), reward, terminal, timeout, after))
                state = after
                env.flush()
    check_against(tmp_path / "r.mcap", taken)


def test_chunks_by_time_where_asked_for(tmp_path: Path) -> None:
    space = spaces.Box(-1, 1, (2,))
    env = Sampler(space, spaces.Discrete(2), length=1000)
    with RecordEpisodes(env, tmp_path / "r.mcap", flush_seconds=0.0) as recorded:
        taken = roll(recorded, 20)
        sizes = (tmp_path / "r.mcap").stat().st_size
        assert sizes > 20 * 50  # every step has been written, though no half is full and no episode has ended
    check_against(tmp_path / "r.mcap", taken)


def test_wrappers_are_not_pickled(tmp_path: Path) -> None:
    import pickle

    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        with pytest.raises(RecordingError, match="cannot be pickled or copied"):
            pickle.dumps(env)


def test_the_environment_is_in_the_file(tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1", sutton_barto_reward=True), tmp_path / "r.mcap") as env:
        roll(env, 10)
    rebuilt = Recording(tmp_path / "r.mcap").benchmark.make_env()
    assert rebuilt.unwrapped._sutton_barto_reward is True


@pytest.mark.parametrize(
    ("space", "reward", "total"),
    [
        (BOX, lambda n: [1.0 * n, 2.0], 12.0),
        (BOX, lambda n: np.array([n, 0.5], np.float32), 7.5),
        (
            spaces.Dict({"a": BOX, "b": spaces.Discrete(9)}),
            lambda n: {"a": np.ones(2, np.float32), "b": n},
            12.0,
        ),
        (spaces.Tuple([spaces.Text(3), spaces.Box(0, 9, ())]), lambda n: ("x", np.float32(n)), 6.0),
    ],
)
@pytest.mark.parametrize("state", [spaces.Discrete(9), spaces.Text(9)], ids=["constant", "variable"])
def test_rewards_of_any_space(
    tmp_path: Path, state: gym.Space[Any], space: gym.Space[Any], reward: Any, total: float
) -> None:
    text = isinstance(state, spaces.Text)
    inner = Scripted(lambda n: "x" * n if text else n, state, reward=reward)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        with RecordEpisodes(inner, tmp_path / "r.mcap", reward_space=space) as env:
            env.reset()
            given = [env.step(0)[1] for _ in range(3)]
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert episode.return_ == total
    for step, expected in zip(episode, given, strict=True):
        for found, want in zip(_flat(step.reward), _flat(expected), strict=True):
            assert np.array_equal(found, want)


def _flat(value: Any) -> list[Any]:
    if isinstance(value, dict):
        return list(value.values())
    return list(value) if isinstance(value, tuple) else [value]


@pytest.mark.parametrize("shape", [(2,), (0,)], ids=["values", "nothing"])
def test_a_masked_array_of_stacked_values_is_refused(tmp_path: Path, shape: tuple[int]) -> None:
    values = np.ones((3, *shape), np.float32)
    masked = np.ma.MaskedArray(values, mask=values == 1)
    inner = Scripted(
        lambda n: masked if n == 2 else values, spaces.Sequence(spaces.Box(0, 1, shape), stack=True)
    )
    with RecordEpisodes(inner, tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
        with pytest.raises(StepError, match="masked array"):
            env.step(0)


@pytest.mark.parametrize("size", [3, 3000])
def test_a_masked_array_is_refused_at_any_step(tmp_path: Path, size: int) -> None:
    values = np.ones(size, np.float32)
    masked = np.ma.MaskedArray(values, mask=np.arange(size) % 2)
    inner = Scripted(lambda n: masked if n == 3 else values, spaces.Box(0, 1, (size,)))
    with RecordEpisodes(inner, tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
        env.step(0)
        with pytest.raises(StepError, match="whose mask cannot be recorded"):
            env.step(0)
    assert Recording(tmp_path / "r.mcap").n_steps == 2


def test_named_tuples_are_tuples(tmp_path: Path) -> None:
    from typing import NamedTuple

    class Pair(NamedTuple):
        a: int
        b: int

    space = spaces.Tuple([spaces.Discrete(9), spaces.Discrete(9)])
    with RecordEpisodes(Scripted(lambda n: Pair(n, 1), space), tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
    assert Recording(tmp_path / "r.mcap").episodes[0].final_state == (1, 1)


@pytest.mark.parametrize("which", ["metadata_callback", "step_callback"])
def test_a_callback_that_raises_does_not_change_how_an_episode_ends(tmp_path: Path, which: str) -> None:
    calls = []

    class Fails(EpisodeMetadataCallback):
        def reset(self) -> None:
            pass

        def __call__(self, tuple: Any) -> dict[str, Any]:
            calls.append(tuple.state.copy())
            if len(calls) in (2, 3):
                raise ValueError("mistake")
            return {"n": len(calls)}

    inner = Scripted(lambda n: np.full(2, n, np.float32), BOX, length=3)
    with RecordEpisodes(inner, tmp_path / "r.mcap", **{which: Fails()}) as env:  # type: ignore[arg-type]
        env.reset()
        env.step(0)
        for _ in range(2):
            with pytest.raises(ValueError, match="mistake"):
                env.step(0)
        env.reset()
        env.step(0)
    assert [state[0] for state in calls] == [0, 1, 2, 0]
    first, second = Recording(tmp_path / "r.mcap").episodes
    assert (len(first), first.end) == (3, "terminal")
    assert (len(second), second.end) == (1, "interrupted")
    if which == "metadata_callback":
        assert (first.metadata, second.metadata) == ({"n": 1}, {"n": 4})


@pytest.mark.parametrize("metadata", [[1], 5, {"x": object()}])
def test_metadata_that_is_none_is_refused(tmp_path: Path, metadata: Any) -> None:
    class Odd(Totals):
        def __call__(self, tuple: RLTuple) -> Any:
            return metadata

    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", metadata_callback=Odd()) as env:
        env.reset()
        with pytest.raises(RecordingError, match="metadata_callback: "):
            env.step(0)
    assert Recording(tmp_path / "r.mcap").episodes[0].metadata == {}


def test_metadata_is_kept_when_a_step_is_refused(tmp_path: Path) -> None:
    inner = Scripted(lambda n: np.zeros(3 if n == 2 else 2, np.float32), BOX)
    with RecordEpisodes(inner, tmp_path / "r.mcap", metadata_callback=Totals()) as env:
        env.reset()
        env.step(0)
        with pytest.raises(StepError, match="expected shape"):
            env.step(0)
    assert Recording(tmp_path / "r.mcap").episodes[0].metadata["total"] == 1.0


@pytest.mark.parametrize(
    ("select", "expected"),
    [
        (["x"], {"x": 1.0, "log_prob": -0.5}),
        ("x", {"x": 1.0, "log_prob": -0.5}),
        ([], {"log_prob": -0.5}),
        (False, {"log_prob": -0.5}),
        (lambda info: {"y": info["y"]}, {"y": 2, "log_prob": -0.5}),
        (lambda info: None, {"log_prob": -0.5}),
        (True, {"x": 1.0, "y": 2, "log_prob": -0.5}),
    ],
)
def test_a_step_callback_adds_to_infos_of_any_choice(tmp_path: Path, select: Any, expected: Any) -> None:
    inner = Scripted(lambda n: n, spaces.Discrete(9), info=lambda n: {"x": 1.0, "y": 2})
    with RecordEpisodes(
        inner, tmp_path / "r.mcap", record_info=select, step_callback=lambda step: {"log_prob": -0.5}
    ) as env:
        env.reset()
        env.step(0)
    assert Recording(tmp_path / "r.mcap").episodes[0].infos == [expected]


def test_no_info_and_no_option_ends_a_rollout(tmp_path: Path) -> None:
    class Mute:
        def __repr__(self) -> str:
            raise RuntimeError("no repr")

    loop: dict[str, Any] = {"n": 1}
    loop["self"] = loop
    infos: list[Any] = [{}, {"mute": Mute(), "loop": loop, "x": 1.5}, None, {(1, 2): loop}]
    inner = Scripted(lambda n: n, spaces.Discrete(9), info=lambda n: infos[n])
    with RecordEpisodes(inner, tmp_path / "r.mcap", record_info=True) as env:
        env.reset(options={"loop": loop, "mute": Mute()})
        for _ in range(3):
            env.step(0)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert episode.infos is not None
    found = episode.infos[0]
    assert found is not None
    assert (found["x"], found["loop"]) == (1.5, "{'n': 1, 'self': {...}}")
    assert found["mute"].endswith("Mute>")
    assert episode.infos[1:] == [{}, {(1, 2): "{'n': 1, 'self': {...}}"}]
    assert episode.options["loop"] == "{'n': 1, 'self': {...}}"


def test_the_journal_stays_where_the_recording_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("here", "there", "journals"):
        (tmp_path / name).mkdir()
    (tmp_path / "there" / "link.mcap").symlink_to(tmp_path / "here" / "linked.mcap")

    def files(name: str) -> list[str]:
        return sorted(path.name for path in (tmp_path / name).iterdir())

    monkeypatch.chdir(tmp_path / "here")
    plain = RecordEpisodes(gym.make("CartPole-v1"), "plain.mcap")
    elsewhere = RecordEpisodes(gym.make("CartPole-v1"), "other.mcap", journal_dir="../journals")
    linked = RecordEpisodes(gym.make("CartPole-v1"), "../there/link.mcap", mode="w")
    monkeypatch.chdir(tmp_path)
    for env in (plain, elsewhere, linked):
        env.reset()
        env.step(0)
    assert files("here") == [
        "linked.mcap",
        "linked.mcap.journal",
        "other.mcap",
        "plain.mcap",
        "plain.mcap.journal",
    ]
    assert files("there") == ["link.mcap"]
    (journal,) = files("journals")
    assert re.fullmatch(r"other\.mcap\.[0-9a-f]{32}\.journal", journal)
    for path in ("here/plain.mcap", "here/other.mcap", "here/linked.mcap", "there/link.mcap"):
        assert Recording(path).n_steps == 1
    for env in (plain, elsewhere, linked):
        env.close()
    assert files("here") == ["linked.mcap", "other.mcap", "plain.mcap"]
    assert files("journals") == []


@pytest.mark.parametrize(
    ("options", "match"),
    [
        *(
            ({"chunk_size": size}, "chunk_size: expected an integer from 1 to")
            for size in (0, 1.5, "9", 2**30 + 1)
        ),
        *(
            ({"flush_seconds": time}, "flush_seconds: expected seconds from 0")
            for time in (-1, "1", float("nan"))
        ),
        ({"journal_dir": "/nowhere"}, "journal_dir"),
        ({"journal_dir": 5}, "journal_dir: expected a directory, found '5'"),
        ({"benchmark_id": None}, "benchmark_id: expected a text, empty for none, found None"),
        ({"benchmark_id": "\udcff"}, "benchmark_id: expected a text"),
        ({"attachments": ["notes.txt"]}, r"attachments: expected a dict .*, found \['notes.txt'\]"),
        ({"attachments": {"notes.txt": None}}, r"attachments: expected .*, found None at 'notes.txt'"),
        ({"attachments": {"a": ("text/plain", "b")}}, r"found \('text/plain', 'b'\) at 'a'"),
        ({"attachments": {1: ("text/plain", b"b")}}, "attachments: expected a dict of names .* at 1"),
        ({"tags": None}, "tags: expected a list of words, found None"),
        ({"name": 0}, "name: expected a text of at most 1000 characters, found 0"),
        *(
            ({"stack_size": size}, "stack_size: expected a number of frames or None, found")
            for size in (0, -1, 1.5, "4", True)
        ),
    ],
)
def test_options_are_checked_before_a_file_is_made(tmp_path: Path, options: Any, match: str) -> None:
    with pytest.raises(RecordingError, match=match):
        RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", [None, 5, b"r.mcap"])
def test_a_path_that_is_none(path: Any) -> None:
    with pytest.raises(RecordingError, match="expected a path to record to, such as 'run.mcap', found"):
        RecordEpisodes(gym.make("CartPole-v1"), path)


def test_tags_may_come_from_a_generator(tmp_path: Path) -> None:
    with RecordEpisodes(
        gym.make("CartPole-v1"),
        tmp_path / "r.mcap",
        tags=(word for word in ("a", "b")),  # type: ignore[arg-type]
    ) as env:
        roll(env, 3)
    assert Recording(tmp_path / "r.mcap").run.tags == ("a", "b")


def test_tensors_that_numpy_does_not_take(tmp_path: Path) -> None:
    half = torch.arange(2000, dtype=torch.bfloat16)
    with EpisodeWriter(tmp_path / "r.mcap", spaces.Box(-9, 9, (2,)), spaces.Discrete(2)) as writer:
        writer.begin()
        with pytest.raises(StepError, match=r"state: expected .*bfloat16\); pass .float\(\) of it"):
            writer.step(half[:2], 1, 1.0)
        with pytest.raises(StepError, match=r"reward: .*requires_grad=True\); pass .detach\(\) of it"):
            writer.step(np.zeros(2, np.float32), 1, torch.tensor(1.0, requires_grad=True))
        writer.step(np.zeros(2, np.float32), 1, 1.0, info={"logits": half})
    (info,) = Recording(tmp_path / "r.mcap").read(["infos"]).infos
    np.testing.assert_array_equal(info["logits"], half.float().numpy(), strict=True)


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"timeouts": None}, r"as many states, .*, found \[2, 2, 2, 2, None\]"),
        ({"infos": 5}, "an info for each of 2 steps, or None, found None"),
        ({"infos": [1, 2]}, "infos: expected a dict, found 1"),
        ({"metadata": [1]}, r"metadata: expected a dict, found \[1\]"),
    ],
)
def test_episode_data_of_other_kinds(tmp_path: Path, changed: dict[str, Any], match: str) -> None:
    values: dict[str, Any] = {
        "states": np.zeros((2, 2), np.float32), "actions": [0, 1], "rewards": [0.0, 1.0], "terminals": [False, True],
        "timeouts": [False, False],
    }  # fmt: skip
    options: Any = {"observation_space": BOX, "action_space": spaces.Discrete(2)}
    with pytest.raises((StepError, RecordingError), match=match):
        write_recording(tmp_path / "r.mcap", [EpisodeData(**(values | changed))], **options)
    with pytest.raises(StepError, match="expected an episode as EpisodeData, found {'states'"):
        write_recording(tmp_path / "s.mcap", [values], **options)  # type: ignore[list-item]


def test_a_first_state_that_cannot_be_copied(tmp_path: Path) -> None:
    weights = torch.ones(2, requires_grad=True)
    with RecordEpisodes(
        Scripted(lambda step: weights * step, spaces.Box(-9, 9, (2,))), tmp_path / "r.mcap"
    ) as env:
        with pytest.raises(StepError, match=r"state: expected arrays, found tensor\(.*\(RuntimeError: "):
            env.reset()


@pytest.mark.parametrize("wrapper", [RecordEpisodes, RecordVectorEpisodes], ids=["single", "vector"])
def test_the_options_are_the_arguments(wrapper: Any) -> None:
    arguments = inspect.signature(wrapper.__init__).parameters
    given = {name: arguments[name].default for name in arguments if name not in ("self", "env", "path")}
    assert given == {field.name: field.default for field in fields(RecordOptions)}


def test_an_image_whose_values_stray_is_an_array(tmp_path: Path) -> None:
    space = spaces.Box(0, 255, (4, 3, 3), np.uint8)
    env = Scripted(lambda step: np.full((4, 3, 3), step / 4, np.float32), space)
    with pytest.warns(UserWarning, match="state is declared uint8, but the values are float32"):
        with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
            taken = roll(recorded, 12)
    check_against(tmp_path / "r.mcap", taken)


@pytest.mark.parametrize(("side", "name"), [("observation", "state"), ("action", "action")])
def test_a_space_that_is_none(tmp_path: Path, side: str, name: str) -> None:
    env = Scripted(lambda step: step, spaces.Discrete(99))
    setattr(env, f"{side}_space", None)
    with pytest.raises(
        SpaceError,
        match=rf"{name}: expected a space of Gymnasium itself, found builtins.NoneType; give one, such as .*Box\(",
    ):
        RecordEpisodes(env, tmp_path / "r.mcap")
    assert not list(tmp_path.iterdir())


def test_infos_that_are_mappings_and_no_dicts(tmp_path: Path) -> None:
    class Told(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, **options: Any) -> tuple[Any, Any]:
            return self.env.reset(**options)[0], MappingProxyType({"place": 3})

    info: Any = MappingProxyType({"is_success": True})
    env = Told(Scripted(lambda step: step, spaces.Discrete(99), info=lambda step: info, length=2))
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        roll(recorded, 2)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    assert (episode.success, episode.reset_info) == (True, {"place": 3})


class _AnySeed(Scripted):
    """Takes any seed."""

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return super().reset()


@pytest.mark.parametrize("seed", [5.0, "5", [5], np.array([5.0, 6.0])], ids=repr)
def test_a_seed_is_an_integer(tmp_path: Path, seed: Any) -> None:
    """Any other one is refused before the environment is reset: the running episode goes on."""
    env = _AnySeed(lambda step: step, spaces.Discrete(99))
    for kind in ("single", "vector"):
        wrapped: Any = RecordEpisodes if kind == "single" else RecordVectorEpisodes
        made: Any = env if kind == "single" else gym.vector.SyncVectorEnv([lambda: env] * 2)
        with wrapped(made, tmp_path / f"{kind}.mcap") as recorded:
            recorded.reset(seed=3)
            action = recorded.action_space.sample()
            recorded.step(action)
            with pytest.raises(StepError, match="seed: expected an integer"):
                recorded.reset(seed=seed)
            recorded.step(action)
        first = Recording(tmp_path / f"{kind}.mcap").episodes[0]
        assert (first.seed, len(first)) == (3, 2)


def test_environments_that_reset_themselves(tmp_path: Path) -> None:
    env = gym.wrappers.Autoreset(Scripted(lambda step: step, spaces.Discrete(99), length=3))
    with RecordEpisodes(env, tmp_path / "r.mcap", metadata_callback=Totals()) as recorded:
        recorded.reset()
        for _ in range(9):
            recorded.step(1)
    episodes = Recording(tmp_path / "r.mcap").episodes
    assert [e.states.tolist() for e in episodes] == [[0, 1, 2], [0, 1, 2], [0]]
    assert [e.final_state for e in episodes] == [3, 3, 1]
    assert [e.metadata["total"] for e in episodes] == [3, 3, 1]


@pytest.mark.parametrize(
    "options", [{}, {"record_info": True}, {"max_bytes": 1}], ids=["plain", "infos", "rotation"]
)
@pytest.mark.parametrize(
    ("limit", "states"), [(2, [[0, 1], [2], [0], [1], [2]]), (4, [[0, 1, 2], [0], [1], [2], [0]])]
)
def test_a_time_limit_around_an_environment_that_resets_itself(
    tmp_path: Path, options: dict[str, Any], limit: int, states: list[list[int]]
) -> None:
    """Its end makes the next step no reset, and a step that was a reset may have its flag."""
    inner = gym.wrappers.Autoreset(Scripted(lambda step: step, spaces.Discrete(99), length=3))
    with RecordEpisodes(gym.wrappers.TimeLimit(inner, limit), tmp_path / "r.mcap", **options) as recorded:
        recorded.reset(seed=0)
        for _ in range(sum(map(len, states)) + (2 if limit == 4 else 1)):
            recorded.step(1)
    found = [episode for path in recorded.paths for episode in Recording(path).episodes]
    assert [e.states.tolist() for e in found] == states
    assert [e.final_state for e in found] == [each[-1] + 1 for each in states]
    assert [e.end == "terminal" for e in found] == [each[-1] == 2 for each in states]
    if "max_bytes" not in options:
        assert certify(recorded.path, env=gym.wrappers.TimeLimit(inner, limit)).agreed.steps == sum(
            map(len, states)
        )


@pytest.mark.parametrize(
    ("space", "good", "ragged", "where"),
    [
        (BOX, np.zeros(2, np.float32), [1, [2, 3]], "state: expected float32[2]"),
        (spaces.Dict(a=spaces.Discrete(2)), {"a": 0}, {"a": [1, [2]]}, "state.a: expected int64[]"),
        (spaces.Sequence(BOX), (), ([1, [2, 3]],), "state[0]: expected float32[2]"),
    ],
    ids=["Box", "Dict", "Sequence"],
)
@pytest.mark.parametrize("first", [0, 1, 2], ids=["reset", "first step", "later step"])
def test_a_ragged_list_is_refused_by_its_path(
    tmp_path: Path, space: gym.Space[Any], good: Any, ragged: Any, where: str, first: int
) -> None:
    env = Scripted(lambda step: ragged if step == first else good, space)
    with RecordEpisodes(env, tmp_path / "run.mcap", capture_env=None) as recorded:
        recorded.reset()
        with pytest.raises(StepError, match="^" + re.escape(where)):
            for _ in range(2):
                recorded.step(0)


class Listed(dict[str, Any]):
    """Lists its keys, as some libraries' dicts do."""

    def keys(self) -> Any:
        return list(super().keys())


@pytest.mark.parametrize("inner", [BOX, spaces.Text(3)], ids=["constant", "variable"])
def test_a_dict_that_lists_its_keys(tmp_path: Path, inner: gym.Space[Any]) -> None:
    space = spaces.Dict(a=inner, b=spaces.Discrete(3))
    value = Listed(space.sample())
    with RecordEpisodes(Scripted(lambda _: value, space), tmp_path / "run.mcap", capture_env=None) as env:
        env.reset()
        env.step(0)
        del value["b"]
        with pytest.raises(
            StepError, match=r"state: expected an entry for each of \['a', 'b'\], found \['a'\]"
        ):
            env.step(0)


@pytest.mark.parametrize("space", [BOX, spaces.Text(3)], ids=["constant", "variable"])
def test_a_signalling_nan_is_not_quieted_by_widening(tmp_path: Path, space: gym.Space[Any]) -> None:
    rewards = np.array([0x3F800000, 0x7FC00001, 0x7F800001], np.uint32).view(
        np.float32
    )  # 1, quiet, signalling
    observe = (lambda step: np.zeros(2, np.float32)) if space is BOX else str
    for kind in ("single", "vector"):
        env: Any = Scripted(observe, space, reward=lambda step: rewards[step - 1])
        steps: Any = 0
        if kind == "vector":
            env = _Rewards(gym.vector.SyncVectorEnv([lambda: Scripted(observe, space)]), rewards)
            steps = np.zeros(1, np.int64)
        wrap: Any = RecordEpisodes if kind == "single" else RecordVectorEpisodes
        with wrap(env, tmp_path / f"{kind}.mcap") as recorded:
            recorded.reset()
            recorded.step(steps)
            recorded.step(steps)
            with pytest.raises(StepError, match="reward: expected values that float64 holds exactly"):
                recorded.step(steps)
        kept = Recording(tmp_path / f"{kind}.mcap").read(fields=["rewards"]).rewards
        assert kept.astype(np.float32).tobytes() == rewards[:2].tobytes()


class _Rewards(gym.vector.VectorWrapper):  # type: ignore[type-arg]
    """Gives float32 rewards, as they are: `SyncVectorEnv` makes float64 of them."""

    def __init__(self, env: Any, rewards: Any) -> None:
        super().__init__(env)
        self._left = list(rewards)

    def step(self, actions: Any) -> Any:
        states, _, *rest = self.env.step(actions)
        reward = np.empty(1, np.float32)
        reward.view(np.uint32)[0] = np.asarray(self._left.pop(0)).view(np.uint32)
        return (states, reward, *rest)


@pytest.mark.parametrize("size", [3, 5000])
@pytest.mark.parametrize("kind", ["single", "vector", "variable"])
def test_bools_are_stored_as_0_and_1(tmp_path: Path, kind: str, size: int) -> None:
    """NumPy takes any other byte of a view for True, too."""
    bools = (np.arange(size) % 3).astype(np.uint8).view(np.bool_)
    expected = np.arange(size) % 3 > 0
    leaf = spaces.Box(0, 1, (size,), np.bool_)
    space = spaces.Dict({"x": leaf, "note": spaces.Text(2)}) if kind == "variable" else leaf
    value = {"x": bools, "note": "a"} if kind == "variable" else bools
    env: Any = Scripted(lambda step: value, space, space)
    if kind == "vector":
        env = _Raw(
            gym.vector.SyncVectorEnv([lambda: Scripted(lambda step: value, space, space)]), bools[None]
        )
    wrap: Any = RecordVectorEpisodes if kind == "vector" else RecordEpisodes
    with wrap(env, tmp_path / "r.mcap") as recorded:
        recorded.reset()
        for _ in range(2):
            recorded.step(bools[None] if kind == "vector" else value)
    (episode,) = Recording(tmp_path / "r.mcap").episodes
    for step in episode:
        for found in (step.state, step.action):
            assert (found["x"] if kind == "variable" else found).tobytes() == expected.tobytes()
    final = episode.final_state["x"] if kind == "variable" else episode.final_state
    assert final.tobytes() == expected.tobytes()
    assert verify_recording(tmp_path / "r.mcap").ok


class _Raw(gym.vector.VectorWrapper):  # type: ignore[type-arg]
    """Gives these states, and flags that are views of other bytes."""

    def __init__(self, env: Any, states: Any) -> None:
        super().__init__(env)
        self._states, self._steps = states, 0

    def reset(self, **kwargs: Any) -> Any:
        self.env.reset(**kwargs)
        return self._states, {}

    def step(self, actions: Any) -> Any:
        _, rewards, _, _, infos = self.env.step(actions)
        self._steps += 1
        flags = np.array([self._steps & 2], np.uint8).view(np.bool_)
        return self._states, rewards, flags, flags, infos


@pytest.mark.parametrize("space", [BOX, spaces.Text(3)], ids=["constant", "variable"])
@pytest.mark.parametrize("flag", [None, "false", 2, -1, np.nan, [], np.array([True]), "", object])
def test_flags_are_true_or_false(tmp_path: Path, flag: Any, space: gym.Space[Any]) -> None:
    class Flags(Scripted):
        flags: tuple[Any, Any] = (False, False)

        def step(self, action: Any) -> Any:
            return (*super().step(action)[:2], *self.flags, {})

    env = Flags((lambda step: np.zeros(2, np.float32)) if space is BOX else str, space)
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        for good in (False, True, np.bool_(False), np.bool_(True), 0, 1, 1.0, np.int8(1), np.array(True)):
            env.flags = good, np.bool_(False)
            recorded.reset()
            recorded.step(0)
        for name, flags in (("terminal", (flag, False)), ("timeout", (False, flag))):
            recorded.reset()
            env.flags = flags
            with pytest.raises(StepError, match=f"{name}: expected true or false, found "):
                recorded.step(0)
    ends = [e.end for e in Recording(tmp_path / "r.mcap").episodes]
    assert ends == [
        "interrupted", "terminal", "interrupted", "terminal", "interrupted", *["terminal"] * 4
    ]  # fmt: skip


@pytest.mark.parametrize("space", [BOX, spaces.Text(3)], ids=["constant", "variable"])
def test_a_refused_flag_of_the_first_step_leaves_no_file(tmp_path: Path, space: gym.Space[Any]) -> None:
    class Flag(Scripted):
        def step(self, action: Any) -> Any:
            return (*super().step(action)[:2], 2, False, {})

    env = Flag((lambda step: np.zeros(2, np.float32)) if space is BOX else str, space)
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        recorded.reset()
        with pytest.raises(StepError, match="terminal: expected true or false, found 2"):
            recorded.step(0)
    assert not (tmp_path / "r.mcap").exists()


def test_signalling_nans_are_not_quieted(tmp_path: Path) -> None:
    odd = np.array([0x7FA00001, 0], np.uint32).view(np.float32)
    env = Scripted(lambda step: odd if step == 2 else np.zeros(2), BOX)
    with pytest.warns(UserWarning, match="float64"):
        recorded = RecordEpisodes(env, tmp_path / "r.mcap")
        recorded.reset()
        recorded.step(0)
    with pytest.raises(StepError, match="expected values that float64 holds exactly"):
        recorded.step(0)
    recorded.close()


def test_a_thread_compresses_large_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tupli_mcap.recording.write.chunks.WORTH_A_THREAD", 0.0)
    space = spaces.Box(0, 255, (90, 80, 3), np.uint8)
    with RecordEpisodes(Sampler(space, spaces.Discrete(3)), tmp_path / "r.mcap", chunk_size=1000) as env:
        taken = roll(env, 100)
        assert any(thread.name.startswith("tupli-mcap-chunks") for thread in threading.enumerate())
        env.flush()
        taken += roll(env, 5)
    assert not any(thread.name.startswith("tupli-mcap-chunks") for thread in threading.enumerate())
    check_against(tmp_path / "r.mcap", taken)


@pytest.mark.parametrize("length", [225, 243, 244, 255])
def test_long_names(tmp_path: Path, length: int) -> None:
    """The journal's name is longer, and that of one that another recording has pushed aside is longer still."""
    path = tmp_path / f"{'n' * (length - 5)}.mcap"
    refused = pytest.raises(RecordingError, match="File name too long; choose a shorter one")
    with refused if length > 243 else nullcontext(), RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=0)
        env.step(0)
    assert list(tmp_path.iterdir()) == ([path] if length <= 243 else [])


def test_a_closed_recorder_lets_go_of_its_journal_at_once(tmp_path: Path) -> None:
    def held() -> int:  # a map has a descriptor of its own
        return Path("/proc/self/maps").read_text().count(".journal")

    gc.collect()
    gc.disable()  # as rollouts do
    try:
        for kind in ("box", "text", "image"):
            path = tmp_path / f"{kind}.mcap"
            with RecordEpisodes(Counting(kind), path, record_info=True, frames=kind == "image") as env:
                env.reset()
                env.step(0)
                assert held()
            assert not held()
        envs = gym.vector.SyncVectorEnv([lambda: Counting()] * 2)
        with RecordVectorEpisodes(envs, tmp_path / "vector.mcap") as vector:
            vector.reset()
            vector.step([0, 0])
            assert held()
        assert not held()
    finally:
        gc.enable()


class TestReplacing:
    @pytest.fixture
    def old(self, tmp_path: Path) -> Path:
        with RecordEpisodes(Counting(), tmp_path / "r.mcap") as env:
            env.reset()
            for _ in range(3):
                env.step(0)
        return tmp_path / "r.mcap"

    def test_without_a_step_leaves_the_old_recording(self, old: Path) -> None:
        before = old.read_bytes()
        env = RecordEpisodes(Counting(), old, mode="w")
        env.reset()
        assert old.read_bytes() == before
        with pytest.raises(RecordingError, match="being recorded by another writer"):
            RecordEpisodes(Counting(), old, mode="a")
        env.close()
        assert old.read_bytes() == before
        assert list(old.parent.iterdir()) == [old]

    def test_where_no_journal_can_be_made_leaves_the_old_recording(self, old: Path) -> None:
        before, journals = old.read_bytes(), old.parent / "journals"
        journals.mkdir()
        with RecordEpisodes(Counting(), old, mode="w", journal_dir=journals) as env:
            journals.rmdir()
            env.reset()
            with pytest.raises(RecordingError, match="could not make the journal"):
                env.step(0)
        assert old.read_bytes() == before
        assert list(old.parent.iterdir()) == [old]

    def test_happens_at_the_first_step(self, old: Path) -> None:
        with RecordEpisodes(Counting(), old, mode="w") as env:
            env.reset()
            env.step(0)
            assert Recording(old).n_steps == 1
        assert Recording(old).n_steps == 1
        assert list(old.parent.iterdir()) == [old]


class OfAnotherLibrary(Sampler):
    """Tells the object of a simulator as what is inside of it, as adapters of robosuite do."""

    @property
    def unwrapped(self) -> Any:
        return object()


def test_what_is_inside_of_an_environment_may_be_none_of_gymnasium(tmp_path: Path) -> None:
    with RecordEpisodes(OfAnotherLibrary(BOX, spaces.Discrete(2)), tmp_path / "r.mcap") as env:
        env.reset(seed=0)
        env.step(0)
    assert Recording(tmp_path / "r.mcap").n_steps == 1
