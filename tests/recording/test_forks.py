"""Forked, spawned, pickled and copied: wrappers, recordings, datasets and storages behave, or refuse."""

from __future__ import annotations

import copy
import functools
import io
import multiprocessing
import os
import pickle
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
from environments import Sampler, roll, same
from gymnasium import spaces

from tupli_mcap import FileStorage, RecordEpisodes, Recording, RecordingError, TupliDataset, TupliEnvWrapper
from tupli_mcap.vector import RecordEpisodes as RecordVector

COPIES: list[Callable[[Any], Any]] = [
    copy.copy,
    copy.deepcopy,
    lambda x: pickle.loads(pickle.dumps(x)),
    lambda x: pickle.loads(cloudpickle.dumps(x)),
]


def cart_pole(path: Path, **kwargs: Any) -> RecordEpisodes:
    return RecordEpisodes(gym.make("CartPole-v1"), path, chunk_size=3000, **kwargs)


def roll_images(path: Path) -> None:
    image = spaces.Box(0, 255, (96, 96, 3), np.uint8)
    with RecordEpisodes(Sampler(image, spaces.Discrete(2)), path) as env:
        roll(env, 30)


def in_child(work: Callable[[], None], *, kill: bool = False) -> int:
    """Exit code of a forked child that does this (0 unless it raises); `kill` ends it with SIGKILL."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            signal.alarm(30)
            work()
            code = 0
        finally:
            if kill:
                os.kill(os.getpid(), signal.SIGKILL)
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


class TestCopies:
    @pytest.mark.parametrize("copied", COPIES)
    def test_of_what_records_are_refused(self, tmp_path: Path, copied: Callable[[Any], Any]) -> None:
        single = cart_pole(tmp_path / "a.mcap")
        vector = RecordVector(gym.make_vec("CartPole-v1", 2), tmp_path / "b.mcap")
        stored = TupliEnvWrapper(gym.make("CartPole-v1"), FileStorage(tmp_path / "lab"))
        stored.store(name="cart")
        stored.reset()
        for env in (single, vector, stored):
            with pytest.raises(RecordingError, match="cannot be pickled or copied"):
                copied(env)
            env.close()

    @pytest.mark.parametrize("copied", COPIES)
    def test_of_a_stored_environment_record_elsewhere(
        self, tmp_path: Path, copied: Callable[[Any], Any]
    ) -> None:
        storage = FileStorage(tmp_path / "lab")
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
        env.store(name="cart")
        roll(env, 5)
        env.deactivate_recording()
        env.activate_recording()
        other = copied(env)
        roll(env, 3)
        roll(other, 4)
        other.close()
        env.close()
        assert other.recording_path != env.recording_path
        assert sorted(h.n_tuples for h in storage.list_episodes()) == [3, 4, 5]

    @pytest.mark.parametrize("copied", COPIES[1:])
    def test_of_what_reads_read(self, tmp_path: Path, copied: Callable[[Any], Any]) -> None:
        path = tmp_path / "a.mcap"
        with cart_pole(path) as env:
            roll(env, 100)
        recording = Recording(path)
        wanted = recording.read().states
        again = copied(recording)
        assert np.array_equal(again.read().states, wanted)
        assert np.array_equal(copied(recording.episodes[1]).states, recording.episodes[1].states)
        recording.close()
        assert np.array_equal(again.read().states, wanted)
        dataset = copied(TupliDataset.from_files(path))
        assert np.array_equal(dataset.observations, wanted)

    def test_of_a_replaced_recording_are_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with cart_pole(path) as env:
            roll(env, 10)
        data = pickle.dumps(Recording(path))
        with cart_pole(path, mode="w") as env:
            roll(env, 10)
        with pytest.raises(RecordingError, match="is a different recording now"):
            pickle.loads(data)

    def test_of_an_open_file_are_refused(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with cart_pole(path) as env:
            roll(env, 10)
        with path.open("rb") as file, pytest.raises(RecordingError, match="cannot be copied; give its path"):
            pickle.dumps(Recording(file))


def make_recorded(directory: str, i: int) -> gym.Env[Any, Any]:
    return RecordEpisodes(gym.make("CartPole-v1"), Path(directory) / f"{i}.mcap")


def make_stored(directory: str) -> gym.Env[Any, Any]:
    storage = FileStorage(directory)
    (benchmark,) = storage.list_benchmarks()
    return TupliEnvWrapper.load(storage=storage, benchmark_id=benchmark.id)


class TestAsyncVectorEnv:
    """It makes one of its environments in its own process first, and throws it away."""

    @pytest.mark.parametrize("context", ["fork", "spawn", "forkserver"])
    def test_each_worker_records(self, tmp_path: Path, context: str) -> None:
        makers = [functools.partial(make_recorded, str(tmp_path), i) for i in range(2)]
        envs = gym.vector.AsyncVectorEnv(makers, context=context)
        envs.reset(seed=3)
        for _ in range(20):
            envs.step(np.array([0, 1]))
        envs.close()
        for i in range(2):
            with Recording(tmp_path / f"{i}.mcap") as recording:
                assert recording.complete
                assert recording.n_steps >= 17  # a reset in between takes a step of its own
                assert recording.episodes[0].seed == 3 + i

    def test_a_terminated_worker_loses_nothing(self, tmp_path: Path) -> None:
        envs = gym.vector.AsyncVectorEnv(
            [functools.partial(make_recorded, str(tmp_path), i) for i in range(2)]
        )
        envs.reset(seed=3)
        for _ in range(5):
            envs.step(np.array([0, 1]))
        envs.close(terminate=True)
        assert [Recording(tmp_path / f"{i}.mcap").n_steps for i in range(2)] == [5, 5]

    def test_workers_share_a_storage(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path / "lab")
        TupliEnvWrapper(gym.make("CartPole-v1"), storage).store(name="cart")
        storage.list_episodes()  # the catalog is open while the workers are forked
        envs = gym.vector.AsyncVectorEnv(
            [functools.partial(make_stored, str(storage.root))] * 2, context="fork"
        )
        envs.reset(seed=3)
        for _ in range(5):
            envs.step(np.array([0, 1]))
        envs.close()
        assert [h.n_tuples for h in storage.list_episodes()] == [5, 5]

    def test_recorded_from_outside(self, tmp_path: Path) -> None:
        envs = gym.vector.AsyncVectorEnv([lambda: gym.make("CartPole-v1")] * 2, context="fork")
        with RecordVector(envs, tmp_path / "a.mcap") as env:
            env.reset(seed=1)
            for _ in range(5):
                env.step(np.array([0, 1]))
        assert Recording(tmp_path / "a.mcap").n_steps == 10


class StepSamples:
    """Steps of a recording, one a sample."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    def __len__(self) -> int:
        return self.recording.n_steps

    def __getitem__(self, i: int) -> Any:
        ends = np.cumsum(self.recording.index["length"].astype(int))
        episode = int(np.searchsorted(ends, i, side="right"))
        step = i - int(ends[episode] - self.recording.index["length"][episode])
        return self.recording.read_steps(episode, step, step + 1).states[0]


