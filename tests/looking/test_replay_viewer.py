"""What `tupli-mcap view` sends to Rerun, read back from the files it writes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import tupli_mcap
from tupli_mcap import RecordEpisodes, viewer
from tupli_mcap.cli import app
from tupli_mcap.errors import RecordingError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe.description import describe
from tupli_mcap.schema.times import local_text

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
    goal = viewer.save(cartpole, tmp_path / "out.rrd", "all")
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
    times = np.array(found.rows("/state", "time"))
    assert np.array_equal(times[steps], columns.times)
    assert abs(times[finals] - times[np.array(finals) - 1]).max() < 2000
    assert (np.diff(times) >= 0).all()
    ends = [row for how in ("terminal", "timeout", "interrupted") for row in _rows_at(found, f"/end/{how}")]
    assert sorted(ends) == [row - 1 for row in finals]
    assert np.array_equal(found.scalars("/overview/length")[:, 0], lengths)


def test_of_many_episodes_the_last_the_best_and_the_worst_are_shown(tmp_path: Path) -> None:
    path = tmp_path / "many.mcap"
    rewards = [4.0, 2, 9, 3, -1, 5, 5, 5, 5, 5, 5, 6]
    with RecordEpisodes(Goes(*rewards), path) as env:
        for _ in rewards:
            env.reset()
            env.step(0)
    notes: list[str] = []
    found = Rrd(viewer.save(path, tmp_path / "out.rrd", note=notes.append))
    assert found.scalars("/reward")[:, 0].tolist() == [6, 9, -1]
    card = found.rows("/card", "TextDocument:text")[0][0]
    assert notes[0].startswith("3 of 12 episodes: 11 (last), 2 (best), 4 (worst)")
    assert card.startswith("3 of 12 episodes") and "- from step 2: **Episode 2**: 1 step, return 9" in card
    (marks,) = found.rows("/overview/shown", "BarChart:values")[0]
    assert list(marks["buffer"]) == [6, 9, -1]
    every = Rrd(viewer.save(path, tmp_path / "all.rrd", "all", note=notes.append))
    assert every.scalars("/reward")[:, 0].tolist() == rewards
    assert len(notes) == 1 and "/overview/shown" not in every.entities()
    assert every.recordings[0].application_id != found.recordings[0].application_id


def test_few_episodes_are_all_shown(tmp_path: Path) -> None:
    path = tmp_path / "few.mcap"
    with RecordEpisodes(Goes(), path) as env:
        for _ in range(10):
            env.reset()
            env.step(0)
    notes: list[str] = []
    found = Rrd(viewer.save(path, tmp_path / "few.rrd", note=notes.append))
    assert len(found.scalars("/reward")) == 10 and not notes


def test_the_choice_is_of_each_recording_and_of_many_of_all(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in "abcd"]
    for i, path in enumerate(paths):
        with RecordEpisodes(Goes(*[float(i)] * 6), path, name=f"run {path.stem}") as env:
            for _ in range(6):
                env.reset()
                env.step(0)
    notes: list[str] = []
    two = Rrd(viewer.save(paths[:2], tmp_path / "two.rrd", note=notes.append))
    assert notes[0].startswith(
        "4 of 12 episodes: 5 (last), 0 (best, worst) of run a; 5 (last), 0 (best, worst) of run b"
    )
    assert two.scalars("/reward")[:, 0].tolist() == [0, 0, 1, 1]
    four = Rrd(viewer.save(paths, tmp_path / "four.rrd", note=notes.append))
    assert notes[1].startswith(
        "3 of 24 episodes: 5 of run d (last), 0 of run d (best), 0 of run a (worst). Others: "
    )
    assert four.scalars("/reward")[:, 0].tolist() == [3, 3, 0]
    # the returns are of all recordings, also of those without a chosen episode
    assert four.scalars("/overview/return")[:, 0].tolist() == [float(i) for i in range(4) for _ in range(6)]
    (marks,) = four.rows("/overview/shown", "BarChart:values")[0]
    assert list(marks["buffer"]) == [3, 3, 0]


def test_success_and_the_name_of_the_run_are_told(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    with RecordEpisodes(Goes(succeeded=[True, False]), path, name="ppo-seed3") as env:
        for _ in range(2):
            env.reset()
            env.step(0)
    found = Rrd(viewer.save(path, tmp_path / "r.rrd"))
    card = found.rows("/card", "TextDocument:text")[0][0]
    assert "### ppo-seed3" in card and "| success | 50% |" in card
    assert f"| recorded | {local_text(describe(Recording(path)).created_ns)} |" in card.replace("\\", "")
    assert "**Episode 0**: 1 step, return 0, terminal, success" in card
    assert "**Episode 1**: 1 step, return 0, terminal, no success" in card


def test_the_title_names_the_runs(tmp_path: Path) -> None:
    paths = [tmp_path / f"{name}.mcap" for name in "abcde"]
    for path in paths:
        with RecordEpisodes(Goes(), path, name=f"run {path.stem}") as env:
            env.reset()
            env.step(0)
    titles = []
    for count in (1, 2, 5):
        found = Rrd(viewer.save(paths[:count], tmp_path / f"{count}.rrd"))
        titles += found.rows("/__properties", "RecordingInfo:name")
    assert titles == [["run a"], ["run a, run b"], ["run a, run b, run c and 2 more"]]


def test_the_runs_of_a_file_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "both.mcap"
    for name in ("run a", "run b"):
        with RecordEpisodes(Goes(), path, name=name, mode="a") as env:
            for _ in range(12):
                env.reset()
                env.step(0)
    found = Rrd(viewer.save(path, tmp_path / "b.rrd", filter='run.name = "run b"', episodes="best"))
    assert found.rows("/__properties", "RecordingInfo:name") == [["run b"]]
    assert "### both" in found.rows("/card", "TextDocument:text")[0][0]
    found = Rrd(viewer.save(path, tmp_path / "both.rrd"))
    assert found.rows("/__properties", "RecordingInfo:name") == [["run a, run b"]]
    assert re.search("of run a; .* of run b", found.rows("/card", "TextDocument:text")[0][0])


class Goes(gym.Env[Any, Any]):
    """Episodes of a step, whose infos may say whether it succeeded."""

    observation_space, action_space = gym.spaces.Box(0, 1, (1,)), gym.spaces.Discrete(2)

    def __init__(self, *rewards: float, succeeded: Sequence[bool] = ()) -> None:
        self._rewards, self._succeeded = list(rewards), list(succeeded)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        info = {"is_success": self._succeeded.pop(0)} if self._succeeded else {}
        return np.zeros(1, np.float32), self._rewards.pop(0) if self._rewards else 0.0, True, False, info


def _rows_at(found: Rrd, entity: str) -> list[int]:
    return found.rows(entity, "step") if entity in found.entities() else []


def test_one_episode_starts_at_step_0(cartpole: Path, tmp_path: Path) -> None:
    with Recording(cartpole) as recording:
        goal = recording.view("2", save=tmp_path / "out.rrd")
        episode = recording.episodes[2]
        found = Rrd(goal)
        assert found.rows("/state", "step") == list(range(len(episode) + 1))
        assert found.rows("/reward", "step") == list(range(len(episode)))
        assert np.array_equal(found.scalars("/state"), states_of(episode))
        assert found.scalars("/end/terminal").tolist() == [[episode.return_]]


def test_a_dataset_shows_its_episodes_and_an_episode_itself(cartpole: Path, tmp_path: Path) -> None:
    every = tupli_mcap.open([cartpole, record(tmp_path / "other.mcap", "CartPole-v1", 300)])
    best = every.sort("return", descending=True)[:2]
    found = Rrd(best.view("all", save=tmp_path / "best.rrd"))
    assert found.scalars("/end/terminal").tolist() == [[episode.return_] for episode in best.sort("id")]
    assert len(found.rows("/reward", "step")) == best.n_steps
    shorter = every.view("worst", save=tmp_path / "worst.rrd", filter="steps > 9")
    assert len(Rrd(shorter).rows("/reward", "step")) == every.filter("steps > 9").lengths.min()
    assert Rrd(every[1].view(save=tmp_path / "one.rrd")).rows("/reward", "step") == list(
        range(every.lengths[1])
    )
    with pytest.raises(RecordingError, match="the dataset has no episode 99"):
        every.view([99], save=tmp_path / "none.rrd")


def test_apart_each_episode_is_a_recording(cartpole: Path, tmp_path: Path) -> None:
    found = Rrd(viewer.save(cartpole, tmp_path / "out.rrd", [3, 1], form="apart"))
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
            root = f"/episode_{number}"
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
    assert "out.rrd exists; choose another path, or pass --force" in capfd.readouterr().err
    assert goal.read_bytes() == b"mine"
    assert not app([*words, "--force", "--episode", "best"], standalone_mode=False)
    assert "open it with: rerun" in capfd.readouterr().out
    assert len(Rrd(goal).recordings) == 1
    assert list(tmp_path.iterdir()) == [goal]
