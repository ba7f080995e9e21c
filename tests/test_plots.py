"""Reports: the numbers behind them against NumPy on the whole data, and pictures of every kind of environment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import roll

from tupli_mcap import (
    RecordEpisodes,
    Recording,
)
from tupli_mcap.plots import gather, report
from tupli_mcap.plots.gather import measure


def record(path: Path, env: gym.Env[Any, Any], steps: int, seed: int = 1) -> Path:
    with RecordEpisodes(env, path) as recorded:
        roll(recorded, steps, seed)
    return path


@pytest.fixture
def cartpole(tmp_path: Path) -> Path:
    return record(tmp_path / "cartpole.mcap", gym.make("CartPole-v1"), 400)


def measured(path: Path) -> gather.Measured:
    with Recording(path) as recording:
        return measure(recording, np.arange(len(recording)))


# --- numbers ---


def test_moments_and_ranges_are_those_of_the_whole_data(
    cartpole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tupli_mcap.recording.blocks.BLOCK_BYTES", 1000)  # many blocks, parts of episodes too
    found = measured(cartpole)
    with Recording(cartpole) as recording:
        states = recording.read().states.astype(np.float64)
        actions = recording.read().actions
    (state,) = found.states
    np.testing.assert_allclose(state.mean, states.mean(axis=0), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(state.std, states.std(axis=0), rtol=1e-9)
    np.testing.assert_array_equal(state.least, states.min(axis=0))
    np.testing.assert_array_equal(state.most, states.max(axis=0))
    np.testing.assert_array_equal(state.sample, states)
    (action,) = found.actions
    np.testing.assert_array_equal(action.counts[0], np.bincount(actions, minlength=2))
    assert found.read_steps == found.steps == 400 and found.notes() == []


def test_a_report_is_made_in_every_format(cartpole: Path, tmp_path: Path) -> None:
    made = report(cartpole)
    for suffix, head in ((".png", b"\x89PNG"), (".svg", b"<?xml"), (".html", b"<!DOCTYPE html>")):
        assert made.save(tmp_path / f"report{suffix}").read_bytes().startswith(head)
