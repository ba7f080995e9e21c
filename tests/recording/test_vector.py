"""Vector environments: one stream a sub-environment, under every autoreset mode, for constant and variable layouts."""

from __future__ import annotations

import copy
import gc
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Fails, Sampler, same
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.vector.utils import iterate
from mcap.reader import make_reader

from tupli_mcap import (
    RecordEpisodes as RecordSingle,
    Recording,
    RecordingError,
    SpaceError,
    StepError,
    verify_recording,
)
from tupli_mcap.mcap.records import BODY
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes

try:
    from gymnasium.vector import AutoresetMode

    MODES: list[Any] = list(AutoresetMode)
except ImportError:  # Gymnasium 1.0 knows next-step autoreset only
    MODES = [None]

N = 3
SPACES: dict[str, gym.Space[Any]] = {
    "box": spaces.Box(-1, 1, (4,), np.float32),
    "discrete": spaces.Discrete(7, start=2),
    "dict": spaces.Dict(
        {"a": spaces.Box(0, 1, (2, 2)), "b": spaces.Tuple((spaces.Discrete(3), spaces.MultiBinary(2)))}
    ),
    "image": spaces.Dict({"camera": spaces.Box(0, 255, (6, 5, 3), np.uint8), "x": spaces.Box(-1, 1, (1,))}),
    "text": spaces.Dict({"note": spaces.Text(8), "x": spaces.Discrete(5)}),
    "sequence": spaces.Sequence(spaces.Box(-1, 1, (2,))),
}


def make(space: gym.Space[Any], mode: Any, kind: Callable[..., Any] = SyncVectorEnv) -> Any:
    def one(i: int) -> Callable[[], Any]:
        return lambda: Sampler(space, SPACES["discrete"], length=4 + i)

    kwargs = {} if mode is None else {"autoreset_mode": mode}
    return kind([one(i) for i in range(N)], **kwargs)


def name_of(mode: Any) -> str:
    return "NextStep" if mode is None else str(mode.value)


def run(env: Any, mode: Any, batches: int) -> list[list[list[tuple[Any, ...]]]]:
    """Steps the environment; what was taken, by sub-environment and episode, written down independently."""
    episodes: list[list[list[tuple[Any, ...]]]] = [[[]] for _ in range(N)]
    env.action_space.seed(0)
    states = copy.deepcopy(list(iterate(env.observation_space, env.reset(seed=5)[0])))
    ended = np.zeros(N, dtype=bool)
    for _ in range(batches):
        actions = env.action_space.sample()
        chosen = list(iterate(env.action_space, actions))
        batch, rewards, terminals, timeouts, infos = env.step(actions)
        after = copy.deepcopy(list(iterate(env.observation_space, batch)))
        done = terminals | timeouts
        for i in range(N):
            if name_of(mode) == "NextStep" and ended[i]:
                continue
            final = infos["final_obs"][i] if name_of(mode) == "SameStep" and done[i] else after[i]
            step = (
                states[i],
                chosen[i],
                float(rewards[i]),
                bool(terminals[i]),
                bool(timeouts[i]),
                copy.deepcopy(final),
            )
            episodes[i][-1].append(step)
            if done[i]:
                episodes[i].append([])
        ended = done & ~ended if name_of(mode) == "NextStep" else done
        states = after
        if name_of(mode) == "Disabled" and done.any():
            states = copy.deepcopy(
                list(iterate(env.observation_space, env.reset(options={"reset_mask": done})[0]))
            )
    return [[episode for episode in found if episode] for found in episodes]


def check(path: Path, taken: list[list[list[tuple[Any, ...]]]]) -> Recording:
    recording = Recording(path)
    found: list[list[Any]] = [[e for e in recording.episodes if e.env == i] for i in range(N)]
    assert [len(episodes) for episodes in found] == [len(episodes) for episodes in taken]
    for episodes, expected in zip(found, taken, strict=True):
        for episode, steps in zip(episodes, expected, strict=True):
            assert len(episode) == len(steps)
            for step, (state, action, reward, terminal, timeout, _) in zip(episode, steps, strict=True):
                assert same(step.state, state)
                assert same(step.action, action)
                assert (step.reward, step.terminal, step.timeout) == (reward, terminal, timeout)
                assert step.env == episode[-1].env == episode.env
            assert same(episode.final_state, steps[-1][5])
            assert episode.return_ == pytest.approx(sum(step[2] for step in steps), abs=0)
    assert [e.number for e in recording.episodes] == list(range(len(recording.index)))
    return recording


