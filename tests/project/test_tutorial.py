"""The tutorial, step by step, as `tools/tutorial.py` runs it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium.wrappers import TimeLimit
from serving import PASSWORD, serving
from tool_modules import tool

from tupli_mcap.arrays import Array
from tupli_mcap.benchmark import TupliEnvWrapper
from tupli_mcap.dataset import NumpyTupleParser, TupliDataset
from tupli_mcap.errors import StorageError
from tupli_mcap.schema import FilterEQ
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient, TupliStorage, storage_at

pytestmark = pytest.mark.sampled(1)  # each with a directory or with a server


@pytest.fixture(scope="module")
def tutorial() -> ModuleType:
    return tool("tutorial")


@pytest.fixture
def wind(tutorial: ModuleType, tmp_path: Path) -> Path:
    tutorial.write_wind(tmp_path / "wind.csv")
    return tmp_path / "wind.csv"


@pytest.fixture(params=["directory", "server"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """A directory, or the address of a server that keeps everything there."""
    if request.param == "directory":
        yield str(tmp_path / "storage")
    else:
        with serving(Settings(tmp_path / "storage")) as url:
            yield url


@pytest.fixture
def storage(place: str) -> TupliStorage:
    found = storage_at(place)
    if isinstance(found, TupliAPIClient):
        found.login("admin", PASSWORD)
    return found


@pytest.fixture
def env(tutorial: ModuleType, storage: TupliStorage, wind: Path) -> TupliEnvWrapper:
    benchmark_id = tutorial.store_benchmark(storage, wind)
    found: TupliEnvWrapper = tutorial.MyTupliEnvWrapper.load(
        storage=storage, benchmark_id=benchmark_id, metadata_callback=tutorial.MyCallback()
    )
    return found


def dataset_of(storage: TupliStorage, env: TupliEnvWrapper) -> TupliDataset:
    return TupliDataset(storage=storage).with_benchmark_filter(FilterEQ(key="id", value=env.id))


def left_in(directory: Path) -> list[Path]:
    """Every file of the storage that is a benchmark's, an artifact's or a recording's."""
    return [
        path
        for name in ("benchmarks", "artifacts", "recordings")
        for path in (directory / name).rglob("*")
        if path.is_file()
    ]


def test_the_wind_is_as_documented_and_slows_the_car_down(tutorial: ModuleType, wind: Path) -> None:
    table = pd.read_csv(wind)
    assert len(table) == 1000
    t = 123
    speed = 2 + 1.2 * np.sin(2 * np.pi * t / 250) + 0.8 * np.sin(2 * np.pi * t / 37)
    assert table["wind"][t] == pytest.approx(speed, abs=5e-4)
    assert table["wind"].between(0, 4).all()

    windy, calm = tutorial.CustomMountainCarEnv(data_path=wind), gym.make("MountainCar-v0").unwrapped
    windy.reset(seed=3)
    calm.reset(seed=3)
    for _ in range(20):
        against, without = windy.step(2)[0], calm.step(2)[0]
        assert against[1] < without[1]


def test_the_wind_is_stored_as_an_artifact_and_put_back(
    tutorial: ModuleType, storage: TupliStorage, wind: Path
) -> None:
    inner = TimeLimit(tutorial.CustomMountainCarEnv(data_path=wind), max_episode_steps=999)
    wrapped = tutorial.MyTupliEnvWrapper(inner, storage=storage)
    benchmark_id = wrapped.store(name="windy-mountain-car", description="MountainCar slowed down by wind")
    assert benchmark_id == wrapped.id
    assert isinstance(inner.unwrapped.data, pd.DataFrame)  # the environment at hand is not changed
    (artifact,) = storage.list_artifacts()
    assert storage.load_artifact(artifact.id) == wind.read_bytes()

    again = tutorial.MyTupliEnvWrapper.load(storage=storage, benchmark_id=benchmark_id)
    pd.testing.assert_frame_equal(again.unwrapped.data, inner.unwrapped.data, check_exact=True)
    inner.reset(seed=5)
    again.deactivate_recording()
    again.reset(seed=5)
    for action in (2, 0, 1, 2):
        assert again.step(action)[0].tobytes() == inner.step(action)[0].tobytes()


def test_benchmarks_of_one_wind_share_it(tutorial: ModuleType, storage: TupliStorage, wind: Path) -> None:
    first = tutorial.store_benchmark(storage, wind)
    car = tutorial.CustomMountainCarEnv(data_path=wind)
    car.max_speed = 0.05
    other = tutorial.MyTupliEnvWrapper(car, storage=storage)
    assert other.store(name="slow-mountain-car") != first
    (artifact,) = storage.list_artifacts()
    result = other.delete(delete_artifacts=True)
    assert result.artifacts == ()
    assert result.kept == {artifact.id: (first,)}
    assert storage.load_artifact(artifact.id) == wind.read_bytes()


def test_the_command_line_lists_the_benchmark(
    tutorial: ModuleType,
    place: str,
    env: TupliEnvWrapper,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "80")  # pytest loads readline, which sets it unseen by os.environ
    tutorial.list_benchmarks(place)
    out = capfd.readouterr().out
    assert "windy-mountain-car" in out
    assert env.id is not None
    assert env.id[:8] in out


