"""Many processes in one storage: a short run of tools/concurrency.py, that it can fail, and single encounters."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from tool_modules import tool

from tupli_mcap import FileStorage, Recording, TupliDataset, TupliEnvWrapper
from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.schema import F, FilterEQ
from tupli_mcap.storage.atomic import Lock
from tupli_mcap.storage.catalog.place import catalog_path
from tupli_mcap.storage.exchange import copy_episodes
from tupli_mcap.storage.files import recordings

TOOL = tool("concurrency")


def rollout(env: TupliEnvWrapper, episodes: int = 1) -> None:
    for _ in range(episodes):
        env.reset(seed=1)
        done = False
        while not done:
            _, _, terminal, timeout, _ = env.step(0)
            done = terminal or timeout


def catalog_of(storage: FileStorage) -> Path:
    path = catalog_path(storage.root)
    assert path is not None
    return path


@pytest.fixture
def storage(tmp_path: Path) -> FileStorage:
    return FileStorage(tmp_path / "lab")


@pytest.fixture
def env(storage: FileStorage) -> TupliEnvWrapper:
    env = TupliEnvWrapper(gym.make("CartPole-v1"), storage)
    env.store(name="cart")
    return env


class TestMany:
    def test_lose_nothing(self, tmp_path: Path) -> None:
        figures = TOOL.run(tmp_path, seconds=4, seed=3, writers=8, others=3)
        assert figures["killed writers"] + figures["killed others"] > 0
        assert figures["steps acknowledged"] > 100
        assert figures["episodes in the end"] > 0

    @pytest.mark.sampled(2)
    @pytest.mark.parametrize(
        ("harm", "match"),
        [
            ("lose a recording", "were acknowledged, none found"),
            ("lose a step", "expected 4 steps, found 3"),
            ("bring back", "deleted, and there again"),
            ("forget the lock", "still locked"),
        ],
    )
    def test_would_be_told_of(self, tmp_path: Path, harm: str, match: str) -> None:
        place = TOOL.prepare(tmp_path, 1, 1)
        storage, ledger = FileStorage(place.storage), place.ledger
        env = TupliEnvWrapper(TOOL.Told(1), storage, place.benchmarks[0], metadata_callback=TOOL.Named())
        state, _ = env.reset(options={"length": 3})
        for _ in range(3):
            state, *_ = env.step(TOOL.action_of(state))
        ledger.note("steps-1", TOOL._STEP.pack(0, 3, 1))
        if harm != "forget the lock":
            env.close()
            assert TOOL.verify(place)["steps acknowledged"] == 3
        if harm == "lose a recording":
            next(place.storage.rglob("*.mcap")).unlink()
        elif harm == "lose a step":
            ledger.note("steps-1", TOOL._STEP.pack(0, 4, 1))
        elif harm == "bring back":
            ledger.note("deleted", "1 0")
        with pytest.raises(TOOL.WrongError, match=match):
            TOOL.verify(place)
        env.close()


class TestTheCatalog:
    def test_is_never_seen_half_made(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        for _ in range(8):
            rollout(env)
            env.close()
            env._path = None
        done, errors, found = threading.Event(), [], []

        def read() -> None:
            other = FileStorage(storage.root)
            try:
                while not done.is_set():
                    found.append(len(other.list_episodes()))
            except Exception as err:  # noqa: BLE001
                errors.append(err)

        threads = [threading.Thread(target=read) for _ in range(2)]
        for thread in threads:
            thread.start()
        for i in range(10):
            if i % 2:
                storage.reindex()
            else:
                catalog_of(storage).unlink()
                storage.list_episodes()
        done.set()
        for thread in threads:
            thread.join()
        assert errors == []
        assert set(found) == {8}

    def test_of_another_process_has_the_declared_keys(
        self, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        storage.declare_key("metadata.score")
        rollout(env)
        env.close()
        catalog_of(storage).unlink()
        with FileStorage(storage.root) as other:
            other.list_episodes()
        storage.list_episodes()
        assert "ix_value" in storage.explain(F("metadata.score") > 1)

    def test_survives_a_fork(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        rollout(env, 2)
        env.close()
        assert len(storage.list_episodes()) == 2
        held = threading.Event()
        release = threading.Event()

        def hold() -> None:
            with storage._lock, storage._catalog._catalog._database._lock:
                held.set()
                release.wait(120)

        thread = threading.Thread(target=hold)
        thread.start()
        held.wait(120)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                signal.alarm(120)
                release.set()
                # the parent's lock is honoured, and its connections are left alone
                code = 0 if len(storage.list_episodes()) == 2 else 2
            finally:
                os._exit(code)
        _, status = os.waitpid(pid, 0)
        release.set()
        thread.join()
        assert os.waitstatus_to_exitcode(status) == 0
        env2 = TupliEnvWrapper(gym.make("CartPole-v1"), storage, env.id)
        rollout(env2)
        env2.close()
        assert len(storage.list_episodes()) == 3

    def test_lock_is_not_held_by_a_child(self, tmp_path: Path) -> None:
        lock = Lock(tmp_path / "lock")
        with lock:
            pid = os.fork()
            if pid == 0:
                time.sleep(300)
                os._exit(0)
        try:
            taken = threading.Event()

            def take() -> None:
                with Lock(tmp_path / "lock"):
                    taken.set()

            threading.Thread(target=take, daemon=True).start()
            assert taken.wait(120)
        finally:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


class TestCopying:
    def test_twice_at_once_copies_once(
        self, storage: FileStorage, env: TupliEnvWrapper, tmp_path: Path
    ) -> None:
        rollout(env, 3)
        env.close()
        copies = []

        def copy() -> None:
            copies.append(copy_episodes(storage, FileStorage(tmp_path / "other"))[env.id].episodes)

        threads = [threading.Thread(target=copy) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sorted(copies) == [0, 0, 0, 3]
        assert len(list((tmp_path / "other").rglob("*.mcap"))) == 1


class TestDeleting:
    def test_a_benchmark_that_is_recorded_is_refused(
        self, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        rollout(env)
        other = TupliEnvWrapper(gym.make("CartPole-v1"), FileStorage(storage.root), env.id)
        with pytest.raises(
            StorageError, match=r"is being recorded to .*\.mcap: nothing is deleted; close that first"
        ):
            other.delete()
        rollout(env)
        env.close()
        assert len(storage.list_episodes()) == 2
        assert other.delete().episodes == 2
        assert list((storage.root / "recordings").iterdir()) == []
        with pytest.raises(NotFoundError, match="no benchmark"):
            env.reset()

    def test_a_benchmark_without_its_episodes_is_not(
        self, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        rollout(env)
        TupliEnvWrapper(gym.make("CartPole-v1"), storage, env.id).delete(delete_episodes=False)
        rollout(env)
        env.close()
        assert len(storage.list_episodes()) == 2
        assert storage.list_benchmarks() == []

    def test_what_is_being_recorded_keeps_the_file(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        rollout(env)
        env.reset()
        env.step(0)
        (header,) = storage.list_episodes()
        storage.delete_episode(header.id)
        assert storage.list_episodes() == []
        rollout(env)
        env.close()
        kept = {h.episode for h in storage.list_episodes()}
        assert kept == {1, 2}
        storage.compact()
        assert {h.episode for h in storage.list_episodes()} == kept

    def test_from_a_directory_below_while_it_is_compacted(
        self, storage: FileStorage, env: TupliEnvWrapper, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        rollout(env, 4)
        env.close()
        made = storage.list_episodes()
        storage.delete_episode(made[0].id)
        rewrite = recordings.rewrite_in_place

        def change() -> None:
            below = FileStorage((storage.root / made[0].recording).parent)
            below.delete_episode(made[1].id)
            below.publish_episode(made[2].id, "lab")

        thread = threading.Thread(target=change)

        def busy(*told: Any) -> None:
            thread.start()
            thread.join(timeout=1)  # it has to wait
            rewrite(*told)

        monkeypatch.setattr(recordings, "rewrite_in_place", busy)
        storage.compact()
        thread.join()
        left = storage.list_episodes()
        assert [header.id for header in left] == [made[2].id, made[3].id]
        assert ["lab" in header.published_in for header in left] == [True, False]
        assert storage.deleted_episodes() == [made[1].id]

    def test_from_two_directories_at_once_loses_nothing(
        self, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        rollout(env, 20)
        env.close()
        made = storage.list_episodes()
        below = FileStorage((storage.root / made[0].recording).parent)

        def delete(place: FileStorage, ids: Sequence[str]) -> None:
            for one in ids:
                place.delete_episode(one)

        ids = [header.id for header in made]
        threads = [
            threading.Thread(target=delete, args=args) for args in ((storage, ids[::2]), (below, ids[1::2]))
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert storage.list_episodes() == []
        assert storage.deleted_episodes() == ids

    def test_twice_at_once_is_told_once(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        rollout(env, 3)
        env.close()
        headers = storage.list_episodes()
        storage.delete_episode(headers[0].id)
        assert storage._recordings.delete(headers) == 2
        assert storage._recordings.delete(headers) == 0
        with pytest.raises(NotFoundError, match="no episode with id"):
            storage.delete_episode(headers[0].id)

    def test_while_a_dataset_loads(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        rollout(env, 4)
        env.close()
        busy = Busy(storage.root, lambda s: (s.delete_episode(s.list_episodes()[0].id), s.compact()))
        ds = TupliDataset(busy)
        ds.load()
        assert len(ds.preview()) == 3
        assert len(ds) == len(ds.rewards)

    def test_while_episodes_are_listed_with_their_steps(
        self, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        rollout(env, 2)
        env.close()
        busy = Busy(storage.root, lambda s: s.delete_episodes(FilterEQ(key="episode", value=0)))
        busy.then = lambda s: s.compact()
        assert len(busy.list_episodes(None, True)) == 1

    def test_before_the_files_of_a_dataset_are_read(self, storage: FileStorage, env: TupliEnvWrapper) -> None:
        rollout(env, 3)
        env.close()
        storage.delete_episodes(FilterEQ(key="episode", value=1))
        ds = TupliDataset.from_files(str(storage.root / "recordings" / "*" / "*.mcap"))
        assert [h.episode for h in ds.preview()] == [0, 2]


class Busy(FileStorage):
    """A storage where something happens between listing and opening, once."""

    def __init__(self, root: Path, happens: Callable[[FileStorage], Any]) -> None:
        super().__init__(root)
        self.happens: Callable[[FileStorage], Any] | None = happens
        self.then: Callable[[FileStorage], Any] = lambda storage: None

    def open_recording(self, recording: str, episodes: Sequence[int] | None = None) -> Recording:
        happens, self.happens = self.happens, None
        if happens is not None:
            happens(self)
            self.then(self)
        return super().open_recording(recording, episodes)


class TestImporting:
    def test_at_once_brings_one_copy(
        self, tmp_path: Path, storage: FileStorage, env: TupliEnvWrapper
    ) -> None:
        rollout(env, 3)
        env.close()
        bundle = storage.bundle(str(env.id), tmp_path / "b.mcap")
        threads = [
            threading.Thread(target=lambda: FileStorage(tmp_path / "other").import_bundle(bundle))
            for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(list((tmp_path / "other").rglob("*.mcap"))) == 1
        assert FileStorage(tmp_path / "other").count_episodes() == 3


def test_a_directory_that_goes_while_a_recording_begins(storage: FileStorage, env: TupliEnvWrapper) -> None:
    rollout(env)
    env.close()
    storage.delete_episodes(FilterEQ(key="benchmark_id", value=env.id))
    shutil.rmtree(storage.root / "recordings")
    rollout(env)
    env.close()
    assert len(storage.list_episodes()) == 1