@pytest.mark.parametrize("mode", MODES, ids=name_of)
@pytest.mark.parametrize("kind", SPACES)
def test_every_autoreset_mode(tmp_path: Path, kind: str, mode: Any) -> None:
    with RecordEpisodes(make(SPACES[kind], mode), tmp_path / "r.mcap", chunk_size=1000) as env:
        taken = run(env, mode, 40)
    recording = check(tmp_path / "r.mcap", taken)
    assert recording.num_envs == N
    assert {e.end for e in recording.episodes} == {"terminal", "timeout", "interrupted"}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("mode", MODES, ids=name_of)
def test_long_enough_to_fill_halves(tmp_path: Path, mode: Any) -> None:
    with RecordEpisodes(make(SPACES["box"], mode), tmp_path / "r.mcap", chunk_size=1000) as env:
        taken = run(env, mode, 2500)
    recording = check(tmp_path / "r.mcap", taken)
    columns = recording.read(fields=["states", "next_states"])
    expected = np.concatenate([episode.next_states for episode in recording.episodes])
    assert np.array_equal(columns.next_states, expected)
    assert np.array_equal(columns.states, np.concatenate([episode.states for episode in recording.episodes]))


@pytest.mark.parametrize("most", [1, 100, None])
def test_a_system_that_writes_less_than_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int | None
) -> None:
    """Or, as some do, knows no writes of several buffers."""
    write = os.pwritev
    if most is None:
        monkeypatch.delattr(os, "pwritev")
    else:
        monkeypatch.setattr(
            os, "pwritev", lambda fd, parts, at: write(fd, [memoryview(b"".join(parts))[:most]], at)
        )
    with RecordEpisodes(make(SPACES["box"], None), tmp_path / "r.mcap", chunk_size=1000) as env:
        taken = run(env, None, 60)
    monkeypatch.undo()
    check(tmp_path / "r.mcap", taken)
    assert verify_recording(tmp_path / "r.mcap").ok


def test_asynchronous_environments(tmp_path: Path) -> None:
    with RecordEpisodes(make(SPACES["dict"], None, AsyncVectorEnv), tmp_path / "r.mcap") as env:
        taken = run(env, None, 25)
    check(tmp_path / "r.mcap", taken)


def test_a_custom_environment_that_reuses_its_arrays(tmp_path: Path) -> None:
    class Counters(gym.vector.VectorEnv):  # type: ignore[type-arg]
        num_envs = 4
        single_observation_space = spaces.Box(0, 1e6, (1,), np.float64)
        single_action_space = spaces.Discrete(2)
        observation_space = spaces.Box(0, 1e6, (4, 1), np.float64)
        action_space = spaces.MultiDiscrete([2] * 4)
        metadata: dict[str, Any] = {}

        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            self.count = np.zeros((4, 1))
            return self.count, {}

        def step(self, actions: Any) -> Any:
            self.count += 1
            no = np.zeros(4, dtype=bool)
            return self.count, np.ones(4), no, no, {}

    with RecordEpisodes(Counters(), tmp_path / "r.mcap") as env:
        env.reset()
        for _ in range(6):
            env.step(np.array([0, 1, 0, 1]))
    for i, episode in enumerate(Recording(tmp_path / "r.mcap").episodes):
        assert episode.states[:, 0].tolist() == [0, 1, 2, 3, 4, 5]
        assert episode.final_state.tolist() == [6]
        assert episode.actions.tolist() == [i % 2] * 6


def test_seeds_are_those_of_the_sub_environments(tmp_path: Path) -> None:
    with RecordEpisodes(make(SPACES["box"], None), tmp_path / "r.mcap") as env:
        env.reset(seed=10)
        env.step([2, 3, 4])
        env.reset(seed=[7, None, 9])
        env.step([2, 3, 4])
    seeds = {(e.env, e.number): e.seed for e in Recording(tmp_path / "r.mcap").episodes}
    assert seeds == {(0, 0): 10, (1, 1): 11, (2, 2): 12, (0, 3): 7, (1, 4): None, (2, 5): 9}


def test_a_full_reset_interrupts_every_episode(tmp_path: Path) -> None:
    with RecordEpisodes(make(SPACES["box"], None), tmp_path / "r.mcap") as env:
        env.reset(seed=1)
        env.step([2, 3, 4])
        env.reset(seed=2)
        env.reset(seed=3)
        env.step([2, 3, 4])
    episodes = Recording(tmp_path / "r.mcap").episodes
    assert [(e.env, len(e), e.end) for e in episodes] == [(i, 1, "interrupted") for i in (0, 1, 2, 0, 1, 2)]


