"""What `tupli-mcap replay` sends to Rerun, read back from the files it writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from tupli_mcap import RecordEpisodes, viewer
from tupli_mcap.cli import app
from tupli_mcap.recording import Recording

rr = pytest.importorskip("rerun")
from rrd import Rrd, joined_rows, states_of  # noqa: E402


def record(path: Path, env: str, steps: int, seed: int = 3, **options: Any) -> Path:
    with RecordEpisodes(gym.make(env, **options), path) as recorder:
        recorder.action_space.seed(seed)
        recorder.reset(seed=seed)
        for _ in range(steps):
            *_, terminated, truncated, _ = recorder.step(recorder.action_space.sample())
            if terminated or truncated:
                recorder.reset()
    return path


@pytest.fixture(scope="module")
def cartpole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("cartpole") / "cartpole.mcap", "CartPole-v1", 300)


PUSHES = ("Push cart to the left", "Push cart to the right")


def test_every_step_is_sent(cartpole: Path, tmp_path: Path) -> None:
    goal = viewer.save(cartpole, tmp_path / "out.rrd")
    found = Rrd(goal)
    assert len(found.recordings) == 1 and len(found.blueprints) == 1
    with Recording(cartpole) as recording:
        columns = recording.read(fields=["states", "actions", "rewards", "times"])
        lengths = recording.index["length"]
        states = np.concatenate([states_of(episode) for episode in recording.episodes])
    steps, finals = joined_rows(lengths)
    assert len(finals) > 5
    assert np.array_equal(found.scalars("/state"), states)
    assert found.rows("/state", "step") == list(range(300 + len(lengths)))
    held = np.array(found.held("/action", 300 + len(lengths)))
    assert held[steps].tolist() == [PUSHES[action] for action in columns.actions]
    assert (held[finals] == "").all()  # no action was chosen there
    assert np.array_equal(found.scalars("/reward")[:, 0], columns.rewards)
    running = np.concatenate([np.arange(1.0, n + 1) for n in lengths])
    assert np.array_equal(found.scalars("/return")[:, 0], running)
    assert found.rows("/reward", "step") == found.rows("/return", "step") == steps
    times = np.array(found.rows("/state", "time"), "datetime64[ns]").astype(np.int64)
    assert abs(times[steps] - columns.times).max() < 1000  # Python's own times have microseconds
    assert abs(times[finals] - times[np.array(finals) - 1]).max() < 2000
    assert (np.diff(times) >= 0).all()
    ends = [row for how in ("terminal", "timeout", "interrupted") for row in _rows_at(found, f"/end/{how}")]
    assert sorted(ends) == [row - 1 for row in finals]
    assert np.array_equal(found.scalars("/overview/length")[:, 0], lengths)


def _rows_at(found: Rrd, entity: str) -> list[int]:
    return found.rows(entity, "step") if entity in found.entities() else []


def test_one_episode_starts_at_step_0(cartpole: Path, tmp_path: Path) -> None:
    with Recording(cartpole) as recording:
        goal = recording.replay(save=tmp_path / "out.rrd", episodes="2")
        episode = recording.episodes[2]
        found = Rrd(goal)
        assert found.rows("/state", "step") == list(range(len(episode) + 1))
        assert found.rows("/reward", "step") == list(range(len(episode)))
        assert np.array_equal(found.scalars("/state"), states_of(episode))
        assert found.scalars("/end/terminal").tolist() == [[episode.return_]]


def test_split_gives_a_recording_an_episode(cartpole: Path, tmp_path: Path) -> None:
    found = Rrd(viewer.save(cartpole, tmp_path / "out.rrd", [3, 1], form="split"))
    assert len(found.recordings) == 2 and len(found.blueprints) == 1
    assert len({entry.application_id for entry in found.recordings}) == 1
    with Recording(cartpole) as recording:
        for i, number in enumerate([1, 3]):
            episode = recording.episodes[number]
            assert np.array_equal(found.scalars("/state", i), states_of(episode))
            assert found.rows("/state", "step", i) == list(range(len(episode) + 1))
            assert found.rows("/action", "step", i)[-1] == len(episode)
            assert found.rows("/action", "StateChange:state", i)[-1] == [""]


def test_compare_puts_each_episode_below_its_own_root(cartpole: Path, tmp_path: Path) -> None:
    found = Rrd(viewer.save(cartpole, tmp_path / "out.rrd", "first,4", form="compare"))
    assert len(found.recordings) == 1
    with Recording(cartpole) as recording:
        for number in (0, 4):
            episode = recording.episodes[number]
            root = f"/compared/episode_{number}"
            assert found.rows(f"{root}/state/dims_1", "step") == list(range(len(episode) + 1))
            assert np.array_equal(found.scalars(f"{root}/state/dims_1")[:, 0], states_of(episode)[:, 1])
            assert found.rows(f"{root}/reward", "step") == list(range(len(episode)))
            pushes = [PUSHES[action] for action in episode.actions]
            assert found.held(f"{root}/action", len(episode) + 2) == [*pushes, "", ""]


def test_an_episode_into_a_stream_of_ones_own(cartpole: Path, tmp_path: Path) -> None:
    stream = rr.RecordingStream("mine")
    stream.save(tmp_path / "mine.rrd")
    with Recording(cartpole) as recording:
        assert recording.episodes[1].to_rerun(stream) is stream
        stream.disconnect()
        states = Rrd(tmp_path / "mine.rrd").scalars("/state")
        assert np.array_equal(states, states_of(recording.episodes[1]))


def test_a_file_is_replaced_only_if_told(
    cartpole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    goal = tmp_path / "out.rrd"
    goal.write_bytes(b"mine")
    words = ["replay", str(cartpole), "--save", str(goal)]
    assert app(words, standalone_mode=False) == 1
    assert "out.rrd exists already; choose another name, or replace it with --force" in capfd.readouterr().err
    assert goal.read_bytes() == b"mine"
    assert not app([*words, "--force", "--episode", "best"], standalone_mode=False)
    assert "open it with: rerun" in capfd.readouterr().out
    assert len(Rrd(goal).recordings) == 1
    assert list(tmp_path.iterdir()) == [goal]
