"""A rollout in several files: no step lost, episodes whole where they can be, every file a recording of its own."""

from __future__ import annotations

import contextlib
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from environments import same
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from receiving import receiver, url
from waiting import free_port

from tupli_mcap import (
    FileStorage,
    RecordEpisodes,
    Recording,
    RecordingError,
    TupliDataset,
    TupliEnvWrapper,
    verify_recording,
)
from tupli_mcap.recording.write import chunks, rotation
from tupli_mcap.recording.write.rotation import series
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes as RecordVector
from tupli_mcap.wrappers.rollout import record_rollouts

Step = tuple[Any, ...]


class Endless(gym.Env[Any, Any]):
    """Returns the same array again and again; `ends` says after how many steps episodes end, if they do."""

    observation_space, action_space = gym.spaces.Box(-9, 9, (9,)), gym.spaces.Discrete(3)

    def __init__(self, ends: int = 0) -> None:
        self._ends = ends

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._state, self._steps = np.zeros(9, np.float32), 0
        return self._state, {}

    def step(self, action: Any) -> Any:
        self._state[...] = self.np_random.normal(size=9)
        self._steps += 1
        return self._state, 0.5, bool(self._ends) and self._steps % self._ends == 0, False, {}


class Count(EpisodeMetadataCallback):
    """Metadata: the steps of the episode."""

    steps = 0

    def reset(self) -> None:
        self.steps = 0

    def __call__(self, tuple: RLTuple) -> dict[str, Any]:
        self.steps += 1
        return {"steps": self.steps}


def roll(env: Any, steps: int, *, seed: int | None = 1, ends: bool = True) -> list[Step]:
    """Random steps, as they were given; a reset after each end, unless the environment needs none."""
    state, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    told = []
    for _ in range(steps):
        action, before = env.action_space.sample(), np.array(state)
        state, reward, terminal, timeout, _ = env.step(action)
        told.append((before, action, reward, terminal, timeout))
        if ends and (terminal or timeout):
            state, _ = env.reset()
    return told


def recorded(paths: list[Path], env: int = 0) -> list[Step]:
    """The steps of a sub-environment in all files, which are sound."""
    found = []
    for path in paths:
        assert verify_recording(path).problems == []
        with Recording(path) as recording:
            assert recording.complete
            episodes = [episode for episode in recording.episodes if episode.env == env]
            found += [tuple(step)[:5] for episode in episodes for step in episode]
    return found


def ends_of(paths: list[Path]) -> list[str]:
    return [episode.end for path in paths for episode in Recording(path).episodes]


