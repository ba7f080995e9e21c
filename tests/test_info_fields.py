"""Infos as fields of windows, transitions and loaders."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import Scripted

import tupli_mcap
from tupli_mcap import F, RecordEpisodes, TupliDataset
from tupli_mcap.dataset import open_columns
from tupli_mcap.dataset.items import SamplingError


def info(step: int) -> dict[str, Any]:
    found: dict[str, Any] = {"step": step, "force": np.array([step, -step], np.float32), "name": f"at {step}"}
    return found | ({"rare": step / 2} if step % 3 == 0 else {})


@pytest.fixture
def dataset(tmp_path: Path) -> tupli_mcap.Dataset:
    env = Scripted(
        lambda n: np.array([n], np.float32), gym.spaces.Box(-1e3, 1e3, (1,), np.float32), info=info, length=5
    )
    with RecordEpisodes(env, tmp_path / "r.mcap", record_info=True) as recorded:
        for seed in range(3):
            recorded.reset(seed=seed)
            for _ in range(5):
                recorded.step(0)
    return tupli_mcap.open(tmp_path / "r.mcap")


def test_of_windows(dataset: tupli_mcap.Dataset) -> None:
    batch = dataset.windows(2, fields=["states", "infos"])[[0, 5]]
    assert batch.infos["step"].tolist() == [[1, 2], [2, 3]]
    assert batch.infos["step"].dtype == np.int64
    assert batch.infos["force"].shape == (2, 2, 2)
    assert batch.infos["force"].dtype == np.float32
    assert batch.infos["name"] == [["at 1", "at 2"], ["at 2", "at 3"]]
    np.testing.assert_array_equal(batch.infos["rare"], [[np.nan, np.nan], [np.nan, 1.5]])
    one = dataset.windows(2, history=1, pad="zero", fields="info.force")[0]
    assert set(one.infos) == {"force"}
    np.testing.assert_array_equal(one.infos["force"], [[0, 0], [1, -1], [2, -2]])
    assert one.states is None


def test_of_transitions(dataset: tupli_mcap.Dataset) -> None:
    items = dataset.sort("seed", descending=True).head(2).transitions(2, fields=["rewards", "info.step"])
    assert items[:].infos["step"].tolist() == [1, 2, 3, 4, 5] * 2
    assert items[3].infos["step"] == 4


@pytest.mark.parametrize("workers", [0, 1])
def test_of_a_loader(dataset: tupli_mcap.Dataset, workers: int) -> None:
    torch = pytest.importorskip("torch", reason="PyTorch is not installed")
    fields = ["states", "info.step", "infos.force"]
    loader = dataset.loader(3, batch_size=4, seed=1, num_workers=workers, fields=fields)
    batches = list(loader)
    assert sum(len(batch["states"]) for batch in batches) == 9
    for batch in batches:
        # the info of a step tells how many steps were taken, and its state how many had been
        assert torch.equal(batch["infos"]["step"], batch["states"][..., 0].long() + 1)
        assert batch["infos"]["force"].shape[1:] == (3, 2)


def test_a_copy_in_another_process_has_them(dataset: tupli_mcap.Dataset) -> None:
    windows = dataset.windows(2, fields=["states", "infos"])
    copied = pickle.loads(pickle.dumps(windows))
    np.testing.assert_array_equal(copied[3].infos["step"], windows[3].infos["step"])
    np.testing.assert_array_equal(copied[3].states, windows[3].states)


def test_says_what_there_is(dataset: tupli_mcap.Dataset, tmp_path: Path) -> None:
    with pytest.raises(SamplingError, match="did you mean 'force'"):
        dataset.windows(2, fields=["infos.forse"])
    later = TupliDataset(tmp_path).with_tuple_filter(F("info.step") > 2)
    assert later.windows(3, fields=["info.step"])[0].infos["step"].tolist() == [3, 4, 5]
    later.save_columns(tmp_path / "columns")
    with pytest.raises(SamplingError, match=r"tupli_mcap\.open"):
        open_columns(tmp_path / "columns").windows(2, fields=["infos"])
    with pytest.raises(SamplingError, match="expected fields"):
        dataset.transitions(fields=["inform"])
