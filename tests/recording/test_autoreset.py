"""Autoreset that a vector environment does not declare, or declares wrongly: it is noticed, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import Recording, StepError, verify_recording
from tupli_mcap.recording.write.recorders.autoreset import Autoreset
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes

N = 3
Infos = Callable[["Counting", Any, Any], Any]


class Counting(gym.vector.VectorEnv[Any, Any, Any]):
    """The state of a sub-environment is (its number, episode, steps so far); episodes of `lengths` steps.

    `infos` makes the infos of a batch of the environment, who ended, and the states before they were reset. Whatever it
    is: an environment that is `next_step` is reset by the step after an end, and another one by the step that ends.
    """

    single_observation_space = spaces.Box(0, 1e6, (3,), np.float32)
    single_action_space = spaces.Discrete(5)

    def __init__(
        self,
        infos: Infos = lambda env, done, final: {},
        *,
        declared: Any = None,
        next_step: bool = False,
        lengths: tuple[int, ...] = (2, 3, 4),
    ) -> None:
        self.num_envs = N
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, N)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, N)
        self.metadata = {} if declared is None else {"autoreset_mode": declared}
        self._infos, self._next_step, self._lengths = infos, next_step, np.array(lengths)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        self.states = np.zeros((N, 3), np.float32)
        self.states[:, 0] = range(N)
        self._ended = np.zeros(N, bool)
        return self.states.copy(), {}

    def _restart(self, chosen: Any) -> None:
        self.states[chosen, 1] += 1
        self.states[chosen, 2] = 0

    def step(self, actions: Any) -> Any:
        resets = self._ended if self._next_step else np.zeros(N, bool)
        self.states[:, 2] += 1
        self._restart(resets)
        done = ~resets & (self.states[:, 2] == self._lengths)
        rewards = np.where(resets, 0.0, 1.0)
        final = self.states.copy()
        if not self._next_step:
            self._restart(done)
        self._ended = done
        infos = self._infos(self, done, final)
        return self.states.copy(), rewards, done, np.zeros(N, bool), infos


def like_gymnasium(env: Counting, done: Any, final: Any) -> Any:
    """Gymnasium from 1.0 on: an array of objects, and what the last steps' infos were."""
    if not done.any():
        return {"n": np.arange(N)}
    states = np.full(N, None, object)
    for i in np.flatnonzero(done):
        states[i] = final[i]
    infos = {"final_obs": states, "_final_obs": done, "n": np.arange(N), "_n": np.ones(N, bool)}
    return {**infos, "final_info": {"n": np.arange(N), "_n": done}, "_final_info": done}


def like_gymnasium_0(env: Counting, done: Any, final: Any) -> Any:
    infos = like_gymnasium(env, done, final)
    if not done.any():
        return infos
    told = np.full(N, None, object)
    told[done] = [{"n": i} for i in np.flatnonzero(done).tolist()]
    return {
        "final_observation": infos["final_obs"],
        "_final_observation": done,
        "final_info": told,
        "_final_info": done,
    }


def like_maniskill(env: Counting, done: Any, final: Any) -> Any:
    """The states of all, stacked; where one has ended, everybody's infos are those of the reset, with those of the step
    inside."""
    infos: dict[str, Any] = {"elapsed_steps": env.states[:, 2].copy(), "n": np.arange(N)}
    if done.any():
        inner = dict(infos)
        infos = {"elapsed_steps": env.states[:, 2].copy(), "reconfigure": False}
        infos.update(final_observation=final, final_info=inner, _final_info=done, _final_observation=done)
        infos["_elapsed_steps"] = done
    return infos


def like_sb3(env: Counting, done: Any, final: Any) -> Any:
    """A list of the steps' infos; those of the resets are elsewhere."""
    infos: list[dict[str, Any]] = [{"n": i, "TimeLimit.truncated": False} for i in range(N)]
    for i in np.flatnonzero(done):
        infos[i]["terminal_observation"] = final[i]
    return infos


def like_gymnax(env: Counting, done: Any, final: Any) -> Any:
    """It resets in the same step, and its final states are known to nobody."""
    return {"discount": np.where(done, 0.0, 1.0), "n": np.arange(N)}


TELLING = [like_gymnasium, like_gymnasium_0, like_maniskill, like_sb3]