@pytest.mark.skipif(MODES == [None], reason="Gymnasium 1.0 knows no partial resets")
def test_options_are_those_of_the_sub_environments(tmp_path: Path) -> None:
    given: list[Any] = []

    class Notes(gym.Wrapper[Any, Any, Any, Any]):
        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            given.append(options)
            return self.env.reset(seed=seed)

    made = SyncVectorEnv(
        [lambda: Notes(Sampler(SPACES["box"], SPACES["discrete"]))] * 2, autoreset_mode="Disabled"
    )
    with RecordEpisodes(made, tmp_path / "r.mcap") as env:
        env.reset(options={"level": 1})
        env.step([2, 2])
        for more in ({}, {"level": 2}):
            env.reset(options={"reset_mask": np.array([True, False]), **more})
            env.step([2, 2])
    recorded = [episode.options for episode in Recording(tmp_path / "r.mcap").episodes]
    assert recorded == given == [{"level": 1}, {"level": 1}, {}, {"level": 2}]


class Returns(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.total = 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.total += tuple.reward
        return {"total": self.total}


@pytest.mark.parametrize("mode", MODES, ids=name_of)
def test_metadata_and_infos(tmp_path: Path, mode: Any) -> None:
    with RecordEpisodes(
        make(SPACES["box"], mode),
        tmp_path / "r.mcap",
        metadata_callback=Returns(),
        step_callback=lambda step: {"first": float(step.state[0])},
    ) as env:
        run(env, mode, 30)
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert episode.metadata == {"total": episode.return_}
        assert episode.infos is not None
        assert [info["first"] for info in episode.infos if info] == episode.states[:, 0].tolist()


def test_a_function_makes_metadata(tmp_path: Path) -> None:
    with RecordEpisodes(
        make(SPACES["box"], None),
        tmp_path / "r.mcap",
        metadata_callback=lambda step: {"success": step.reward > 0},
    ) as env:
        run(env, None, 30)
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert episode.metadata == {"success": bool(episode.rewards[-1] > 0)}


def test_appending_goes_on_with_every_stream(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(make(SPACES["box"], None), path) as env:
        taken = run(env, None, 20)
    with RecordEpisodes(make(SPACES["box"], None), path, mode="a") as env:
        more = run(env, None, 20)
    check(path, [a + b for a, b in zip(taken, more, strict=True)])
    other = SyncVectorEnv([lambda: Sampler(SPACES["box"], SPACES["discrete"])])
    with pytest.raises(
        SpaceError, match="records a vector environment of 3, found a vector environment of 1"
    ):
        RecordEpisodes(other, path, mode="a")
    gc.collect()
    assert not other.closed


def test_a_batch_that_cannot_be_stored(tmp_path: Path) -> None:
    class Strays(gym.vector.VectorWrapper):  # type: ignore[type-arg]
        def step(self, actions: Any) -> Any:
            states, *rest = self.env.step(actions)
            return (states if self.good else states[:, :2], *rest)

        good = True

    strays = Strays(make(SPACES["box"], None))
    env = RecordEpisodes(strays, tmp_path / "r.mcap")
    env.reset()
    env.step([2, 3, 4])
    strays.good = False
    with pytest.raises(StepError, match=r"state: expected shape \(3, 4\), found shape \(3, 2\)"):
        env.step([2, 3, 4])
    strays.good = True
    with pytest.raises(StepError, match="could not be recorded; call env.reset"):
        env.step([2, 3, 4])
    env.reset()
    env.step([2, 3, 4])
    env.close()
    assert [len(e) for e in Recording(tmp_path / "r.mcap").episodes] == [1] * 6
    with pytest.raises(RecordingError, match="is closed"):
        env.step([2, 3, 4])


@pytest.mark.parametrize("mode", MODES, ids=name_of)
def test_a_step_that_raises_is_followed_by_a_reset_of_all(tmp_path: Path, mode: Any) -> None:
    """The sub-environments before the one that raises have taken the step."""
    last, path = Fails(Sampler(SPACES["box"], SPACES["discrete"], length=4)), tmp_path / "r.mcap"
    first = Sampler(SPACES["box"], SPACES["discrete"], length=4)
    kwargs = {} if mode is None else {"autoreset_mode": mode}
    env = RecordEpisodes(SyncVectorEnv([lambda: first, lambda: last], **kwargs), path)
    with env:
        taken = [env.reset()[0].copy(), env.step([2, 3])[0].copy()]
        last.fails = True
        with pytest.raises(TimeoutError, match="no answer"):
            env.step([2, 3])
        last.fails = False
        with pytest.raises(StepError, match=r"could not be recorded; call env.reset\(\)"):
            env.step([2, 3])
        if name_of(mode) == "Disabled":
            with pytest.raises(StepError, match=r"call env.reset\(\) without a reset_mask"):
                env.reset(options={"reset_mask": np.array([False, True])})
        taken += [env.reset()[0].copy(), env.step([2, 3])[0].copy()]
    found = Recording(path).episodes
    assert [(episode.env, episode.end) for episode in found] == [(0, "interrupted"), (1, "interrupted")] * 2
    for episode in found:
        state, after = taken[:2] if episode.number < 2 else taken[2:]
        assert same(episode.states, state[[episode.env]])
        assert same(episode.final_state, after[episode.env])


def test_the_first_sub_environment_is_in_the_file(tmp_path: Path) -> None:
    envs = SyncVectorEnv([lambda: gym.make("CartPole-v1", sutton_barto_reward=True)] * 2)
    with RecordEpisodes(envs, tmp_path / "r.mcap") as env:
        env.reset()
        env.step([0, 1])
    rebuilt = Recording(tmp_path / "r.mcap").benchmark.make_env()
    assert rebuilt.unwrapped._sutton_barto_reward is True


class Batches(gym.vector.VectorEnv[Any, Any, Any]):
    """A custom environment of `N`: states count, everybody's episode ends with every third step."""

    def __init__(self, infos: Any = None, flags: Any = None, mode: str = "NextStep") -> None:
        self.num_envs = N
        self.single_observation_space = spaces.Box(0, 99, (2,), np.float32)
        self.single_action_space = spaces.Discrete(3)
        self.observation_space = spaces.Box(0, 99, (N, 2), np.float32)
        self.action_space = spaces.MultiDiscrete([3] * N)
        self.metadata = {"autoreset_mode": mode}
        self.infos = infos or dict
        self.flags = flags or (lambda done: np.full(N, done))
        self.count = 0

    def _state(self) -> Any:
        return np.full((N, 2), self.count, np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.count = 0
        return self._state(), {}

    def step(self, actions: Any) -> Any:
        self.count = 0 if self.count == 3 else self.count + 1
        return self._state(), np.ones(N), self.flags(self.count == 3), np.zeros(N, bool), self.infos()


def test_infos_without_masks(tmp_path: Path) -> None:
    infos = {
        "x": np.arange(3.0),
        "note": "all",
        "episode": {"r": np.arange(3)},
        "items": [4, 5, 6],
        "pair": (1, 2),
    }
    with RecordEpisodes(Batches(lambda: infos), tmp_path / "r.mcap", record_info=True) as env:
        env.reset()
        env.step([0, 1, 2])
    for episode in Recording(tmp_path / "r.mcap").episodes:
        i = episode.env
        expected = {"x": float(i), "note": "all", "episode": {"r": i}, "items": 4 + i, "pair": (1, 2)}
        assert episode.infos == [expected]


@pytest.mark.filterwarnings("ignore:same-step autoreset without final states")
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("infos", [None, [None, {"x": 1}, None]], ids=["all", "some"])
def test_infos_that_are_none(tmp_path: Path, infos: Any, mode: str) -> None:
    class Silent(Batches):
        def reset(self, *, seed: Any = None, options: Any = None) -> Any:
            return super().reset()[0], infos

    env = Silent(lambda: infos, mode=mode)
    with RecordEpisodes(env, tmp_path / "r.mcap", record_info=True, autoreset_mode=mode) as recorded:
        recorded.reset()
        for _ in range(3):
            recorded.step([0, 1, 2])
    first, second, _ = Recording(tmp_path / "r.mcap").episodes
    assert first.infos == [{}] * 3 and first.end == "terminal"
    assert second.infos == [{"x": 1} if infos else {}] * 3


def tensor(*values: Any) -> Any:
    return pytest.importorskip("torch").tensor(values)


def small(*values: Any) -> Any:
    return np.array(values, np.uint8)


@pytest.mark.parametrize("mask", [np.array, list, tensor, small], ids=lambda kind: kind.__name__)
@pytest.mark.parametrize("values", [np.array, list, tensor], ids=lambda kind: kind.__name__)
def test_infos_of_any_kind_of_array(tmp_path: Path, values: Any, mask: Any) -> None:
    of = {np.array: lambda *v: np.array(v), list: lambda *v: list(v)}
    values, mask = of.get(values, values), of.get(mask, mask)
    infos = {
        "x": values(4, 5, 6),
        "_x": mask(True, False, True),
        "inner": {"y": values(1.5, 2.5, 3.5), "_y": mask(True, True, False)},
        "is_success": values(True, False, True),
        "_number": values(7, 8, 9),  # no mask of any entry
    }
    final = {
        "final_info": infos,
        "final_obs": values([0.0, 0], [1, 1], [2, 2]),
        "_final_obs": mask(True, True, True),
    }
    batches = iter([infos, infos, {"reset": values(7, 8, 9), **final}])
    env = RecordEpisodes(
        Batches(lambda: next(batches), mode="SameStep"), tmp_path / "r.mcap", record_info=True
    )
    with env:
        env.reset()
        for _ in range(3):
            env.step([0, 1, 2])
    for episode in Recording(tmp_path / "r.mcap").episodes:
        i = episode.env
        expected = {
            **({} if i == 1 else {"x": 4 + i}),
            "inner": {} if i == 2 else {"y": 1.5 + i},
            "is_success": i != 1,
            "_number": 7 + i,
        }
        assert episode.infos == [expected] * 3
        assert episode.metadata == {"success": i != 1}
        assert episode.final_state.tolist() == [i, i]


class Numbered(Sampler):
    """Infos of resets have the number of the episode, also as a dict; those of steps have nothing."""

    def reset(self, **kwargs: Any) -> Any:
        state, _ = super().reset(**kwargs)
        return state, {"number": self.episodes, "episode_id": {"r": self.episodes}}


@pytest.mark.parametrize("key", ["episode", "statistics"])
@pytest.mark.parametrize("as_list", [False, True])
@pytest.mark.parametrize("mode", MODES, ids=name_of)
def test_statistics_of_episodes_are_recorded(tmp_path: Path, mode: Any, as_list: bool, key: str) -> None:
    if mode is None and as_list:
        pytest.skip("DictInfoToList of Gymnasium 1.0 fails on the infos of its own RecordEpisodeStatistics")
    kwargs = {} if mode is None else {"autoreset_mode": mode}
    made = [lambda: Numbered(SPACES["box"], SPACES["discrete"], length=4)] * N
    envs: Any = gym.wrappers.vector.RecordEpisodeStatistics(SyncVectorEnv(made, **kwargs), stats_key=key)
    envs = gym.wrappers.vector.DictInfoToList(envs) if as_list else envs
    with RecordEpisodes(envs, tmp_path / "r.mcap", record_info=True) as env:
        env.reset()
        for _ in range(20):
            _, _, terminals, timeouts, _ = env.step(env.action_space.sample())
            if name_of(mode) == "Disabled" and (done := terminals | timeouts).any():
                env.reset(options={"reset_mask": done})
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert set(episode.reset_info) == {"number", "episode_id"}
        assert episode.reset_info["episode_id"]["r"] == episode.reset_info["number"]
        *before, last = episode.infos or []
        assert all(info == {} for info in before)
        assert last is not None
        if episode.end == "interrupted":
            assert last == {}
        else:
            assert (last[key]["r"], last[key]["l"]) == (episode.return_, len(episode))


@pytest.mark.parametrize("mode", MODES, ids=name_of)
def test_lists_of_infos(tmp_path: Path, mode: Any) -> None:
    if mode is None:
        pytest.skip("DictInfoToList of Gymnasium 1.0 fails on the infos of its own RecordEpisodeStatistics")
    inner = gym.wrappers.vector.RecordEpisodeStatistics(make(SPACES["box"], mode))
    envs = gym.wrappers.vector.DictInfoToList(inner)
    with RecordEpisodes(envs, tmp_path / "r.mcap", record_info=True) as env:
        env.reset()
        for _ in range(3):
            env.step(env.action_space.sample())
        *_, infos = env.step(env.action_space.sample())  # ends the first one's episode
    first = Recording(tmp_path / "r.mcap").episodes[0]
    assert (first.env, len(first), first.end) == (0, 4, "terminal")
    if name_of(mode) == "SameStep":
        assert same(first.final_state, infos[0]["final_obs"])
    assert first.infos is not None
    assert first.infos[:3] == [{}] * 3


def test_a_callback_that_raises_splices_nothing(tmp_path: Path) -> None:
    def fails(step: Any) -> None:
        if step.terminal:
            raise ValueError("mistake")

    with RecordEpisodes(Batches(), tmp_path / "r.mcap", step_callback=fails) as env:
        env.reset()
        for n in range(1, 12):
            if n % 4 == 3:
                with pytest.raises(ValueError, match="mistake"):
                    env.step([0, 1, 2])
            else:
                env.step([0, 1, 2])
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert (episode.states[:, 0].tolist(), episode.end) == ([0.0, 1.0, 2.0], "terminal")


@pytest.mark.parametrize("flags", [lambda done: done, lambda done: np.full((N, 1), done)])
def test_flags_of_another_shape_are_refused(tmp_path: Path, flags: Any) -> None:
    with RecordEpisodes(Batches(flags=flags), tmp_path / "r.mcap") as env:
        env.reset()
        with pytest.raises(StepError, match=r"terminal: expected shape \(3,\)"):
            env.step([0, 1, 2])


@pytest.mark.parametrize("flag", [None, "false", 2, np.nan, -1])
def test_flags_are_true_or_false(tmp_path: Path, flag: Any) -> None:
    env = Batches(flags=lambda done: [0, 0, 1] if env.count == 1 else [flag, True, False])
    with RecordEpisodes(env, tmp_path / "r.mcap") as recorded:
        recorded.reset()
        recorded.step([0, 1, 2])
        with pytest.raises(
            StepError, match="terminal: expected true or false of each sub-environment, found "
        ):
            recorded.step([0, 1, 2])
    assert [e.end for e in Recording(tmp_path / "r.mcap").episodes] == [
        "interrupted",
        "interrupted",
        "terminal",
    ]


class Rewarding(Batches):
    """Its states are texts if `text`; gives `rewards` in its second step."""

    def __init__(self, rewards: Any, *, text: bool) -> None:
        super().__init__()
        self.rewards, self.text = rewards, text
        if text:
            self.single_observation_space = spaces.Text(8)  # type: ignore[assignment]

    def _state(self) -> Any:
        return (str(self.count),) * N if self.text else super()._state()

    def step(self, actions: Any) -> Any:
        states, rewards, *rest = super().step(actions)
        return states, self.rewards if self.count == 2 else rewards, *rest


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    "rewards",
    [
        1.0,
        np.ones(N - 1),
        np.ones(N + 1),
        np.ones((N, 1)),
        np.ones(N, object),
        [1.0, [2.0], 3.0],
        np.ma.masked_array(np.ones(N), [False, True, False]),
        None,
    ],
    ids=["scalar", "short", "long", "column", "object", "ragged", "masked", "none"],
)
def test_rewards_that_cannot_be_stored_are_refused(tmp_path: Path, rewards: Any, text: bool) -> None:
    with RecordEpisodes(Rewarding(rewards, text=text), tmp_path / "r.mcap") as env:
        env.reset()
        env.step([0, 1, 2])
        with pytest.raises(StepError, match="reward: expected "):
            env.step([0, 1, 2])
        env.reset()
        env.step([0, 1, 2])
    lengths = [len(episode) for episode in Recording(tmp_path / "r.mcap").episodes]
    assert lengths == [1] * (2 * N)


def test_rewards_that_have_a_gradient_are_refused(tmp_path: Path) -> None:
    rewards = tensor(1.0, 2.0, 3.0).requires_grad_()
    with RecordEpisodes(Rewarding(rewards, text=False), tmp_path / "r.mcap") as env:
        env.reset()
        env.step([0, 1, 2])
        with pytest.raises(StepError, match=r"reward: expected float64\[3\].*pass \.detach\(\) of it"):
            env.step([0, 1, 2])


def test_the_first_batch_is_refused_as_others_are(tmp_path: Path) -> None:
    env = RecordEpisodes(Batches(flags=lambda done: done), tmp_path / "r.mcap")
    env.reset()
    for match in ("expected shape", "could not be recorded; call env.reset"):
        with pytest.raises(StepError, match=match):
            env.step([0, 1, 2])
    env.close()
    assert not (tmp_path / "r.mcap").exists()


def test_tensors_of_the_first_batch_widen_as_arrays_do(tmp_path: Path) -> None:
    actions = pytest.importorskip("torch").linspace(0, 1, N).double() / 3
    batches = Batches()
    batches.single_action_space = spaces.Box(0, 1, (), np.float32)  # type: ignore[assignment]
    batches.action_space = spaces.Box(0, 1, (N,), np.float32)  # type: ignore[assignment]
    with RecordEpisodes(batches, tmp_path / "r.mcap") as env:
        env.reset()
        with pytest.warns(UserWarning, match="action is declared float32, but the values are float64"):
            env.step(actions)
    assert [episode.actions.tolist() for episode in Recording(tmp_path / "r.mcap").episodes] == [
        [action] for action in actions.tolist()
    ]


def test_an_error_in_the_first_batch_names_the_entry(tmp_path: Path) -> None:
    class Lacks(Batches):
        def _state(self) -> Any:
            return {"a": super()._state()}

    batches = Lacks()
    batches.single_observation_space = spaces.Dict(  # type: ignore[assignment]
        {"a": spaces.Box(0, 99, (2,)), "b": spaces.Discrete(2)}
    )
    with RecordEpisodes(batches, tmp_path / "r.mcap") as env:
        env.reset()
        with pytest.raises(StepError, match="state: expected an entry 'b', found"):
            env.step([0, 1, 2])


def test_a_first_batch_of_too_few_leaves_no_file(tmp_path: Path) -> None:
    with RecordEpisodes(Batches(), tmp_path / "r.mcap") as env:
        env.reset()
        with pytest.raises(StepError, match=r"action: expected shape \(3,\), found shape \(2,\)"):
            env.step([0, 1])
    assert not (tmp_path / "r.mcap").exists()


def test_nested_rewards_are_refused_before_a_file_is_made(tmp_path: Path) -> None:
    with pytest.raises(SpaceError, match="reward: expected a space of arrays"):
        RecordEpisodes(Batches(), tmp_path / "r.mcap", reward_space=spaces.Dict({"a": spaces.Discrete(2)}))
    assert not list(tmp_path.iterdir())


def test_the_seeds_of_an_unseeded_first_reset_are_found(tmp_path: Path) -> None:
    envs = SyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2)
    with RecordEpisodes(envs, tmp_path / "r.mcap") as env:
        env.reset()
        env.step([0, 1])
    for episode in Recording(tmp_path / "r.mcap").episodes:
        assert np.array_equal(gym.make("CartPole-v1").reset(seed=episode.seed)[0], episode.states[0])


def test_padding_is_zero_where_rows_are_left_out(tmp_path: Path) -> None:
    """The rows of a reset step are squeezed out: what copies the others must not bring other memory into the file."""
    path = tmp_path / "r.mcap"
    space = spaces.Dict({"flag": spaces.Box(0, 1, (3,), np.uint8), "x": spaces.Box(-1, 1, (2,), np.float64)})
    inner = gym.vector.SyncVectorEnv([lambda: Sampler(space, space, length=3)] * 2)
    junk = [bytes([255]) * 100 for _ in range(20_000)]
    del junk
    with RecordEpisodes(inner, path) as env:
        env.reset(seed=1)
        for _ in range(500):
            env.step(env.action_space.sample())
    with Recording(path) as recording:
        fields, dtype = recording.layout.step_message.fields, recording.layout.step_message.dtype
    used = np.zeros(dtype.itemsize, np.bool_)
    for field in fields:
        used[BODY + field.offset : BODY + field.offset + field.nbytes] = True
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/env_0/step", "/env_1/step"]):
            assert not np.frombuffer(message.data, np.uint8)[4:][~used[BODY:]].any()


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_half_whose_chunks_are_not_written_yet_is_in_the_journal(tmp_path: Path, compression: str) -> None:
    space = spaces.Box(-1, 1, (250,), np.float64)  # some 30 rows a half
    path, copied = tmp_path / "r.mcap", tmp_path / "killed.mcap"
    env = RecordEpisodes(make(space, None), path, compression=compression)
    add = env._writer.container.finish_chunks
    env._writer.container.finish_chunks = lambda packed: None  # type: ignore[method-assign]
    taken = run(env, None, 50)  # more than a half, less than two
    env._writer.container.finish_chunks = add  # type: ignore[method-assign]
    shutil.copy(path, copied)
    shutil.copy(f"{path}.journal", f"{copied}.journal")
    recording = check(copied, taken)
    assert not recording.complete
    assert recording.n_steps == sum(len(steps) for episodes in taken for steps in episodes) > 3 * 31


def test_many_large_metadata_end_at_one_step(tmp_path: Path) -> None:
    """Ends of one step go to the journal together, but not without bound."""

    class Long(EpisodeMetadataCallback):
        def reset(self) -> None: ...

        def __call__(self, tuple: RLTuple) -> dict[str, Any]:
            return {"text": "long " * 9000}

    inner = SyncVectorEnv([lambda: Sampler(SPACES["box"], SPACES["discrete"], length=4)] * 20)
    with RecordEpisodes(inner, tmp_path / "r.mcap", metadata_callback=Long()) as env:
        env.reset(seed=1)
        for _ in range(12):
            env.step(env.action_space.sample())
    with Recording(tmp_path / "r.mcap") as recording:
        assert len(recording.episodes) == 60
        assert all(
            e.metadata == {"text": "long " * 9000} for e in recording.episodes if e.end != "interrupted"
        )
        with (tmp_path / "r.mcap").open("rb") as file:
            chunks = make_reader(file).get_summary().chunk_indexes  # type: ignore[union-attr]
        assert max(chunk.uncompressed_size for chunk in chunks) <= 512 * 1024


def test_an_environment_of_the_other_kind_is_told_its_class(tmp_path: Path) -> None:
    one, many = Sampler(spaces.Discrete(2), spaces.Discrete(2)), make(SPACES["box"], MODES[0])
    with pytest.raises(
        RecordingError, match=r"found the single environment Sampler; use tupli_mcap\.RecordE"
    ):
        RecordEpisodes(one, tmp_path / "a.mcap")  # type: ignore[arg-type]
    with pytest.raises(
        RecordingError, match=r"the vector environment SyncVectorEnv; use tupli_mcap\.vector\.RecordE"
    ):
        RecordSingle(many, tmp_path / "a.mcap")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


class Several(Sampler):
    """Steps four environments at once without being a vector environment, as those of Isaac Lab."""

    num_envs = 4
    single_observation_space = spaces.Discrete(2)


class Team(Sampler):
    """A single environment of several agents, which says what one of them observes."""

    single_observation_space = spaces.Discrete(2)


@pytest.mark.parametrize("recorder", [RecordEpisodes, RecordSingle])
def test_a_single_environment_that_steps_several_is_told_what_to_do(tmp_path: Path, recorder: Any) -> None:
    env = Several(spaces.MultiDiscrete([2] * 4), spaces.MultiDiscrete([2] * 4))
    with pytest.raises(
        RecordingError, match=r"found Several, a gymnasium\.Env that steps several .*write_rollout"
    ):
        recorder(env, tmp_path / "a.mcap")
    one = gym.wrappers.TransformObservation(env, lambda states: states[0], spaces.Discrete(2))
    RecordSingle(one, tmp_path / "b.mcap").close()
    RecordSingle(Team(env.observation_space, env.action_space), tmp_path / "c.mcap").close()


def test_a_vector_environment_that_is_also_a_single_one_is_a_vector_one(tmp_path: Path) -> None:
    """As EnvPool's are."""

    class Both(Batches, gym.Env[Any, Any]): ...

    with pytest.raises(RecordingError, match=r"vector environment Both; use tupli_mcap\.vector\.RecordE"):
        RecordSingle(Both(), tmp_path / "a.mcap")
    assert not list(tmp_path.iterdir())


def test_infos_where_the_spaces_are_those_of_one_sub_environment(tmp_path: Path) -> None:
    """As EnvPool's are."""
    inner = Batches(lambda: {"n": np.arange(N)})
    inner.observation_space, inner.action_space = inner.single_observation_space, inner.single_action_space
    seen: list[tuple[Any, Any]] = []
    with RecordEpisodes(
        inner,
        tmp_path / "r.mcap",
        record_info=True,
        step_callback=lambda step: seen.append((step.state.tolist(), int(step.action))) or {},
    ) as env:
        env.reset()
        env.step(np.arange(N))
    assert seen == [([0, 0], i) for i in range(N)]
    with Recording(tmp_path / "r.mcap") as recording:
        assert [episode.infos for episode in recording.episodes] == [[{"n": i}] for i in range(N)]


def test_an_environment_without_the_spaces_of_one_is_told_so(tmp_path: Path) -> None:
    """As SuperSuit's are."""

    class Bare(gym.vector.VectorEnv[Any, Any, Any]):
        num_envs = 2
        observation_space = action_space = spaces.Discrete(2)

    with pytest.raises(
        RecordingError, match="a vector environment with single_observation_space, found Bare"
    ):
        RecordEpisodes(Bare(), tmp_path / "r.mcap")
    assert not list(tmp_path.iterdir())