class Samples:
    """Steps of a dataset."""

    def __init__(self, dataset: TupliDataset) -> None:
        self.dataset = dataset

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, i: int) -> Any:
        return np.array(self.dataset.observations[i])


class TestDataLoader:
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize(
        ("context", "kind"),
        [
            ("fork", "recording"),
            ("fork", "file"),
            ("fork", "dataset"),
            ("fork", "storage"),
            ("spawn", "recording"),
        ],
    )  # what else a spawned worker gets is pickled, which is tested above
    def test_workers_read_the_same(self, tmp_path: Path, context: str, kind: str) -> None:
        torch_data = pytest.importorskip("torch.utils.data")
        storage = FileStorage(tmp_path / "lab")
        env = TupliEnvWrapper(gym.make("CartPole-v1"), storage, chunk_size=3000)
        env.store(name="cart")
        roll(env, 200)
        env.close()
        path = env.recording_path
        assert path is not None
        with Recording(path) as recording:
            wanted = recording.read().states
        made: Any = {
            "recording": lambda: StepSamples(Recording(path, cache_bytes=1)),
            "file": lambda: StepSamples(Recording(path.open("rb"), cache_bytes=1)),
            "dataset": lambda: Samples(TupliDataset.from_files(path)),
            "storage": lambda: Samples(TupliDataset(storage)),
        }[kind]()
        assert len(made) == 200
        loader = torch_data.DataLoader(
            made, batch_size=10, num_workers=2, multiprocessing_context=context, persistent_workers=True
        )
        for _ in range(2 if context == "fork" else 1):
            found = np.concatenate([batch.numpy() for batch in loader])
            assert np.array_equal(found, wanted)
        del loader
        if kind == "file":
            made.recording._source._file.close()