def run(env: Any, batches: int = 12) -> list[Any]:
    env.reset(seed=0)
    return [env.step(np.full(N, k % 5)) for k in range(batches)]


def check(path: Path, *, final: bool = True, batches: int = 12) -> Recording:
    """Every step and end of a same-step autoreset is there, as `Counting` makes them."""
    recording = Recording(path)
    for i in range(N):
        episodes = [episode for episode in recording.episodes if episode.env == i]
        length = i + 2
        assert [len(e) for e in episodes if e.end == "terminal"] == [length] * (batches // length)
        assert sum(map(len, episodes)) == batches
        assert np.concatenate([e.actions for e in episodes]).tolist() == [k % 5 for k in range(batches)]
        for number, episode in enumerate(episodes):
            expected = [[i, number, step] for step in range(len(episode) + 1)]
            assert episode.states.tolist() == expected[:-1]
            if episode.end == "terminal" and not final:
                assert episode.final_state is None
            else:
                assert episode.final_state.tolist() == expected[-1]
    assert verify_recording(path).ok
    return recording


@pytest.mark.parametrize("declared", [None, "SameStep"])
@pytest.mark.parametrize("infos", TELLING)
def test_final_states_in_infos_tell_of_same_step_autoreset(
    tmp_path: Path, infos: Infos, declared: str | None
) -> None:
    with RecordEpisodes(Counting(infos, declared=declared), tmp_path / "r.mcap") as env:
        run(env)
    check(tmp_path / "r.mcap")


@pytest.mark.parametrize("declared", ["NextStep", "Disabled"])
@pytest.mark.parametrize("infos", TELLING)
def test_final_states_in_infos_contradict_another_declared_mode(
    tmp_path: Path, infos: Infos, declared: str
) -> None:
    env = RecordEpisodes(Counting(infos, declared=declared), tmp_path / "r.mcap")
    with (
        env,
        pytest.raises(StepError, match=rf'pass autoreset_mode="SameStep", or "{declared}" if that is right'),
    ):
        run(env)
    assert {e.end for e in Recording(tmp_path / "r.mcap").episodes} == {"interrupted"}


@pytest.mark.parametrize("infos", TELLING)
def test_infos_and_metadata_are_those_of_their_steps(tmp_path: Path, infos: Infos) -> None:
    class Steps(EpisodeMetadataCallback):
        def reset(self) -> None:
            self.steps = 0

        def __call__(self, tuple: RLTuple) -> dict[str, Any]:
            self.steps += 1
            return {"steps": self.steps, "n": tuple.info.get("n")}

    env = RecordEpisodes(
        Counting(infos), tmp_path / "r.mcap", metadata_callback=Steps(), record_info=True, max_bytes=10**9
    )
    with env:
        run(env)
    for episode in check(tmp_path / "r.mcap").episodes:
        infos_of_steps = [info or {} for info in episode.infos or []]
        assert len(infos_of_steps) == len(episode)
        if episode.end == "terminal":
            assert episode.metadata == {"steps": len(episode), "n": episode.env}
            assert infos_of_steps[-1]["n"] == episode.env
        for info in infos_of_steps:
            assert set(info) <= {"n", "TimeLimit.truncated", "elapsed_steps", "_elapsed_steps", "reconfigure"}


def test_infos_of_ale_at_an_end_are_those_of_the_reset(tmp_path: Path) -> None:
    ale = pytest.importorskip("ale_py.vector_env")
    mode = gym.vector.AutoresetMode.SAME_STEP
    inner = ale.AtariVectorEnv("breakout", 2, autoreset_mode=mode, episodic_life=True)
    told: list[list[int]] = [[], []]  # in the batches that ended an episode
    with RecordEpisodes(inner, tmp_path / "r.mcap", record_info=["frame_number"]) as env:
        env.action_space.seed(0)
        env.reset(seed=1)
        for _ in range(60):
            _, _, terminals, _, infos = env.step(env.action_space.sample())
            assert "final_info" not in infos
            for i in np.flatnonzero(terminals):
                told[i].append(int(infos["frame_number"][i]))
    assert all(told)
    with Recording(tmp_path / "r.mcap") as recording:
        for i in range(2):
            first, *others = [episode for episode in recording.episodes if episode.env == i]
            assert [episode.reset_info["frame_number"] for episode in others] == told[i][: len(others)]
            assert first.infos is not None
            assert not first.infos[-1] and first.infos[-2]


def test_a_dict_of_final_states(tmp_path: Path) -> None:
    """As ManiSkill gives those of an environment whose observations are dicts."""

    class Nested(gym.vector.VectorObservationWrapper[Any, Any, Any, Any]):
        def __init__(self, env: Any) -> None:
            gym.vector.VectorWrapper.__init__(self, env)
            self.single_observation_space = spaces.Dict({"x": env.single_observation_space})
            self.observation_space = spaces.Dict({"x": env.observation_space})

        def observations(self, observations: Any) -> Any:
            return {"x": observations}

    infos: Infos = lambda env, done, final: {"final_observation": {"x": final}} if done.any() else {}  # noqa: E731
    with RecordEpisodes(Nested(Counting(infos)), tmp_path / "r.mcap") as env:
        run(env)
    finals = [e.final_state["x"].tolist() for e in Recording(tmp_path / "r.mcap").episodes if e.env == 0]
    assert finals == [[0, number, 2] for number in range(6)]


def test_final_states_after_an_end_without_one_are_refused(tmp_path: Path) -> None:
    def later(env: Counting, done: Any, final: Any) -> Any:
        return like_gymnasium(env, done, final) if done.any() and not done[0] else {}

    with RecordEpisodes(Counting(later, declared="NextStep"), tmp_path / "r.mcap") as env:
        env.reset()
        env.step([0] * N)
        env.step([0] * N)
        with pytest.raises(StepError, match=r'recorded as under NextStep; pass autoreset_mode="SameStep"'):
            env.step([0] * N)


def test_the_caller_who_says_next_step_is_told(tmp_path: Path) -> None:
    """A wrapper may have changed the states, and not those in infos: what the caller says counts."""
    env = RecordEpisodes(Counting(like_sb3), tmp_path / "r.mcap", autoreset_mode="NextStep")
    with env, pytest.warns(UserWarning, match="is recorded as under NextStep, as you have said"):
        env.reset()
        for _ in range(2):
            env.step(np.zeros(env.num_envs, np.int64))


@pytest.mark.parametrize("given", [True, False])
def test_final_states_that_are_returned_too_contradict_nothing(tmp_path: Path, given: bool) -> None:
    envs = Counting(like_gymnasium, next_step=True, declared=None if given else "NextStep")
    with RecordEpisodes(envs, tmp_path / "r.mcap", autoreset_mode="NextStep" if given else None) as env:
        run(env)
    first = Recording(tmp_path / "r.mcap").episodes[0]
    assert (first.states.tolist(), first.final_state.tolist()) == ([[0, 0, 0], [0, 0, 1]], [0, 0, 2])
    assert [e.states[0].tolist() for e in Recording(tmp_path / "r.mcap").episodes if e.env == 0][1] == [
        0,
        1,
        0,
    ]


@pytest.mark.filterwarnings("ignore:the vector environment declares no autoreset mode")
def test_a_reward_after_an_end_is_refused(tmp_path: Path) -> None:
    """An environment like gymnax's says nothing at all; its episode is left without a final state."""
    env = RecordEpisodes(Counting(like_gymnax), tmp_path / "r.mcap")
    with (
        env,
        pytest.raises(StepError, match=r'sub-environment 0 after its end, .* pass autoreset_mode="SameStep"'),
    ):
        run(env)
    first, *others = Recording(tmp_path / "r.mcap").episodes
    assert (first.env, first.end, first.final_state) == (0, "terminal", None)
    assert [(e.end, len(e), e.final_state.tolist()[2]) for e in others] == [("interrupted", 2, 2)] * 2
    assert verify_recording(tmp_path / "r.mcap").ok


@pytest.mark.parametrize("declared", [None, "NextStep"])
@pytest.mark.filterwarnings("ignore:the vector environment declares no autoreset mode")
def test_an_end_after_an_end_is_refused(tmp_path: Path, declared: str | None) -> None:
    env = RecordEpisodes(Counting(lengths=(1, 3, 4), declared=declared), tmp_path / "r.mcap")
    with env, pytest.raises(StepError, match=r"found another end; pass autoreset_mode"):
        run(env)


def test_the_caller_who_says_same_step_gets_episodes_without_final_states(tmp_path: Path) -> None:
    env = RecordEpisodes(
        Counting(like_gymnax), tmp_path / "r.mcap", autoreset_mode="SameStep", record_info=True
    )
    with env, pytest.warns(UserWarning, match="episodes are recorded without them") as told:
        run(env)
    assert len(told) == 1
    recording = check(tmp_path / "r.mcap", final=False)
    for episode in recording.episodes:
        *before, last = [info["discount"] for info in episode.infos or [] if info]
        assert (set(before) <= {1.0}, last) == (True, 0.0 if episode.end == "terminal" else 1.0)
        assert episode.reset_info == {}


@pytest.mark.filterwarnings("ignore:the vector environment declares no autoreset mode")
@pytest.mark.parametrize("max_seconds", [None, 1e-9])
def test_next_step_autoreset_is_assumed(tmp_path: Path, max_seconds: float | None) -> None:
    """The ends, which wait for the batch after them, are the same as of an environment that declares it."""
    paths, found = (tmp_path / "assumed.mcap", tmp_path / "declared.mcap"), []
    for path, declared in zip(paths, (None, "NextStep"), strict=True):
        env = RecordEpisodes(Counting(next_step=True, declared=declared), path, max_seconds=max_seconds)
        with env:
            for batches in (7, 2, 8):  # the last batch of all ends an episode
                run(env, batches)
        assert (max_seconds is None) == (len(env.paths) == 1)
        episodes = [e for one in env.paths for e in Recording(one).episodes]
        assert all(verify_recording(one).ok for one in env.paths)
        told = [(e.env, e.end, e.final_state.tolist()) for e in episodes]
        steps = [np.concatenate([e.states for e in episodes if e.env == i]).tolist() for i in range(N)]
        found.append((sorted(told), steps))
    assert found[0] == found[1]


def test_what_is_assumed_is_told(tmp_path: Path) -> None:
    with RecordEpisodes(Counting(next_step=True), tmp_path / "r.mcap") as env:
        with pytest.warns(
            UserWarning, match=r'declares no autoreset mode.*pass autoreset_mode="NextStep"'
        ) as told:
            run(env)
        assert len(told) == 1
    assert Autoreset.of(SyncVectorEnv([lambda: gym.make("CartPole-v1")]), None).is_assumed is False


def test_same_step_declared_by_an_environment_that_gives_no_final_states(tmp_path: Path) -> None:
    env = RecordEpisodes(Counting(next_step=True, declared="SameStep"), tmp_path / "r.mcap")
    with env, pytest.raises(StepError, match=r'final state of sub-environment 0.* found none; .*"NextStep"'):
        run(env)


@pytest.mark.parametrize("states", [np.zeros((N + 1, 3), np.float32), [None], np.array(1)])
def test_another_number_of_final_states(tmp_path: Path, states: Any) -> None:
    env = RecordEpisodes(Counting(lambda *_: {"final_obs": states}), tmp_path / "r.mcap")
    with (
        env,
        pytest.raises(StepError, match=r"infos\['final_obs'\]: expected 3 states, found (4|1|array\(1\))"),
    ):
        run(env)


@pytest.mark.parametrize("infos", ["no dict", [{}], [1, 2, 3], 5])
def test_infos_that_are_no_dicts(tmp_path: Path, infos: Any) -> None:
    env = RecordEpisodes(Counting(lambda *_: infos), tmp_path / "r.mcap", record_info=True)
    with env, pytest.raises(StepError, match="infos: expected a dict, or a list of 3 dicts, found"):
        run(env)


@pytest.mark.parametrize("given", ["same-step", "SAME_STEP", gym.vector.AutoresetMode.SAME_STEP])
def test_a_mode_by_its_other_names(tmp_path: Path, given: Any) -> None:
    with RecordEpisodes(Counting(), tmp_path / "r.mcap", autoreset_mode=given) as env:
        assert env._autoreset.mode == "SameStep"


@pytest.mark.parametrize("given", ["sometimes", 3])
def test_a_mode_that_there_is_not(tmp_path: Path, given: Any) -> None:
    with pytest.raises(StepError, match=f"expected NextStep, SameStep or Disabled, found {given!r}"):
        RecordEpisodes(Counting(), tmp_path / "r.mcap", autoreset_mode=given)
