"""TorchRL's replay buffers over recorded transitions."""

from __future__ import annotations

import importlib
import pickle
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from environments import same
from gymnasium import spaces
from sampled import SPACES, at, record

from tupli_mcap import F, TupliDataset
from tupli_mcap.dataset.items import SamplingError
from tupli_mcap.errors import MissingExtraError
from tupli_mcap.recording import EpisodeData, write_recording

torch = pytest.importorskip("torch")
pytest.importorskip("torchrl")
from torchrl.data import SamplerWithoutReplacement, SliceSampler  # noqa: E402

from tupli_mcap.torch.rl import RecordedStorage, replay_buffer  # noqa: E402


def as_columns(data: Any, like: Any) -> Any:
    """What a TensorDict holds, nested and typed as a column."""
    if isinstance(like, dict):
        return {key: as_columns(data[key], part) for key, part in like.items()}
    if isinstance(like, tuple):
        return tuple(as_columns(data[str(i)], part) for i, part in enumerate(like))
    return list(data) if isinstance(like, list) else data.numpy()


@pytest.mark.parametrize("name", SPACES)
def test_each_transition_once(name: str, tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(
        [record(tmp_path / f"{i}.mcap", SPACES[name], 30, seed=i) for i in range(2)]
    )
    transitions = dataset.transitions()
    buffer = replay_buffer(transitions, 20, sampler=SamplerWithoutReplacement())
    seen = []
    for _ in range(3):
        batch = buffer.sample()
        numbers = batch["index"].numpy()
        expected = transitions[numbers]
        assert same(as_columns(batch["observation"], expected.states), expected.states)
        assert same(as_columns(batch["next", "observation"], expected.next_states), expected.next_states)
        assert same(batch["action"].numpy(), expected.actions)
        assert same(batch["next", "reward"].numpy(), expected.rewards[:, None])
        assert same(batch["next", "terminated"].numpy(), expected.terminals[:, None])
        assert same(
            batch["next", "truncated"].numpy()[expected.timeouts], np.ones((expected.timeouts.sum(), 1), bool)
        )
        seen += numbers.tolist()
    assert sorted(seen) == list(range(60))


def test_what_does_not_go_on_is_done(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["box"], 30, length=8))
    storage = RecordedStorage(dataset.transitions())
    following = storage[:]["next"]
    assert np.flatnonzero(following["done"]).tolist() == [7, 15, 23, 29]
    assert np.flatnonzero(following["truncated"]).tolist() == [23, 29]  # every third by timeout; interrupted
    assert storage.get(-1)["next", "done"].item()
    assert storage.get([-1, 0])["next", "truncated"].tolist() == [[True], [False]]
    cut = RecordedStorage(dataset.with_tuple_filter(F("step") != 3).transitions())
    assert np.flatnonzero(cut[:]["next", "truncated"])[:2].tolist() == [2, 9]
    assert np.flatnonzero(cut[:]["next", "terminated"])[:2].tolist() == [6, 13]


def test_next_observations_that_were_not_recorded(tmp_path: Path) -> None:
    episodes = [
        EpisodeData([0, 1], [0, 0], [1.0, 1.0], [False] * 2, [False] * 2, final) for final in (2, None)
    ]
    path = tmp_path / "a.mcap"
    write_recording(path, episodes, observation_space=spaces.Discrete(9), action_space=spaces.Discrete(2))
    batch = RecordedStorage(TupliDataset.from_files(path).transitions())[:]
    assert batch["mask"].tolist() == [True, True, True, False]
    assert batch["next", "observation"].tolist() == [1, 2, 1, 1]


def test_transitions_of_a_mask_of_numbers_and_of_nothing_else(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["box"], 30, length=8))
    storage, buffer = RecordedStorage(dataset.transitions()), replay_buffer(dataset.transitions(), 4)
    done = storage[:]["next", "done"][:, 0]
    for found in (storage[done], storage[done.numpy()], buffer[done]):
        assert torch.equal(found["observation"], storage[[7, 15, 23, 29]]["observation"])
    assert storage[~done & done].shape == storage[[]].shape == (0,)
    with pytest.raises(SamplingError, match="expected a mask of 30 transitions, found one of shape"):
        storage[done[1:]]
    with pytest.raises(SamplingError, match="expected numbers from 0 to 29 in one dimension"):
        storage[torch.tensor([1.5])]
    with pytest.raises(IndexError, match="expected numbers from 0 to 29, found -31"):
        storage[-31]


def test_slices_of_episodes(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["box"], 70))
    sampler = SliceSampler(num_slices=4, end_key=("next", "done"))
    batch = replay_buffer(dataset.transitions(), 20, sampler=sampler).sample().reshape(4, 5)
    assert (batch["episode"] == batch["episode"][:, :1]).all()
    assert (batch["index"].diff(dim=1) == 1).all()


def test_a_storage_by_number_and_elsewhere(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", SPACES["nested"], 30))
    storage = pickle.loads(pickle.dumps(RecordedStorage(dataset.transitions())))
    one = storage[4]
    assert one.batch_size == ()
    assert same(
        as_columns(one["observation"], at(dataset.observations, 4))["b"][1], dataset.observations["b"][1][4]
    )
    assert storage[torch.tensor([[1, 2], [3, 4]])].batch_size == (2, 2)
    assert 29 in storage
    assert 30 not in storage


def test_what_a_storage_refuses(tmp_path: Path) -> None:
    dataset = TupliDataset.from_files(record(tmp_path / "a.mcap", spaces.Discrete(3), 30))
    transitions = dataset.transitions()
    with pytest.raises(SamplingError, match=r"expected dataset\.transitions\(\) over one step, found <30"):
        RecordedStorage(dataset.transitions(3))
    with pytest.raises(
        SamplingError, match="expected transitions with all fields, found none of next_states, term"
    ):
        RecordedStorage(dataset.transitions(fields=["states", "actions", "rewards"]))
    with pytest.raises(SamplingError, match="a RecordedStorage is read-only"):
        RecordedStorage(transitions).set(0, None)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        replay_buffer(transitions, 4).extend(RecordedStorage(transitions)[:2])
    other = RecordedStorage(dataset.with_episode_filter(F("n_tuples") > 5).transitions())
    with pytest.raises(SamplingError, match="found one of other episodes"):
        other.load_state_dict(RecordedStorage(transitions).state_dict())


def test_without_torchrl_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ["torchrl", *(each for each in sys.modules if each.startswith("torchrl."))]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "tupli_mcap.torch.rl", raising=False)
    with pytest.raises(MissingExtraError, match=r"(?s)tupli_mcap[.]torch[.]rl needs TorchRL.*\[torchrl\]"):
        importlib.import_module("tupli_mcap.torch.rl")
