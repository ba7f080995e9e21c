"""`TupliEnvWrapper` on real environments: one id whatever happens, artifacts, recording, deletion."""

from __future__ import annotations

import gc
import os
import pickle
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Counter, Fails
from gymnasium.envs.classic_control.mountain_car import MountainCarEnv
from gymnasium.utils.env_checker import check_env
from windy import WindyCar, WindyWrapper, windy

from tupli_mcap import trust
from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.environment import build
from tupli_mcap.errors import NotFoundError, StepError, StorageError, TupliError, UntrustedError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import EpisodeMetadataCallback, F, FilterEQ, RLTuple
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.benchmark_json import unpack


@pytest.fixture(autouse=True)
def _config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))


@pytest.fixture
def storage(tmp_path: Path) -> Iterator[FileStorage]:
    with FileStorage(tmp_path / "lab") as storage:
        yield storage


class Returns(EpisodeMetadataCallback):
    def __init__(self) -> None:
        self.total = 0.0

    def reset(self) -> None:
        self.total = 0.0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.total += float(tuple.reward)
        return {"cum_eps_reward": self.total, "is_expert": self.total > 20}


def roll(env: gym.Env[Any, Any], steps: int, seed: int = 0) -> None:
    env.action_space.seed(seed)
    env.reset(seed=seed)
    for _ in range(steps):
        _, _, terminal, timeout, _ = env.step(env.action_space.sample())
        if terminal or timeout:
            env.reset()


# --- identity ---