def test_random_steps_become_a_dataset(
    tutorial: ModuleType, storage: TupliStorage, env: TupliEnvWrapper, capsys: pytest.CaptureFixture[str]
) -> None:
    tutorial.record_random_steps(env)
    assert (
        capsys.readouterr().out
        == "Episode finished after 999 timesteps\nEpisode finished after 1998 timesteps\n"
    )

    dataset = dataset_of(storage, env)
    headers = dataset.preview()
    assert [(header.n_tuples, header.terminated, header.timeout) for header in headers] == [
        (999, False, True)
    ] * 2
    assert [header.metadata for header in headers] == [{"cum_eps_reward": -999.0, "is_expert": False}] * 2
    assert headers[0].seed == 42
    assert (
        len(dataset_of(storage, env).with_episode_filter(FilterEQ(key="metadata.is_expert", value=True))) == 0
    )

    dataset.load()
    states, actions, rewards, terminals, timeouts = dataset.convert_to_numpy()
    assert (states.dtype, states.shape) == (np.float32, (1998, 2))
    assert (actions.dtype, actions.shape) == (np.int64, (1998,))
    assert rewards.tolist() == [-1.0] * 1998
    assert not terminals.any()
    assert np.flatnonzero(timeouts).tolist() == [998, 1997]
    parsed = dataset.convert_to_tensors(parser=NumpyTupleParser)
    for one, other in zip(parsed, (states, actions, rewards, terminals, timeouts), strict=True):
        np.testing.assert_array_equal(one, other)

    assert_aligned(tutorial, env, dataset)


def assert_aligned(tutorial: ModuleType, env: TupliEnvWrapper, dataset: TupliDataset) -> None:
    """Each state is the one its action was chosen on: the actions, played again, give the same states."""
    env.deactivate_recording()
    states, actions, *_ = dataset.convert_to_numpy()
    state, _ = env.reset(seed=42)
    for t in range(999):
        assert state.tobytes() == states[t].tobytes()
        state, *_ = env.step(actions[t])
        assert state.tobytes() == dataset.next_states[t].tobytes()


def test_actions_that_are_kept_for_a_while_reach_the_flag(
    tutorial: ModuleType, storage: TupliStorage, env: TupliEnvWrapper
) -> None:
    tutorial.record_random_steps(env, steps=600, hold=30)
    env.close()
    dataset = dataset_of(storage, env)
    ends = [header.end for header in dataset.preview()]
    assert ends == ["terminal", "terminal", "interrupted"]
    states, actions, _, terminals, timeouts = dataset.convert_to_numpy()
    last = np.flatnonzero(terminals)
    assert (states[last, 0] < 0.5).all()  # the states on which the last actions were chosen
    assert (dataset.next_states[last, 0] >= 0.5).all()
    assert np.flatnonzero(timeouts).tolist() == [599]  # where the interrupted one was cut
    assert not np.any(actions.reshape(20, 30) != actions[::30, np.newaxis])


def test_deleting_leaves_nothing_behind(
    tutorial: ModuleType, storage: TupliStorage, env: TupliEnvWrapper, tmp_path: Path
) -> None:
    tutorial.record_random_steps(env, steps=1005)
    env.deactivate_recording()
    recorded = storage.count_episodes()
    assert recorded == 2  # and the six steps after the first one
    env.reset(seed=1)
    env.step(np.int64(2))
    assert storage.count_episodes() == recorded
    assert len(left_in(tmp_path / "storage")) > 1
    env.close()
    result = env.delete(delete_artifacts=True)
    assert (result.episodes, len(result.artifacts), dict(result.kept)) == (recorded, 1, {})
    assert left_in(tmp_path / "storage") == []
    assert storage.list_benchmarks() == storage.list_artifacts() == storage.list_episodes() == []
    assert len(TupliDataset(storage=storage)) == 0
    with pytest.raises(StorageError, match="not stored"):
        env.publish()


# --- with d3rlpy ---


class PumpsEnergy:
    """Pushes the way the car is going, the simplest policy that reaches the flag; predicts as d3rlpy does."""

    def predict(self, observations: Array) -> Array:
        return np.where(observations[:, 1] > 0, 2, 0)


def test_a_policy_is_judged_by_its_steps_to_the_flag(tutorial: ModuleType, env: TupliEnvWrapper) -> None:
    env.deactivate_recording()
    steps = tutorial.play(PumpsEnergy(), env, episodes=3)
    assert all(50 < step < 300 for step in steps)


@pytest.mark.d3rlpy
def test_d3rlpy_sees_the_episodes(tutorial: ModuleType, storage: TupliStorage, env: TupliEnvWrapper) -> None:
    tutorial.record_random_steps(env)
    dataset = dataset_of(storage, env)
    made = tutorial.make_d3rlpy_dataset(dataset)
    states, actions, *_ = dataset.convert_to_numpy()
    assert [len(episode) for episode in made.episodes] == [999, 999]
    assert [episode.terminated for episode in made.episodes] == [False, False]
    assert made.dataset_info.action_size == 3
    tutorial.make_algorithm().build_with_env(env)
    transitions = made.transition_picker
    for t in (0, 500, 997):
        transition = transitions(made.episodes[1], t)
        np.testing.assert_array_equal(transition.observation, states[999 + t])
        np.testing.assert_array_equal(transition.next_observation, dataset.next_states[999 + t])
        assert transition.action[0] == actions[999 + t]


@pytest.mark.d3rlpy
def test_a_policy_is_trained_stored_and_played(
    tutorial: ModuleType, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    tutorial.follow(tmp_path, steps=60)
    out = capfd.readouterr().out
    assert "The policy reached the flag in" in out
    assert "0 benchmarks, artifacts and episodes are left." in out
    assert left_in(tmp_path / "storage") == []
