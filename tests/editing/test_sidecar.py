"""Deletions and publications are about one recording, not about whichever lies at its path."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import tupli_mcap
from tupli_mcap import TupliDataset, recover_recording
from tupli_mcap.dataset.which import candidates
from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.recording.recover.evidence import metadata_at
from tupli_mcap.schema import F
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.bundles import bundle_recording
from tupli_mcap.storage.listing import compactable, list_recordings
from tupli_mcap.storage.sidecar import Deletion, Sidecar, sidecar_path
from tupli_mcap.storage.verify import verify_paths
from tupli_mcap.wrappers import RecordEpisodes


@pytest.fixture
def storage(tmp_path: Path) -> Iterator[FileStorage]:
    (tmp_path / "lab").mkdir()
    with FileStorage(tmp_path / "lab") as made:
        yield made


@pytest.fixture
def run(storage: FileStorage) -> Path:
    """A recording of three episodes."""
    return record(storage.root / "run.mcap", 3)


def record(path: Path, episodes: int, mode: str = "w") -> Path:
    with RecordEpisodes(gym.make("CartPole-v1"), path, mode=mode) as env:
        take(env, episodes)
    return path


def take(env: gym.Env[Any, Any], episodes: int) -> None:
    for seed in range(episodes):
        env.reset(seed=seed)
        env.step(0)
        env.step(1)


def numbers(storage: FileStorage, name: str = "run.mcap") -> list[int]:
    return [header.episode for header in storage.list_episodes(F("recording") == name)]


def delete(storage: FileStorage, *episodes: int) -> None:
    assert storage.delete_episodes(F("episode").isin(list(episodes))) > 0


class TestAReplacedRecording:
    def test_has_all_of_its_episodes(self, storage: FileStorage, run: Path, tmp_path: Path) -> None:
        delete(storage, 0, 1)
        record(run, 4)
        assert numbers(storage) == [0, 1, 2, 3]
        assert [item.n_tuples for item in storage.list_episodes(include_tuples=True)] == [2] * 4
        dataset = TupliDataset(storage)
        dataset.load()
        assert len(dataset.rewards) == 8
        assert len(TupliDataset.from_files(run).preview()) == 4
        assert [item.episodes for item in list_recordings([storage.root])] == [4]
        with Recording(run) as recording:
            assert len(candidates(recording)) == 4
        bundle_recording(run, tmp_path / "bundle.mcap")
        with Recording(tmp_path / "bundle.mcap") as bundle:
            assert len(bundle) == 4
        assert compactable(storage.root) == []
        assert storage.compact() == 0
        assert numbers(storage) == [0, 1, 2, 3]
        assert not sidecar_path(run).exists()
        with Recording(run) as recording:
            assert len(recording.episodes) == 4

    def test_is_published_by_itself(self, storage: FileStorage, run: Path) -> None:
        (first, *_) = storage.list_episodes()
        storage.publish_episode(first.id, "lab")
        assert "lab" in storage.list_episodes()[0].published_in
        record(run, 3)
        assert ["lab" in header.published_in for header in storage.list_episodes()] == [False] * 3

    def test_takes_the_place_of_the_notes_too(self, storage: FileStorage, run: Path) -> None:
        delete(storage, 0, 1)
        record(run, 3)
        delete(storage, 2)
        assert numbers(storage) == [0, 1]
        assert Sidecar.read(run).uuid == metadata_at(run)["uuid"]
        assert storage.compact() > 0
        with Recording(run) as recording:
            assert [episode.number for episode in recording.episodes] == [0, 1]

    def test_loses_nothing_to_who_listed_the_old_one(self, storage: FileStorage, run: Path) -> None:
        old = storage.list_episodes()
        record(run, 3)
        with pytest.raises(NotFoundError, match="there is no episode with id"):
            storage.delete_episode(old[0].id)
        with pytest.raises(NotFoundError, match="there is no episode with id"):
            storage.publish_episode(old[0].id, "lab")
        assert storage._recordings.delete(old) == 0
        with pytest.raises(NotFoundError, match="was deleted or replaced by somebody else meanwhile"):
            storage._recordings.publish(old[0], "lab")
        assert numbers(storage) == [0, 1, 2]
        assert not sidecar_path(run).exists()

    def test_what_was_compacted_away_is_not_published(self, storage: FileStorage, run: Path) -> None:
        (old, *_) = storage.list_episodes()
        delete(storage, old.episode)
        storage.compact()
        with pytest.raises(NotFoundError, match="was deleted or replaced by somebody else meanwhile"):
            storage._recordings.publish(old, "lab")
        assert not Sidecar.read(run).published_in

    def test_is_told_by_verify(self, storage: FileStorage, run: Path) -> None:
        delete(storage, 0)
        ((report, _),) = verify_paths([storage.root])
        assert report.problems == []
        record(run, 3)
        ((report, _),) = verify_paths([storage.root])
        (problem,) = report.problems
        assert report.ok
        assert problem.kind == "leftover"
        assert "run.mcap.json is about another recording" in str(problem)
        assert numbers(storage) == [0, 1, 2]


class TestTheSameRecording:
    def test_stays_deleted_when_it_is_appended_to_and_compacted(
        self, storage: FileStorage, run: Path
    ) -> None:
        ids = {header.episode: header.id for header in storage.list_episodes()}
        delete(storage, 0)
        record(run, 1, mode="a")
        assert numbers(storage) == [1, 2, 3]
        assert storage.compact() > 0
        assert numbers(storage) == [1, 2, 3]
        delete(storage, 1)
        record(run, 1, mode="a")
        assert numbers(storage) == [2, 3, 4]
        assert storage.compact() > 0
        assert storage.list_episodes()[0].id == ids[2]

    def test_stays_deleted_when_both_move(self, storage: FileStorage, run: Path) -> None:
        delete(storage, 0)
        (storage.root / "old").mkdir()
        for path in (run, sidecar_path(run)):
            path.rename(storage.root / "old" / path.name)
        assert numbers(storage, "old/run.mcap") == [1, 2]


class TestADeletionBrokenOff:
    @pytest.mark.parametrize("older", [False, True])
    def test_spares_what_took_the_place_of_a_recording(
        self, storage: FileStorage, tmp_path: Path, *, older: bool
    ) -> None:
        spare = record(tmp_path / "spare.mcap", 3)
        for name in ("kept.mcap", "run.mcap"):
            record(storage.root / name, 3)
        broken_off = 0
        for k in range(20):
            root = tmp_path / f"{k}"
            shutil.copytree(storage.root, root)
            with FileStorage(root) as one, pytest.MonkeyPatch.context() as patch:
                doomed = one.list_episodes(F("episode") == 0)
                fail_after(k, patch)
                try:
                    assert one._recordings.delete(doomed) == 2
                except StorageError:
                    broken_off += (root / "deleting.json").exists()
                else:
                    break
            with FileStorage(root) as other:
                gone = numbers(other, "kept.mcap") == [1, 2]
                shutil.copy(spare, root / "run.mcap") if older else record(root / "run.mcap", 3)
                assert numbers(other) == [0, 1, 2]
                other.compact()
                assert numbers(other) == [0, 1, 2]
                assert numbers(other, "kept.mcap") == ([1, 2] if gone else [0, 1, 2])
                assert not (root / "deleting.json").exists()
        assert broken_off >= 3

    def test_counts_for_the_recording_it_names(self, storage: FileStorage, run: Path) -> None:
        uuid = metadata_at(run)["uuid"]
        for named, left in (("0" * 32, [0, 1, 2]), (uuid, [1, 2]), ("1" * 32, [0, 1, 2])):
            Deletion(deleted={run.name: {0}}, uuids={run.name: named}).write(storage.root)
            assert numbers(storage) == left

    def test_is_finished_for_a_damaged_recording(self, storage: FileStorage, run: Path) -> None:
        record(storage.root / "other.mcap", 2)
        assert numbers(storage) == [0, 1, 2]
        Deletion(deleted={run.name: {0}}, uuids={run.name: metadata_at(run)["uuid"]}).write(storage.root)
        whole = run.read_bytes()
        run.write_bytes(whole.replace(metadata_at(run)["uuid"].encode(), b"x" * 32))
        with pytest.warns(UserWarning, match="skipped a recording"):
            storage.delete_episode(storage.list_episodes()[0].id)
        assert not (storage.root / "deleting.json").exists()
        run.write_bytes(whole)
        assert numbers(storage) == [1, 2]


def fail_after(changes: int, patch: pytest.MonkeyPatch) -> None:
    """Lets so many files be replaced or removed, and refuses the rest."""
    left = [changes]

    def failing(call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(path: Any, *args: Any, **kwargs: Any) -> Any:
            if not str(path).endswith(".tmp") or call is replace:
                left[0] -= 1
                if left[0] < 0:
                    raise OSError(errno.EIO, os.strerror(errno.EIO))
            return call(path, *args, **kwargs)

        return counted

    replace = os.replace
    for name in ("replace", "unlink"):
        patch.setattr(os, name, failing(getattr(os, name)))


def test_a_name_may_be_too_long_for_notes_beside_it(storage: FileStorage, run: Path, tmp_path: Path) -> None:
    long = run.rename(run.with_name(f"{'x' * 250}.mcap"))
    record(storage.root / "other.mcap", 2)
    assert len(tupli_mcap.open(long)) == 3
    assert len(tupli_mcap.open(str(storage.root / "*.mcap"))) == len(storage.list_episodes()) == 5
    assert recover_recording(long, tmp_path / f"{'y' * 250}.mcap").episodes == 3
    with pytest.raises(StorageError, match="File name too long"):
        delete(storage, 0)
