"""d3rlpy's datasets over recorded steps; `tools/test-d3rlpy` runs what needs d3rlpy in an environment of its own."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from sampled import SPACES, record

import tupli_mcap
from tupli_mcap import EpisodeWriter, F, RecordEpisodes, TupliDataset
from tupli_mcap.dataset.items import SamplingError
from tupli_mcap.errors import MissingExtraError


@pytest.fixture
def cartpole(tmp_path: Path) -> TupliDataset:
    """Terminal, timed out and interrupted episodes."""
    for i in range(2):
        env = gym.make("CartPole-v1", max_episode_steps=20)
        with RecordEpisodes(env, tmp_path / f"{i}.mcap", chunk_size=4096) as recorder:
            recorder.action_space.seed(i)
            recorder.reset(seed=i)
            for _ in range(500):
                if any(recorder.step(recorder.action_space.sample())[2:4]):
                    recorder.reset()
    return TupliDataset.from_files([tmp_path / "0.mcap", tmp_path / "1.mcap"]).with_cache(20_000)


def same_batch(one: Any, other: Any) -> None:
    for name in (
        "observations",
        "actions",
        "rewards",
        "next_observations",
        "next_actions",
        "terminals",
        "intervals",
    ):
        first, second = getattr(one, name), getattr(other, name)
        assert type(first) is type(second)
        for a, b in zip(
            *((part if isinstance(part, list) else [part]) for part in (first, second)), strict=True
        ):
            assert a.dtype == b.dtype
            assert np.array_equal(a, b), name
    for a, b in zip(one.transitions, other.transitions, strict=True):
        assert np.array_equal(a.rewards_to_go, b.rewards_to_go)


@pytest.mark.d3rlpy
@pytest.mark.parametrize("name", ["mdp_dataset", "replay_buffer"])
def test_a_path_is_no_dataset(name: str) -> None:
    from tupli_mcap.torch import d3rlpy

    with pytest.raises(
        SamplingError, match=r"expected a dataset, such as tupli_mcap\.open\(path\), found 'runs/'"
    ):
        getattr(d3rlpy, name)("runs/")


@pytest.mark.d3rlpy
@pytest.mark.parametrize("left_out", [None, 5, 1])
def test_samples_are_those_of_an_mdp_dataset(cartpole: TupliDataset, left_out: int | None) -> None:
    """Without its second step, an episode begins with a piece of one step, which has no transition."""
    from tupli_mcap.torch.d3rlpy import mdp_dataset, replay_buffer

    dataset = cartpole if left_out is None else cartpole.with_tuple_filter(F("step") != left_out)
    whole, lazy = mdp_dataset(dataset), replay_buffer(dataset)
    assert lazy.transition_count == whole.transition_count == len(lazy.buffer)
    assert lazy.size() == whole.size()
    assert lazy.dataset_info == whole.dataset_info
    for draw in ("sample_transition_batch", "sample_trajectory_batch"):
        batches = []
        for buffer in (whole, lazy):
            np.random.seed(3)
            batches.append(getattr(buffer, draw)(32, *([6] if "trajectory" in draw else [])))
        if "trajectory" in draw:
            for name in (
                "observations",
                "actions",
                "rewards",
                "returns_to_go",
                "terminals",
                "timesteps",
                "masks",
            ):
                assert np.array_equal(getattr(batches[0], name), getattr(batches[1], name)), name
        else:
            same_batch(*batches)
    for one, other in zip(whole.episodes, lazy.episodes, strict=True):
        assert np.array_equal(one.observations, other.observations)
        assert (one.terminated, one.size()) == (other.terminated, other.size())
        assert one.compute_return() == other.compute_return()


@pytest.mark.d3rlpy
@pytest.mark.parametrize("name", ["nested", "image"])
def test_nested_observations_are_lists(name: str, tmp_path: Path) -> None:
    from d3rlpy.dataset import FrameStackTransitionPicker, MultiStepTransitionPicker

    from tupli_mcap.torch.d3rlpy import mdp_dataset, replay_buffer

    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES[name], 60))
    pickers: list[Any] = [None, MultiStepTransitionPicker(3, 0.9)]
    if name == "image":
        pickers = [None, FrameStackTransitionPicker(2)]
    for picker in pickers:
        batches = []
        for buffer in (
            mdp_dataset(dataset, transition_picker=picker),
            replay_buffer(dataset, transition_picker=picker),
        ):
            np.random.seed(1)
            batches.append(buffer.sample_transition_batch(16))
        same_batch(*batches)


@pytest.mark.d3rlpy
def test_an_algorithm_trains_on_what_is_read(cartpole: TupliDataset) -> None:
    import d3rlpy

    from tupli_mcap.torch.d3rlpy import replay_buffer

    algorithm = d3rlpy.algos.DiscreteCQLConfig(
        batch_size=16, observation_scaler=d3rlpy.preprocessing.StandardObservationScaler()
    ).create()
    algorithm.fit(
        replay_buffer(cartpole), n_steps=20, n_steps_per_epoch=10, show_progress=False, save_interval=100,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
    )  # fmt: skip
    assert algorithm.predict(cartpole.observations[:3]).shape == (3,)


@pytest.mark.d3rlpy
def test_what_d3rlpy_does_not_have(tmp_path: Path, cartpole: TupliDataset) -> None:
    from tupli_mcap.torch.d3rlpy import mdp_dataset, replay_buffer

    texts = TupliDataset.from_files(record(tmp_path / "text.mcap", spaces.Text(5), 20))
    with pytest.raises(SamplingError, match="expected states of a fixed size"):
        replay_buffer(texts)
    with pytest.raises(SamplingError, match="expected at least one step, found an empty dataset"):
        mdp_dataset(texts.with_episode_filter(F("n_tuples") > 100))
    buffer = replay_buffer(cartpole)
    with pytest.raises(SamplingError, match="this buffer of recorded steps is read-only"):
        buffer.append_episode(buffer.episodes[0])


@pytest.mark.d3rlpy
def test_a_dataset_without_transitions(tmp_path: Path) -> None:
    from tupli_mcap.torch.d3rlpy import mdp_dataset, replay_buffer

    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap") as env:
        env.reset()
        env.step(0)
    dataset = TupliDataset.from_files(tmp_path / "r.mcap")
    for buffer in (mdp_dataset(dataset), replay_buffer(dataset)):
        assert (buffer.transition_count, buffer.size(), list(buffer.episodes)) == (0, 0, [])


@pytest.mark.d3rlpy
def test_actions_of_recordings_with_different_spaces(tmp_path: Path) -> None:
    from tupli_mcap.torch.d3rlpy import mdp_dataset, replay_buffer

    for name, action_space in (
        ("a", spaces.Discrete(2)),
        ("b", spaces.Discrete(5)),
        ("c", spaces.Discrete(3, start=-1)),
    ):
        with EpisodeWriter(tmp_path / f"{name}.mcap", spaces.Box(-1, 1, (2,)), action_space) as writer:
            writer.begin()
            for i in range(int(action_space.n)):
                writer.step(np.zeros(2, np.float32), action_space.start + i, 0.0)
    more, below = (tupli_mcap.open([tmp_path / "a.mcap", tmp_path / name]) for name in ("b.mcap", "c.mcap"))
    for make in (mdp_dataset, replay_buffer):
        assert make(more).dataset_info.action_size == 5
        with pytest.raises(SamplingError, match="expected Discrete actions from 0.*, found the action -1"):
            make(below)


def test_without_d3rlpy_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    for name in ["d3rlpy", *(each for each in sys.modules if each.startswith("d3rlpy."))]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "tupli_mcap.torch.d3rlpy", raising=False)
    with pytest.raises(MissingExtraError, match=r"(?s)tupli_mcap[.]torch[.]d3rlpy needs d3rlpy.*\[d3rlpy\]"):
        importlib.import_module("tupli_mcap.torch.d3rlpy")