class TestForkedChildren:
    def test_cannot_go_on_with_the_parents_recording(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        env = cart_pole(path)
        seen = roll(env, 50)

        def child() -> None:
            with pytest.raises(RecordingError, match="not by a forked child; wrap the environment here"):
                env.step(0)
            with pytest.raises(RecordingError, match="not by a forked child"):
                env.reset()
            env.close()
            with cart_pole(tmp_path / "b.mcap") as own:
                roll(own, 9)

        assert in_child(child) == 0
        env.reset(seed=1)
        env.step(1)
        env.close()
        with Recording(path) as recording:
            steps = [step for episode in recording.episodes for step in episode]
            assert len(steps) == 51
            assert all(same(step.state, before) for step, (before, *_) in zip(steps, seen, strict=False))
        assert Recording(tmp_path / "b.mcap").n_steps == 9

    @pytest.mark.parametrize("ends", [False, True])
    def test_cannot_begin_the_parents_next_episode(self, tmp_path: Path, ends: bool) -> None:
        path = tmp_path / "a.mcap"
        env = cart_pole(path)
        count = 0
        for episode in range(3):
            env.reset(seed=None if episode else 1)
            over = False
            while not over:
                _, _, terminal, timeout, _ = env.step(1)
                over, count = terminal or timeout, count + 1
        if not ends:
            env.reset()

        def child() -> None:
            for act in (env.reset, lambda: env.step(0), env.reset):
                with pytest.raises(RecordingError, match="not by a forked child"):
                    act()

        assert in_child(child) == 0
        with Recording(path) as recording:
            assert recording.n_steps == count
        env.reset()
        env.step(1)
        env.close()
        assert Recording(path).n_steps == count + 1

    @pytest.mark.parametrize("method", ["fork", "program"])
    def test_that_outlive_a_killed_writer_hold_nothing(self, tmp_path: Path, method: str) -> None:
        path, told = tmp_path / "a.mcap", tmp_path / "told"

        def writer() -> None:
            env = cart_pole(path)
            roll(env, 30)
            if method == "fork":
                multiprocessing.get_context("fork").Process(target=time.sleep, args=(60,)).start()
                (child,) = multiprocessing.active_children()
            else:
                child = subprocess.Popen(["sleep", "60"], close_fds=False)
            told.write_text(str(child.pid))

        assert in_child(writer, kill=True) == -signal.SIGKILL
        survivor = int(told.read_text())
        try:
            os.kill(survivor, 0)
            with cart_pole(path, mode="a") as env:
                roll(env, 5)
            assert Recording(path).n_steps == 35
            assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "told"]
        finally:
            os.kill(survivor, signal.SIGKILL)

    def test_do_not_disturb_the_thread_that_writes_chunks(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        image = spaces.Box(0, 255, (96, 96, 3), np.uint8)
        env = RecordEpisodes(Sampler(image, spaces.Discrete(2)), path)
        seen = []
        for i in range(3):
            seen += roll(env, 20, seed=i)
            assert in_child(lambda: env.close()) == 0
            other = path.with_name(f"{i}.mcap")
            assert in_child(lambda: roll_images(other)) == 0  # noqa: B023 - it is done at once
        env.close()
        with Recording(path) as recording:
            found = [step for episode in recording.episodes for step in episode]
        assert len(found) == len(seen)
        assert all(same(step.state, before) for step, (before, *_) in zip(found, seen, strict=True))

    def test_read_while_a_thread_of_the_parent_does(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with cart_pole(path) as env:
            roll(env, 300)
        recording = Recording(path, cache_bytes=1)
        wanted = recording.read().states
        done = threading.Event()

        def read() -> None:
            while not done.is_set():
                recording.read(episodes=[0, 1, 2])

        thread = threading.Thread(target=read)
        thread.start()
        try:
            for _ in range(10):
                assert in_child(lambda: np.testing.assert_array_equal(recording.read().states, wanted)) == 0
        finally:
            done.set()
            thread.join()

    def test_are_told_to_open_what_is_no_file_of_the_system_again(self, tmp_path: Path) -> None:
        path = tmp_path / "a.mcap"
        with cart_pole(path) as env:
            roll(env, 30)
        recording = Recording(io.BytesIO(path.read_bytes()))

        def child() -> None:
            with pytest.raises(RecordingError, match="open it again here"):
                recording.read()

        assert in_child(child) == 0
        assert len(recording.read()) == 30