def test_an_id_is_the_same_before_and_after_stepping(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    first = env.store(name="cart", description="a pole", metadata={"level": 1})
    roll(env, 50)
    assert env.store(name="cart", description="a pole", metadata={"level": 1}) == first == env.id
    again = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    assert again.store(name="cart", description="a pole", metadata={"level": 1}) == first
    assert len(storage.list_benchmarks()) == 1
    env.close()


@pytest.mark.parametrize(
    "told",
    [
        {"name": "other"},
        {"name": "cart", "description": "x"},
        {"name": "cart", "difficulty": "hard"},
        {"name": "cart", "version": "2"},
        {"name": "cart", "metadata": {"level": 1}},
    ],
)
def test_metadata_is_part_of_the_identity(storage: FileStorage, told: dict[str, Any]) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    assert env.store(name="cart") != env.store(**told)


def test_an_id_is_the_same_in_another_process(storage: FileStorage) -> None:
    script = textwrap.dedent("""
        import sys, gymnasium as gym
        from tupli_mcap.benchmark import TupliEnvWrapper
        from tupli_mcap.storage import FileStorage
        env = TupliEnvWrapper(gym.make("MountainCar-v0", max_episode_steps=999), FileStorage(sys.argv[1]))
        print(env.store(name="car", metadata={"b": 1, "a": [1.5, None]}))
    """)
    command = [sys.executable, "-c", script, str(storage.root)]
    ids = [
        subprocess.run(
            command, check=True, capture_output=True, text=True, env={**os.environ, "PYTHONHASHSEED": seed}
        ).stdout.strip()
        for seed in ("1", "2")
    ]
    env = TupliEnvWrapper(gym.make("MountainCar-v0", max_episode_steps=999), storage)
    assert [env.store(name="car", metadata={"a": (1.5, None), "b": 1})] * 2 == ids


def test_what_is_stored_is_what_was_wrapped(storage: FileStorage) -> None:
    inner = gym.make("CartPole-v1")
    env = TupliEnvWrapper(inner, storage)
    inner.unwrapped.gravity = 1.0  # type: ignore[attr-defined]
    first = env.store(name="cart")
    assert TupliEnvWrapper.load(storage, first).unwrapped.gravity == 9.8  # type: ignore[attr-defined]
    second = TupliEnvWrapper(inner, storage).store(name="cart")
    assert second != first
    assert TupliEnvWrapper.load(storage, second).unwrapped.gravity == 1.0  # type: ignore[attr-defined]


def test_storing_changes_nothing_in_the_environment(storage: FileStorage) -> None:
    inner = windy()
    inner.reset(seed=3)
    before = pickle.dumps(inner)
    env = WindyWrapper(inner, storage)
    env.store(name="windy")
    assert pickle.dumps(inner) == before
    assert isinstance(inner.unwrapped.data, np.ndarray)  # type: ignore[attr-defined]


# --- artifacts and the tutorial's hooks ---


def test_artifacts_through_the_hooks(storage: FileStorage) -> None:
    env = WindyWrapper(windy(), storage)
    benchmark = env.store(name="windy")
    (item,) = storage.list_artifacts()
    content = unpack(storage.load_benchmark(benchmark).serialized)
    assert content.artifacts == (item.id,)
    assert b"WindyCar" in (content.record.pickle or b"")
    loaded = WindyWrapper.load(storage, benchmark)
    np.testing.assert_array_equal(loaded.unwrapped.data, env.unwrapped.data)  # type: ignore[attr-defined]
    assert build(content.record).unwrapped.data == item.id  # type: ignore[attr-defined]
    env.deactivate_recording()
    loaded.deactivate_recording()
    env.reset(seed=4)
    loaded.reset(seed=4)
    for action in (0, 1, 2, 2, 0):
        np.testing.assert_array_equal(env.step(action)[0], loaded.step(action)[0])


def test_artifacts_are_deduplicated(storage: FileStorage) -> None:
    first = WindyWrapper(windy(), storage)
    second = WindyWrapper(windy(), storage)
    assert first.store(name="one") == second.store(name="one")
    assert second.store(name="two") != first.id
    assert len(storage.list_artifacts()) == 1


def test_a_function_makes_metadata_of_own_tuples(storage: FileStorage) -> None:
    class Mine(RLTuple):
        pass

    env = TupliEnvWrapper(
        gym.make("CartPole-v1"),
        storage,
        metadata_callback=lambda step: {"success": step.terminal, "class": type(step).__name__},
        rl_tuple_cls=Mine,
    )
    env.store(name="cartpole")
    roll(env, 75)
    env.close()
    *ended, _ = storage.list_episodes()
    assert [header.metadata for header in ended] == [{"success": True, "class": "Mine"}] * len(ended)


def test_delete_takes_everything_along(storage: FileStorage) -> None:
    env = WindyWrapper(windy(), storage, metadata_callback=Returns())
    benchmark = env.store(name="windy")
    roll(env, 75)
    done = env.delete(delete_artifacts=True)
    assert (done.id, done.episodes, len(done.artifacts), dict(done.kept)) == (benchmark, 3, 1, {})
    assert env.id is None
    assert storage.list_benchmarks() == storage.list_artifacts() == storage.list_episodes() == []
    left = {p.name for p in storage.root.rglob("*") if p.is_file()}
    assert left == {".lock"}
    with pytest.raises(StorageError, match="not stored yet"):
        env.delete()


def test_delete_keeps_what_others_need(storage: FileStorage) -> None:
    env = WindyWrapper(windy(), storage)
    other = env.store(name="two")
    env.store(name="one")
    done = env.delete(delete_artifacts=True)
    (item,) = storage.list_artifacts()
    assert done.artifacts == ()
    assert dict(done.kept) == {item.id: (other,)}
    assert WindyWrapper.load(storage, other).unwrapped.data is not None  # type: ignore[attr-defined]


def test_delete_where_an_artifact_is_gone_already(storage: FileStorage) -> None:
    env = WindyWrapper(windy(), storage)
    env.store(name="one")
    storage.delete_artifact(storage.list_artifacts()[0].id, force=True)
    done = env.delete(delete_artifacts=True)
    assert (done.artifacts, dict(done.kept), storage.list_benchmarks()) == ((), {}, [])


def test_pytupli_s_keywords(storage: FileStorage) -> None:
    env = WindyWrapper(
        env=windy(), storage=storage, benchmark_id=None, metadata_callback=None, rl_tuple_cls=RLTuple
    )
    env.store(name="a", description="b", difficulty="c", version="d", metadata={"e": 1})
    text = env.serialize_env(env=env.env)
    made = WindyWrapper.deserialize_env(serialized_env=text, storage=storage)
    assert made.unwrapped.data.shape == (50,)  # type: ignore[attr-defined]
    with pytest.raises(StorageError, match="expected metadata with names as keys: extra"):
        env.store(name="a", metadata={1: 2})  # type: ignore[dict-item]


def test_delete_can_leave_episodes_and_artifacts(storage: FileStorage) -> None:
    env = WindyWrapper(windy(), storage)
    benchmark = env.store(name="windy")
    roll(env, 30)
    assert env.delete(delete_episodes=False).episodes == 0
    assert len(storage.list_artifacts()) == 1
    assert storage.count_episodes(FilterEQ(key="benchmark_id", value=benchmark)) == 1


# --- recording ---


def test_recording_needs_a_stored_benchmark(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.reset(seed=0)
    with pytest.raises(StorageError, match=r"call store\(name=\.\.\.\) first, or deactivate_recording\(\)"):
        env.step(0)
    with pytest.raises(StorageError, match="not stored yet"):
        env.publish()
    env.deactivate_recording()
    env.step(0)
    assert storage.list_episodes() == []


def test_recording_to_an_unknown_benchmark_is_refused(storage: FileStorage) -> None:
    for uri in ("0" * 64, "../../x"):
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, benchmark_id=uri)
        with pytest.raises(NotFoundError, match="there is no benchmark"):
            env.reset()
        with pytest.raises(NotFoundError, match="there is no benchmark"):
            TupliEnvWrapper.load(storage, uri)
    with pytest.raises(NotFoundError, match="pass benchmark_id"):
        TupliEnvWrapper.load(storage)
    with pytest.raises(StorageError, match="the other way round"):
        TupliEnvWrapper.load("0" * 64, storage)  # type: ignore[arg-type]
    for ids in ((), ("0" * 64,)):
        with pytest.raises(StorageError, match="there is no storage at 'typo'"):
            TupliEnvWrapper.load("typo", *ids)


def test_recording_another_environment_than_the_benchmarks_is_told(storage: FileStorage) -> None:
    benchmark = TupliEnvWrapper(gym.make("CartPole-v1"), storage).store(name="cart")
    of = f"episodes of {{}} for the benchmark {benchmark[:8]}, which is of CartPole-v1"
    for other, match in (
        (gym.make("MountainCar-v0"), of.format("MountainCar-v0") + ";"),
        (gym.make("CartPole-v0"), of.format("CartPole-v0") + ";"),  # whose spaces are the same
        (
            gym.wrappers.FrameStackObservation(gym.make("CartPole-v1"), 2),
            of.format("CartPole-v1") + " with other",
        ),
    ):
        env = TupliEnvWrapper(other, storage, benchmark)
        with pytest.warns(UserWarning, match=match):
            env.reset(seed=0)
        env.close()


class Shelf:
    class Nested(Counter):
        """An environment whose class is within another one."""


def test_recording_a_benchmarks_own_environment_warns_of_nothing(storage: FileStorage) -> None:
    wrapped = gym.wrappers.TimeLimit(gym.make("CartPole-v1"), 10)
    for env in (gym.make("CartPole-v1"), wrapped, MountainCarEnv(), Counter(), Shelf.Nested()):
        benchmark = TupliEnvWrapper(env, storage).store(name="one")
        again = TupliEnvWrapper(env, storage, benchmark)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            again.reset(seed=0)
        again.close()


def test_episodes_are_recorded_with_their_metadata(storage: FileStorage) -> None:
    stored = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    benchmark = stored.store(name="cart")
    env = TupliEnvWrapper.load(storage, benchmark, metadata_callback=Returns())
    roll(env, 300, seed=2)
    live = storage.list_episodes()
    env.close()
    env.close()
    closed = storage.list_episodes()
    ended_later = [header.model_copy(update={"run": closed[0].run}) for header in live]
    assert closed[: len(live)] == ended_later
    assert closed[0].run["ended"] > live[0].run["ended"]
    assert len(closed) == len(live) + 1  # the one that was running
    assert closed[-1].end == "interrupted"
    assert all(h.terminated and h.metadata["cum_eps_reward"] == h.n_tuples for h in live)
    assert closed[0].seed == 2
    assert len({h.recording for h in closed}) == 1
    assert sum(h.n_tuples for h in closed) == 300
    experts = storage.list_episodes(F("metadata.is_expert") == True)  # noqa: E712
    assert 0 < len(experts) < len(closed)
    with Recording(storage.root / closed[0].recording) as recording:
        assert recording.benchmark_id == benchmark
        assert recording.benchmark.make_env().spec.id == "CartPole-v1"  # type: ignore[union-attr]


def test_metadata_of_an_episode_begins_anew_after_recording_was_off(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, metadata_callback=Returns())
    env.store(name="cart")
    for leave in (env.deactivate_recording, env.close, env.close):
        env.activate_recording()
        env.reset(seed=1)
        for _ in range(5):
            env.step(0)
        leave()
    assert [(h.n_tuples, h.metadata["cum_eps_reward"]) for h in storage.list_episodes()] == [(5, 5.0)] * 3


def test_a_step_that_raises_is_followed_by_a_reset(storage: FileStorage) -> None:
    inner = Fails(gym.make("CartPole-v1"))
    env = TupliEnvWrapper(inner, storage)
    env.store(name="cart")
    for _ in range(2):
        env.reset()
        env.step(0)
        inner.fails = True
        with pytest.raises(TimeoutError, match="no answer"):
            env.step(0)
        inner.fails = False
        with pytest.raises(StepError, match=r"call env.reset\(\) to go on"):
            env.step(0)
    env.close()
    assert [(header.n_tuples, header.end) for header in storage.list_episodes()] == [(1, "interrupted")] * 2


def test_a_reset_before_store_is_recorded(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    observation, _ = env.reset(seed=11, options={"low": -0.01, "high": 0.01})
    env.store(name="cart")
    env.step(1)
    env.close()
    (item,) = storage.list_episodes(include_tuples=True)
    np.testing.assert_array_equal(item.tuples[0].state, observation)  # type: ignore[union-attr]
    assert item.seed == 11
    with storage.open_recording(item.recording) as recording:
        assert recording.episodes[0].options == {"low": -0.01, "high": 0.01}


def test_the_seed_of_an_unseeded_reset_is_recorded(storage: FileStorage) -> None:
    for store_first in (True, False):
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
        if store_first:
            env.store(name="cart")
        observation, _ = env.reset()
        env.store(name="cart")
        env.step(1)
        env.close()
        assert env.recording_path is not None
        with Recording(env.recording_path) as recording:
            seed = recording.episodes[0].seed
        assert seed is not None
        np.testing.assert_array_equal(gym.make("CartPole-v1").reset(seed=seed)[0], observation)


def test_another_storage_gets_a_recording_of_its_own(storage: FileStorage, tmp_path: Path) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    other = FileStorage(tmp_path / "other")
    for seed, place in enumerate((storage, other, storage)):
        env.storage = place
        env.store(name="cart")
        env.reset(seed=seed)
        env.step(0)
    env.close()
    assert [sorted(h.seed for h in place.list_episodes()) for place in (storage, other)] == [[0, 2], [1]]


def test_recording_off_and_on(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    env.reset(seed=0)
    env.step(0)
    env.deactivate_recording()
    assert [h.end for h in storage.list_episodes()] == ["interrupted"]
    env.step(1)
    env.activate_recording()
    env.step(0)  # in the middle of an unrecorded episode
    env.reset(seed=1)
    env.step(0)
    env.step(0)
    env.deactivate_recording()
    env.reset(seed=2)
    for change_of_mind in (env.activate_recording, env.deactivate_recording, env.activate_recording):
        change_of_mind()
    env.step(1)  # the episode's first step
    env.close()
    headers = storage.list_episodes()
    assert [(h.seed, h.n_tuples, h.end) for h in headers] == [
        (0, 1, "interrupted"),
        (1, 2, "interrupted"),
        (2, 1, "interrupted"),
    ]
    assert len({h.recording for h in headers}) == 1  # the file went on


def test_a_reset_is_recorded_as_it_was(storage: FileStorage) -> None:
    """Though the recorder sees it later, when the environment and the policy have changed what it was given."""

    class Takes(gym.Wrapper[Any, Any, Any, Any]):
        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            return self.env.reset(seed=seed)[0], {"given": (options or {}).pop("level")}

    env = TupliEnvWrapper(Takes(gym.make("CartPole-v1")), storage)
    state, info = env.reset(seed=0, options={"level": 3})
    first = state.copy()
    state[:] = 7
    info["given"] = 7
    env.store(name="cart")
    env.step(0)
    env.close()
    (episode,) = Recording(env.recording_path).episodes
    assert (episode.options, episode.reset_info) == ({"level": 3}, {"given": 3})
    assert episode.states[0].tolist() == first.tolist()


def test_recording_off_accepts_anything(storage: FileStorage) -> None:
    class Odd(gym.Env[Any, Any]):
        observation_space = gym.spaces.Box(-1, 1, (1,))
        action_space = gym.spaces.Discrete(2)

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[Any, dict[str, Any]]:
            return "not in the space", {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            return object(), 0.0, False, False, {"weird": object()}

    env = TupliEnvWrapper(Odd(), storage)
    env.deactivate_recording()
    env.reset()
    env.step("anything")
    assert storage.list_episodes() == []


def test_the_working_directory_may_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    with FileStorage("lab") as storage:
        env = TupliEnvWrapper(windy(), storage)
        env.store(name="windy")
        roll(env, 10)
        monkeypatch.chdir(tmp_path / "elsewhere")
        env.close()
        assert storage.count_episodes() == 1
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_recording_without_steps_leaves_no_file(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    env.reset()
    env.close()
    assert list(storage.root.rglob("*.mcap*")) == []
    assert storage.list_episodes() == []


def test_a_forgotten_wrapper_keeps_its_episodes(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    env.reset()
    env.step(0)
    del env
    gc.collect()
    assert [h.n_tuples for h in storage.list_episodes()] == [1]


def test_storing_under_another_id_starts_another_file(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    first = env.store(name="one")
    env.reset()
    env.step(0)
    second = env.store(name="two")
    env.step(0)
    env.reset()
    env.step(0)
    env.close()
    assert {h.benchmark_id: h.n_tuples for h in storage.list_episodes()} == {first: 1, second: 1}


def test_tuples_of_another_class(storage: FileStorage) -> None:
    seen = []

    class Plain(RLTuple):
        @classmethod
        def from_env_step(cls, obs: Any, *args: Any) -> Plain:
            return super().from_env_step(obs.tolist(), *args)

    class Look(Returns):
        def __call__(self, tuple: RLTuple) -> dict[str, Any]:
            seen.append(tuple)
            return super().__call__(tuple)

    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, None, Look(), Plain)
    env.store(name="cart")
    observation, _ = env.reset(seed=0)
    env.step(0)
    env.close()
    assert type(seen[0]) is Plain
    assert seen[0].state == observation.tolist()  # the observation the action was chosen on


def test_recording_options(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("FrozenLake-v1"), storage)
    loaded = TupliEnvWrapper.load(storage, env.store(name="lake"), record_info=True, compression="lz4")
    loaded.reset(seed=0)
    _, _, _, _, info = loaded.step(1)
    loaded.close()
    (item,) = storage.list_episodes(include_tuples=True)
    assert item.tuples[0].info == info  # type: ignore[union-attr]
    with pytest.raises(
        TypeError, match=r"TupliEnvWrapper\(\) has no option 'journal_dir'; it has record_info, "
    ):
        TupliEnvWrapper(gym.make("FrozenLake-v1"), storage, journal_dir="/tmp")


def test_the_wrapper_changes_nothing_that_is_seen(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("MountainCar-v0"), storage)
    env.store(name="car")
    plain = gym.make("MountainCar-v0")
    np.testing.assert_array_equal(env.reset(seed=9)[0], plain.reset(seed=9)[0])
    for action in (0, 2, 1):
        mine, other = env.step(action), plain.step(action)
        np.testing.assert_array_equal(mine[0], other[0])
        assert mine[1:] == other[1:]
    assert env.spec is not None
    assert env.spec.id == "MountainCar-v0"
    assert gym.make(env.spec).spec == plain.spec
    env.close()


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_gymnasium_s_own_check(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    check_env(env, skip_render_check=True)
    env.close()


# --- trust and code ---


def test_a_locally_defined_class(storage: FileStorage) -> None:
    class Steep(MountainCarEnv):
        slope = 3.0

    env = TupliEnvWrapper(gym.wrappers.TimeLimit(Steep(), 10), storage)
    benchmark = env.store(name="steep")
    roll(env, 15)
    env.close()
    loaded = TupliEnvWrapper.load(storage, benchmark)
    assert type(loaded.unwrapped).__name__ == "Steep"
    assert loaded.unwrapped.slope == 3.0  # type: ignore[attr-defined]
    with pytest.raises(TupliError, match="cannot be pickled"):
        env.store(name="steep", by_reference=True)


def test_by_reference_keeps_the_code_out(storage: FileStorage) -> None:
    env = TupliEnvWrapper(windy(), storage)
    by_value, by_name = (
        unpack(storage.load_benchmark(env.store(name=str(flag), by_reference=flag)).serialized).record.pickle
        or b""
        for flag in (False, True)
    )
    assert b"observation[1]" in by_value or b"blow" in by_value
    assert len(by_name) < len(by_value)
    assert TupliEnvWrapper.load(storage, env.id).unwrapped.__class__ is WindyCar


def test_code_of_others_is_refused(
    storage: FileStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    benchmark = TupliEnvWrapper(windy(), storage).store(name="windy")
    harmless = TupliEnvWrapper(gym.make("CartPole-v1"), storage).store(name="cart")
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "somebody else"))
    with pytest.raises(UntrustedError, match="pickled Python code"):
        TupliEnvWrapper.load(storage, benchmark)
    assert TupliEnvWrapper.load(storage, benchmark, trust=True).unwrapped is not None
    assert TupliEnvWrapper.load(storage, harmless).spec is not None
    trust.trust(unpack(storage.load_benchmark(benchmark).serialized).record.digest)
    TupliEnvWrapper.load(storage, benchmark)


def test_publish(storage: FileStorage) -> None:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    env.publish()
    assert storage.list_benchmarks()[0].published_in[-1] == "global"


def test_an_unsignable_benchmark_is_stored_with_a_warning(
    storage: FileStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "file"))
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    with pytest.warns(UserWarning, match="loading it will need trust=True"):
        env.store(name="cart")
    assert len(storage.list_benchmarks()) == 1