class TestSingle:
    def test_no_step_is_lost_and_episodes_stay_whole(self, tmp_path: Path) -> None:
        with RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "run.mcap", max_bytes=20_000, chunk_size=1000
        ) as env:
            told = roll(env, 2000)
            assert env.path == env.paths[-1]
        names = [path.name for path in env.paths]
        assert names == ["run.mcap", *(f"run_{i:04}.mcap" for i in range(1, len(names)))]
        assert len(names) > 3
        assert names == sorted(names)
        assert sorted(path.name for path in tmp_path.iterdir()) == names
        assert same(recorded(env.paths), told)
        assert set(ends_of(env.paths[:-1])) <= {"terminal", "timeout"}
        sizes = [path.stat().st_size for path in env.paths[:-1]]
        head = sum(a.size for a in Recording(env.paths[0]).attachments.values())
        assert all(20_000 <= size < 35_000 + head for size in sizes)  # the summary comes after that

    def test_files_are_recordings_of_one_benchmark_and_read_as_one(self, tmp_path: Path) -> None:
        env = RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "run.mcap", max_bytes=8000, chunk_size=1000,
            benchmark_id="abc", attachments={"note": ("text/plain", b"x" * 9000)}, labels={"action": ["left", "right"]},
        )  # fmt: skip
        with env:
            told = roll(env, 1000)
        for path in env.paths:
            with Recording(path) as recording:
                assert recording.benchmark_id == "abc"
                assert recording.read_attachment("note") == b"x" * 9000
                assert recording.labels.values["action"] == ("left", "right")
        assert len({Recording(path).uuid for path in env.paths}) == len(env.paths) > 2
        dataset = TupliDataset.from_files(tmp_path / "run*.mcap")
        dataset.load()
        states, actions, *_ = dataset.convert_to_numpy()
        assert np.array_equal(states, [step[0] for step in told])
        assert np.array_equal(actions, [step[1] for step in told])

    def test_an_endless_episode_goes_on_in_its_file_until_a_reset(self, tmp_path: Path) -> None:
        env = RecordEpisodes(
            Endless(), tmp_path / "run.mcap", max_bytes=8000, chunk_size=1000, metadata_callback=Count()
        )
        with env:
            told = roll(env, 800)
            assert env.paths == [tmp_path / "run.mcap"]
            told += roll(env, 30)
        assert same(recorded(env.paths), told)
        (first,), (second,) = (Recording(path).episodes for path in env.paths)
        assert (first.end, len(first), first.metadata) == ("interrupted", 800, {"steps": 800})
        assert (second.end, len(second), second.metadata) == ("interrupted", 30, {"steps": 30})
        assert not second.start.continued

    def test_steps_after_an_end_without_a_reset_go_on_in_the_next_file(self, tmp_path: Path) -> None:
        env = RecordEpisodes(Endless(ends=50), tmp_path / "run.mcap", max_bytes=2000, chunk_size=500)
        with env:
            told = roll(env, 200, ends=False)
        assert len(env.paths) == 4
        assert same(recorded(env.paths), told)
        episodes = [Recording(path).episodes[0] for path in env.paths]
        assert [episode.start.continued for episode in episodes] == [False, True, True, True]

    def test_by_time(self, tmp_path: Path) -> None:
        env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", max_seconds=0.1)
        told, newest = [], set()
        with env:
            for i in range(3):
                told += roll(env, 60, seed=i)
                newest.add(env.path)
                time.sleep(0.13)
        assert len(newest) == 3
        assert same(recorded(env.paths), told)

    def test_environments_that_reset_themselves(self, tmp_path: Path) -> None:
        inner = gym.wrappers.Autoreset(gym.make("CartPole-v1"))
        env = RecordEpisodes(inner, tmp_path / "run.mcap", max_bytes=20_000, chunk_size=1000)
        with env:
            told = roll(env, 1000, ends=False)
        holes = [0, *(i + 1 for i, step in enumerate(told) if step[3] or step[4])][1:]
        assert len(env.paths) > 2
        assert same(recorded(env.paths), [step for i, step in enumerate(told) if i not in holes])
        assert "interrupted" not in ends_of(env.paths[:-1])

    def test_frames_and_infos_go_on(self, tmp_path: Path) -> None:
        env = RecordEpisodes(
            gym.make("CartPole-v1", render_mode="rgb_array"), tmp_path / "run.mcap", max_bytes=60_000,
            chunk_size=1000, frames=10, record_info=True, step_callback=lambda step: {"reward": step.reward},
        )  # fmt: skip
        with env:
            roll(env, 150)
        assert len(env.paths) > 1
        recorded(env.paths)
        for path in env.paths:
            with Recording(path) as recording:
                for episode in recording.episodes:
                    assert [step.info for step in episode] == [{"reward": 1.0}] * len(episode)
                    wanted = [i for i in range(len(episode) + 1) if i % 10 == 0]
                    assert episode.frames.steps.tolist() == sorted(
                        {*wanted, *([len(episode)] if episode.end == "terminal" else [])}
                    )

    def test_the_live_view_goes_on(self, tmp_path: Path) -> None:
        port = free_port()
        with receiver(port, tmp_path / "r.rrd"):
            env = RecordEpisodes(
                gym.make("CartPole-v1"),
                tmp_path / "run.mcap",
                max_bytes=9000,
                chunk_size=1000,
                live=url(port),
            )
            with env, warnings.catch_warnings():
                warnings.simplefilter("error")
                for i in range(12):
                    roll(env, 40, seed=i)
                    time.sleep(0.05)
        assert len(env.paths) > 2
        assert (tmp_path / "r.rrd").read_bytes().count(b"run_0001") > 0

    def test_rows_are_limited_too(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(rotation, "_MANY_ROWS", 100)
        env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", chunk_size=500)
        with env:
            told = roll(env, 400)
        assert len(env.paths) > 1
        assert same(recorded(env.paths), told)

    def test_an_episode_of_more_rows_than_a_file_takes_is_refused(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(chunks, "_MOST_ROWS", 300)
        env, steps = RecordEpisodes(Endless(), tmp_path / "run.mcap", chunk_size=1000), 0
        env.reset(seed=1)
        with pytest.raises(RecordingError, match="at most 300 messages in a channel.* new recording"):
            while steps < 1000:
                env.step(0)
                steps += 1
        with pytest.raises(RecordingError, match="at most 300 messages in a channel"):
            env.reset()
        env.close()
        assert 300 <= steps < 400
        assert len(recorded(env.paths)) == steps + 1  # the one that was refused is in the journal

    def test_attachments_do_not_fill_a_file(self, tmp_path: Path) -> None:
        big = {"weights": ("application/octet-stream", bytes(50_000))}
        env = RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "run.mcap", max_bytes=20_000, attachments=big
        )
        with env:
            roll(env, 100)
        assert env.paths == [tmp_path / "run.mcap"]


class TestGoingOn:
    def record(self, path: Path, mode: Any, steps: int, seed: int) -> tuple[list[Step], list[Path]]:
        env = RecordEpisodes(gym.make("CartPole-v1"), path, mode=mode, max_bytes=8000, chunk_size=1000)
        with env:
            return roll(env, steps, seed=seed), env.paths

    def test_append_goes_on_in_the_last_file(self, tmp_path: Path) -> None:
        path = tmp_path / "run.mcap"
        first, paths = self.record(path, "x", 300, 1)
        second, more = self.record(path, "a", 300, 2)
        assert more[0] == paths[-1]
        assert same(recorded(sorted({*paths, *more})), [*first, *second])
        third, _ = self.record(paths[-1], "a", 300, 3)  # a file of the series stands for all
        base, later = series(path)
        assert same(recorded([base, *later.values()]), [*first, *second, *third])

    def test_a_file_with_a_date_is_of_no_series(self, tmp_path: Path) -> None:
        dated = tmp_path / "run_20231105.mcap"
        first, _ = self.record(dated, "x", 30, 1)
        second, paths = self.record(tmp_path / "run.mcap", "a", 300, 2)
        assert paths[0] == tmp_path / "run.mcap" and dated not in paths
        assert (same(recorded([dated]), first), same(recorded(paths), second)) == (True, True)

    @pytest.mark.parametrize("mode", ["x", "w"])
    def test_another_series_is_not_mixed_in(self, tmp_path: Path, mode: str) -> None:
        _, paths = self.record(tmp_path / "run.mcap", "x", 300, 1)
        paths[0].unlink()
        before = {path: path.read_bytes() for path in paths[1:]}
        with pytest.raises(RecordingError, match=r"run_0001\.mcap.* of an earlier series .* delete them"):
            self.record(tmp_path / "run.mcap", mode, 10, 1)
        assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before

    def test_the_next_file_cannot_be_made(self, tmp_path: Path) -> None:
        """What was recorded stays, and recording goes on where it was."""
        env = RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", max_bytes=4000, chunk_size=1000)
        refused = 0

        def no() -> Any:
            raise RecordingError("no more files")

        with env:
            env.rotation.beginning = no
            told, state = [], env.reset(seed=1)[0]
            for _ in range(300):
                before = np.array(state)
                try:
                    state, _, terminal, timeout, _ = env.step(0)
                except RecordingError as err:
                    assert str(err) == "no more files"  # noqa: PT017 - it comes again and again
                    refused += 1
                    state, terminal, timeout = env.unwrapped.state, True, False
                told.append(before)
                if terminal or timeout:
                    env.rotation.beginning = contextlib.nullcontext
                    env.rotation._max_bytes = 10**9
                    state, _ = env.reset()
                    env.rotation.beginning, env.rotation._max_bytes = no, 4000
        assert refused > 2
        assert env.paths == [tmp_path / "run.mcap"]
        assert same([step[0] for step in recorded(env.paths)], told)

    @pytest.mark.parametrize("limit", [{"max_bytes": np.int64(10**6)}, {"max_seconds": np.float32(9)}])
    def test_limits_may_be_of_numpy(self, tmp_path: Path, limit: dict[str, Any]) -> None:
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", **limit) as env:
            env.reset(seed=1)
            env.step(0)
        assert [path.name for path in env.paths] == ["run.mcap"]

    @pytest.mark.parametrize("limit", [{"max_bytes": 0}, {"max_seconds": -1.0}, {"max_bytes": "1 GB"}])
    def test_limits_are_positive(self, tmp_path: Path, limit: dict[str, Any]) -> None:
        with pytest.raises(RecordingError, match=r"max_(bytes|seconds): expected a positive number or None"):
            RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", **limit)
        assert list(tmp_path.iterdir()) == []


class Wide(gym.Env[Any, Any]):
    """Episodes of 20 steps, or of a random number, with states that fill chunks quickly."""

    observation_space, action_space = gym.spaces.Box(-9, 9, (250,), np.float64), gym.spaces.Discrete(3)

    def __init__(self, fixed: bool) -> None:
        self._fixed = fixed

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._left = 20 if self._fixed else int(self.np_random.integers(1, 40))
        return self.np_random.uniform(-9, 9, 250), {"left": self._left}

    def step(self, action: Any) -> Any:
        self._left -= 1
        return self.np_random.uniform(-9, 9, 250), 0.5, self._left == 0, False, {}


class TestVector:
    @pytest.mark.sampled(3)
    @pytest.mark.parametrize("mode", list(AutoresetMode))
    @pytest.mark.parametrize("together", [False, True], ids=["apart", "together"])
    def test_no_step_is_lost(self, tmp_path: Path, mode: AutoresetMode, together: bool) -> None:
        """Where episodes end at different times, a file is left at a reset of all."""
        venv = SyncVectorEnv([lambda: Wide(together)] * 3, autoreset_mode=mode)
        env = RecordVector(venv, tmp_path / "run.mcap", max_bytes=900_000, record_info=True)
        told: list[list[Step]] = [[], [], []]
        with env:
            states, _ = env.reset(seed=1)
            env.action_space.seed(1)
            holes = np.zeros(3, np.bool_)
            for n in range(500):
                if n % 10 == 0:
                    env.flush()  # else a thread writes the chunks, when it comes to it
                if n % 150 == 149:
                    (states, _), holes = env.reset(), np.zeros(3, np.bool_)
                before, actions = np.array(states), env.action_space.sample()
                states, rewards, terminals, timeouts, _ = env.step(actions)
                for i in np.flatnonzero(~holes):
                    step = (float(rewards[i]), bool(terminals[i]), bool(timeouts[i]))
                    told[i].append((before[i], actions[i], *step))
                ended = terminals | timeouts
                if mode == AutoresetMode.NEXT_STEP:
                    holes = ended
                elif mode == AutoresetMode.DISABLED and ended.any():
                    states, _ = env.reset(options={"reset_mask": ended})
        assert len(env.paths) > 2
        for i in range(3):
            assert same(recorded(env.paths, i), told[i])
        assert not any(e.start.continued for path in env.paths for e in Recording(path).episodes)

    @pytest.mark.parametrize("mode", list(AutoresetMode))
    def test_a_file_is_left_when_no_episode_is_running(self, tmp_path: Path, mode: AutoresetMode) -> None:
        venv = SyncVectorEnv([lambda: Wide(True)] * 3, autoreset_mode=mode)
        with RecordVector(venv, tmp_path / "run.mcap", max_bytes=300_000, chunk_size=60_000) as env:
            env.reset(seed=1)
            for _ in range(210):
                _, _, terminals, _, _ = env.step(env.action_space.sample())
                if mode == AutoresetMode.DISABLED and terminals.any():
                    env.reset(options={"reset_mask": terminals})
        assert len(env.paths) > 2
        assert set(ends_of(env.paths[:-1])) == {"terminal"}


class TestRuns:
    def test_all_files_of_a_series_have_the_name_of_the_first(self, tmp_path: Path) -> None:
        path = tmp_path / "cart.mcap"
        for _ in range(2):
            env = RecordEpisodes(
                gym.make("CartPole-v1"), path, mode="a", max_bytes=8000, chunk_size=1000, metadata={"lr": 1}
            )
            roll(env, 1000)
            env.close()
            assert len(env.paths) > 2
        files = sorted(tmp_path.glob("*.mcap"))
        assert {episode.run.name for file in files for episode in Recording(file)} == {"cart"}


class TestStorage:
    def test_files_are_listed_when_they_are_left(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path / "lab")
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, max_bytes=8000, chunk_size=1000)
        env.store(name="cartpole")
        roll(env, 1000)
        paths = sorted((tmp_path / "lab").glob("recordings/**/*.mcap"))
        assert len(paths) > 2
        catalogued = storage._catalog._catalog.recordings()
        assert {Path(name).name for name in catalogued} >= {path.name for path in paths[:-1]}
        env.close()
        assert len(storage.list_episodes()) == sum(len(Recording(path)) for path in paths)
        assert env.recording_path == paths[-1]
        assert {header.benchmark_id for header in storage.list_episodes()} == {env.id}
        assert storage.count_episodes('run.name = "cartpole"') == len(storage.list_episodes())

    def test_a_storage_that_cannot_list_now_does_not_stop_the_rollout(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        storage = FileStorage(tmp_path / "lab")
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, max_bytes=8000, chunk_size=1000)
        env.store(name="cartpole")
        elsewhere = FileStorage(tmp_path / "other")
        monkeypatch.setattr(storage, "ingest", elsewhere.ingest)
        with pytest.warns(
            RuntimeWarning, match="will be listed by the next query: expected a recording below"
        ):
            told = roll(env, 1000)
        monkeypatch.undo()
        env.close()
        assert sum(header.n_tuples for header in storage.list_episodes()) == len(told)


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    summary = record_rollouts("CartPole-v1", "run.mcap", steps=20_000, seed=1, max_bytes=300_000)
    assert len(summary.paths) > 1
    assert summary.steps == sum(Recording(path).n_steps for path in summary.paths) == 20_000
    assert summary.episodes == sum(len(Recording(path)) for path in summary.paths)
    assert summary.size == sum(path.stat().st_size for path in summary.paths)
    again = record_rollouts("CartPole-v1", "run.mcap", steps=100, seed=1, mode="a", max_bytes=300_000)
    assert (
        again.path == summary.path or again.path == series(Path("run.mcap").absolute())[1][len(summary.paths)]
    )
    assert again.steps == 100


def test_finished_files_may_be_moved_and_the_directory_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("here", "there", "done"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    env = RecordEpisodes(Endless(ends=3), "run.mcap", max_bytes=1)
    roll(env, 6)
    Path("run.mcap").rename(tmp_path / "done" / "run.mcap")
    monkeypatch.chdir(tmp_path / "there")
    roll(env, 6)
    env.close()
    assert list((tmp_path / "there").iterdir()) == []
    names = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert names == [f"run_{number:04}.mcap" for number in range(1, len(names) + 1)]
    monkeypatch.chdir(tmp_path / "here")
    with RecordEpisodes(Endless(ends=3), "run.mcap", max_bytes=1, mode="a") as env:
        roll(env, 6)
    more = sorted(path.name for path in (tmp_path / "here").iterdir())
    assert more == [f"run_{number:04}.mcap" for number in range(1, len(more) + 1)]
    assert len(more) > len(names) > 1
