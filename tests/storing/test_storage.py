"""What every storage promises (`StorageContract`), and what the one in a directory promises beyond that."""

from __future__ import annotations

import copy
import errno
import itertools
import json
import multiprocessing
import os
import pickle
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import textwrap
import uuid
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from command_line import run
from counting import calls
from gymnasium import spaces
from schema_files import validator
from sqlalchemy.exc import OperationalError
from storage_contract import StorageContract
from stored_items import episode, query

import tupli_mcap
from tupli_mcap import EpisodeWriter, TupliDataset, TupliEnvWrapper, write_rollout
from tupli_mcap.environment import capture
from tupli_mcap.errors import (
    FilterError,
    FormatError,
    NotFoundError,
    RecordingError,
    SpaceError,
    StorageError,
    TupliError,
    UntrustedError,
)
from tupli_mcap.recording import Recording, merge_recordings, verify_recording
from tupli_mcap.schema import (
    ArtifactMetadata,
    BenchmarkMetadata,
    BenchmarkQuery,
    Episode,
    F,
    FilterEQ,
    RLTuple,
)
from tupli_mcap.storage import FileStorage, TupliAPIClient, TupliStorageError
from tupli_mcap.storage.benchmark_json import facts_about, pack
from tupli_mcap.storage.bundles import bundle_recording, read_bundle
from tupli_mcap.storage.catalog import database, entries
from tupli_mcap.storage.catalog.catalog import Catalog
from tupli_mcap.storage.catalog.place import catalog_path
from tupli_mcap.storage.exchange import copy_episodes
from tupli_mcap.storage.from_values import conform, infer_space
from tupli_mcap.storage.listing import list_recordings
from tupli_mcap.storage.verify import verify_paths
from tupli_mcap.wrappers import RecordEpisodes
from tupli_mcap.wrappers.rollout import record_rollouts


@pytest.fixture(autouse=True)
def _config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "config"))


class TestFileStorage(StorageContract):
    @pytest.fixture
    def storage(self, tmp_path: Path) -> Iterator[FileStorage]:
        with FileStorage(tmp_path / "lab") as storage:
            yield storage

    def test_layout_on_disk(self, storage: FileStorage) -> None:
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="wind"))
        header = storage.store_benchmark(query(artifacts=(item.id,)))
        recorded = storage.record_episode(episode(header.id))
        files = {p.relative_to(storage.root).as_posix() for p in storage.root.rglob("*") if p.is_file()}
        assert files == {
            ".lock",
            f"benchmarks/{header.id}.json",
            f"artifacts/{item.id}",
            f"artifacts/{item.id}.json",
            recorded.recording,
        }
        assert recorded.recording.startswith(f"recordings/{header.id}/")
        document = json.loads((storage.root / "benchmarks" / f"{header.id}.json").read_text())
        assert document["environment"]["name"] == "CartPole-v1"
        assert document["benchmark"]["metadata"]["name"] == "cart"

    def test_everything_is_there_for_the_next_one(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        storage.declare_key("metadata.score")
        storage.record_episodes([episode(header.id, score=float(i)) for i in range(3)])
        expected = storage.list_episodes()
        with FileStorage(storage.root) as other:
            assert other.list_benchmarks() == [header]
            assert other.list_episodes() == expected
            assert other.declared_keys() == ["metadata.score"]

    @pytest.mark.parametrize("damage", ["deleted", "overwritten", "reindexed"])
    def test_the_catalog_is_rebuilt(self, storage: FileStorage, damage: str) -> None:
        header = storage.store_benchmark(query())
        storage.declare_key("metadata.score")
        made = storage.record_episodes([episode(header.id, score=float(i)) for i in range(3)])
        storage.delete_episode(made[0].id)
        storage.publish_episode(made[1].id, "lab")
        expected = storage.list_episodes()
        storage.close()
        catalog = catalog_path(storage.root)
        assert catalog is not None
        if damage == "reindexed":
            storage.reindex()
        else:
            shutil.rmtree(catalog.parent)
            if damage == "overwritten":
                catalog.parent.mkdir(mode=0o700)
                catalog.write_bytes(b"not a database at all" * 100)
        with FileStorage(storage.root) as other:
            assert other.list_episodes() == expected
            assert other.declared_keys() == ["metadata.score"]

    def test_dropped_and_removed_files_are_noticed(self, storage: FileStorage, tmp_path: Path) -> None:
        header = storage.store_benchmark(query())
        recorded = storage.record_episode(episode(header.id))
        path = storage.root / recorded.recording
        moved = tmp_path / "elsewhere.mcap"
        path.rename(moved)
        assert storage.list_episodes() == []
        moved.rename(storage.root / "dropped.mcap")
        (found,) = storage.list_episodes()
        assert (found.id, found.recording) == (recorded.id, "dropped.mcap")

    def test_files_that_change_places_are_both_listed(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        made = {storage.record_episode(episode(header.id)).id for _ in range(3)}
        for _ in range(2):
            assert {header.id for header in storage.list_episodes()} == made
            first, *others = paths = sorted(storage.root.rglob("*.mcap"))
            aside = first.rename(storage.root / "aside")
            for path, place in zip([*others, aside], paths, strict=True):
                path.rename(place)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert {header.id for header in storage.list_episodes()} == made

    def test_damaged_files_are_skipped_with_a_warning(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        storage.record_episode(episode(header.id))
        (storage.root / "bad.mcap").write_bytes(b"no recording")
        (storage.root / "benchmarks" / f"{'1' * 64}.json").write_text("{")
        (storage.root / "artifacts").mkdir(exist_ok=True)
        (storage.root / "artifacts" / f"{'2' * 64}.json").write_text("{}")
        with pytest.warns(UserWarning, match=r"skipped a recording: .*bad\.mcap"):
            assert len(storage.list_episodes()) == 1
        assert len(storage.list_episodes()) == 1  # said once
        with pytest.warns(UserWarning, match="skipped a benchmark: .*1111"):
            assert storage.list_benchmarks() == [header]
        with pytest.warns(UserWarning, match="skipped an artifact: .*2222"):
            assert storage.list_artifacts() == []

    def test_damaged_contents_are_format_errors(self, storage: FileStorage) -> None:
        item = storage.store_artifact(b"abc", ArtifactMetadata(name="wind"))
        (storage.root / "artifacts" / item.id).write_bytes(b"abd")
        with pytest.raises(FormatError, match=f"expected bytes with SHA-256 {item.id}"):
            storage.load_artifact(item.id)
        header = storage.store_benchmark(query())
        path = storage.root / "benchmarks" / f"{header.id}.json"
        path.write_text(path.read_text().replace('"cart"', '"tart"'))
        with pytest.raises(FormatError, match=f"expected the content of benchmark {header.id}"):
            storage.load_benchmark(header.id)

    @pytest.mark.parametrize("kind", ["cut", "changed"])
    def test_what_is_damaged_is_stored_again(self, storage: FileStorage, kind: str) -> None:
        told = ArtifactMetadata(name="wind")
        uri, item = storage.store_benchmark(query()).id, storage.store_artifact(b"abc", told)
        artifact = storage.root / "artifacts" / item.id
        for path in (artifact, artifact.with_suffix(".json"), storage.root / "benchmarks" / f"{uri}.json"):
            data = path.read_bytes()
            path.write_bytes(data[:2] if kind == "cut" else data.replace(b"c", b"d"))
            assert not all(report.ok for report, _ in verify_paths([storage.root]))
            assert storage.store_benchmark(query()).id == uri
            assert storage.store_artifact(b"abc", told).name == "wind"
            assert all(report.ok for report, _ in verify_paths([storage.root]))
        assert storage.load_artifact(item.id) == b"abc"
        assert storage.load_benchmark(uri).metadata.name == "cart"

    def test_an_unusable_directory_is_one_error(self, tmp_path: Path) -> None:
        (tmp_path / "file").write_text("")
        with pytest.raises(StorageError, match="cannot use the storage"):
            FileStorage(tmp_path / "file" / "lab")

    def test_the_first_write_makes_the_directory(self, tmp_path: Path) -> None:
        with FileStorage(tmp_path / "a" / "lab") as storage, warnings.catch_warnings():
            warnings.simplefilter("error")
            assert storage.list_benchmarks() == storage.list_artifacts() == storage.list_episodes() == []
            assert storage.count_episodes(FilterEQ(key="env", value=0)) == 0
            assert len(TupliDataset(storage)) == 0
            with pytest.raises(NotFoundError, match="no benchmark"):
                storage.load_benchmark("x")
            storage.reindex()
            assert list(tmp_path.iterdir()) == []
            header = storage.store_benchmark(query())
            made = storage.record_episodes([episode(header.id)])
            assert storage.list_episodes() == made
            assert storage.count_episodes(FilterEQ(key="env", value=0)) == 1

    def test_compact_rewrites_what_holds_deleted_episodes(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id, 200, score=float(i)) for i in range(5)])
        storage.delete_episode(made[0].id)
        storage.delete_episode(made[2].id)
        storage.publish_episode(made[3].id, "lab")
        path = storage.root / made[0].recording
        before = path.stat().st_size
        assert storage.compact() == before - path.stat().st_size > 0
        assert storage.compact() == 0
        with Recording(path) as recording:
            assert len(recording.episodes) == 3
        left = storage.list_episodes(include_tuples=True)
        assert [item.metadata["score"] for item in left] == [1.0, 3.0, 4.0]
        assert [item.published_in[-1] == "lab" for item in left] == [False, True, False]
        assert [item.id for item in left] == [made[i].id for i in (1, 3, 4)]
        storage.delete_episode(made[3].id)
        storage.compact()
        assert list(path.parent.iterdir()) == [path]

    def test_a_copy_of_a_recording_is_not_listed_twice(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        (made,) = storage.record_episodes([episode(header.id)])
        path = storage.root / made.recording
        shutil.copy(path, storage.root / "a copy.mcap")
        with pytest.warns(UserWarning, match=r"a copy\.mcap holds episodes of recordings/.* again"):
            assert storage.count_episodes() == 1
        path.unlink()
        assert [h.recording for h in storage.list_episodes()] == ["a copy.mcap"]

    @pytest.mark.parametrize("name", ["a.mcap", "z.mcap"])
    def test_an_episode_that_several_files_hold_is_listed_once(self, storage: FileStorage, name: str) -> None:
        header = storage.store_benchmark(query())
        made = [one.id for one in storage.record_episodes([episode(header.id) for _ in range(6)])]
        path = next(storage.root.rglob("*.mcap"))
        tupli_mcap.open(path).filter("episode in [2, 3]").save(storage.root / name)
        with pytest.warns(UserWarning, match="holds episodes of .* again"):
            assert sorted(h.id for h in storage.list_episodes()) == made
        with pytest.warns(UserWarning, match="holds episodes of .* again"):
            storage.reindex()
            listed = storage.list_episodes()
            assert sorted(h.id for h in listed) == made
            assert {h.recording for h in listed} == {path.relative_to(storage.root).as_posix()}
            assert storage.count_episodes() == 6
        path.unlink()
        assert [h.id for h in storage.list_episodes()] == made[2:4]

    @pytest.mark.filterwarnings("ignore:.*again")
    @pytest.mark.parametrize("name", ["a.mcap", "z.mcap"])
    def test_deleted_episodes_hide_none_of_a_copy(self, storage: FileStorage, name: str) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id) for _ in range(6)])
        path = storage.root / made[0].recording
        tupli_mcap.open(path).filter("episode in [2, 3]").save(storage.root / name)
        assert storage.count_episodes() == 6
        tupli_mcap.open(path).filter("episode == 2").delete()
        for _ in range(2):
            listed = {h.episode: h.recording for h in storage.list_episodes()}
            assert sorted(listed) == [0, 1, 2, 3, 4, 5] and listed.pop(2) == name
            assert set(listed.values()) == {made[0].recording}
        storage.reindex()
        for _ in range(2):
            assert storage.count_episodes() == 6

    @pytest.mark.filterwarnings("ignore:.*again")
    def test_a_benchmark_is_deleted_with_its_episodes_in_copies(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id) for _ in range(3)])
        for name in ("a.mcap", "z.mcap"):
            shutil.copy(storage.root / made[0].recording, storage.root / name)
        assert storage.delete_benchmark(header.id, episodes=True) == 3
        assert storage.count_episodes() == 0
        assert not list(storage.root.rglob("*.mcap"))

    @pytest.mark.filterwarnings("ignore:.*again")
    def test_a_copy_may_go_on(self, storage: FileStorage) -> None:
        first, copy = storage.root / "a.mcap", storage.root / "b.mcap"
        for path in (first, copy):
            with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
                for _ in range(2):
                    env.reset(seed=1)
                    env.step(0)
            if path == first:
                shutil.copy(first, copy)
                assert storage.count_episodes() == 2
        assert storage.count_episodes() == 4
        first.unlink()
        assert storage.count_episodes() == 4
        copy.write_bytes(b"nothing")
        with pytest.warns(UserWarning, match="skipped a recording"):
            assert storage.count_episodes() == 0

    def test_a_foreign_benchmark_is_text(self, storage: FileStorage) -> None:
        told = BenchmarkQuery(hash="x", serialized="\udc80", metadata=BenchmarkMetadata(name="x"))
        with pytest.raises(StorageError, match="expected the text of a benchmark, found one with a lone"):
            storage.store_benchmark(told)

    def test_a_foreign_benchmark_is_checked_against_its_id(self, storage: FileStorage) -> None:
        odd = BenchmarkMetadata(name="n", extra={"nan": np.nan, "limits": (1, np.int64(2))})
        told = BenchmarkQuery(hash="theirs", serialized="a text of another program", metadata=odd)
        header = storage.store_benchmark(told)
        storage.edit_benchmark(header.id, name="another")
        assert storage.load_benchmark(header.id).serialized == told.serialized
        path = storage.root / "benchmarks" / f"{header.id}.json"
        path.write_text(path.read_text().replace("another program", "somebody else"))
        with pytest.raises(
            FormatError, match=f"expected the content of benchmark {header.id}, found that of"
        ):
            storage.load_benchmark(header.id)
        (report,) = [report for report, _ in verify_paths([storage.root])]
        assert not report.ok

    def test_a_damaged_recording_keeps_no_other_from_being_restored(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        for name in ("a.mcap", "b.mcap"):
            record_rollouts("CartPole-v1", storage.root / name, episodes=1)
        damaged, sound = (header.id for header in storage.list_episodes())
        for uri in (damaged, sound):
            storage.delete_episode(uri)
        path = storage.root / "a.mcap"
        data = path.read_bytes()
        path.write_bytes(bytes(200) + data[200:])
        assert storage.restore_episodes([sound]) == 1
        assert [header.id for header in storage.list_episodes()] == [sound]
        assert storage.restore_episodes([damaged]) == 1
        path.write_bytes(data)
        assert {header.id for header in storage.list_episodes()} == {damaged, sound}

    @pytest.mark.parametrize("key", ["bogus", "metadata", ""])
    def test_a_key_that_cannot_be_declared_is_a_defect_of_the_file(
        self, storage: FileStorage, key: str
    ) -> None:
        storage.declare_key("metadata.score")
        path = storage.root / "storage.json"
        path.write_text(path.read_text().replace("metadata.score", key))
        with pytest.raises(
            FormatError, match=r"storage\.json: expected the settings of a storage: declared_keys\.0"
        ) as refused:
            FileStorage(storage.root)
        ((report, _),) = verify_paths([storage.root])
        assert [problem.message for problem in report.errors] == [str(refused.value)]

    def test_settings_of_a_later_version_are_refused(self, storage: FileStorage) -> None:
        storage.declare_key("metadata.score")
        path = storage.root / "storage.json"
        path.write_text(path.read_text().replace('"version": 1', '"version": 2'))
        with pytest.raises(FormatError, match=r"storage\.json: expected .* version: Input should be 1"):
            FileStorage(storage.root)

    def test_one_text_is_no_list_of_names(self, storage: FileStorage) -> None:
        for call in (storage.restore_episodes, storage.deleted_episodes, storage.compact):
            with pytest.raises(StorageError, match=r"found one text, 'a-0'; give \['a-0'\]"):
                call("a-0")

    def test_a_url_is_imported_by_the_command(self, storage: FileStorage) -> None:
        with pytest.raises(
            StorageError, match="expected a local path, found 'https://lab/x.mcap'; tupli-mcap import"
        ):
            storage.import_bundle("https://me:secret@lab/x.mcap")

    def test_no_file_has_a_name_that_the_system_cannot_hold(self, storage: FileStorage) -> None:
        with pytest.raises(NotFoundError, match=r"there is no recording 'recordings/\\ud800\.mcap'"):
            storage.recording_path("recordings/\ud800.mcap")

    def test_a_file_without_episodes_stays_as_long_as_somebody_records_to_it(
        self, storage: FileStorage
    ) -> None:
        path = storage.new_recording_path(storage.store_benchmark(query()).id)
        with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
            env.reset()
            storage.ingest(path)
            env.step(0)
        assert storage.count_episodes() == 1

    def test_a_file_without_episodes_stays_as_long_as_its_benchmark(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id), episode(header.id)])
        for one in made:
            storage.delete_episode(one.id)
        assert storage.list_episodes() == []
        assert storage.restore_episodes() == len(storage.list_episodes()) == 2
        assert storage.delete_episodes(FilterEQ(key="benchmark_id", value=header.id)) == 2
        storage.delete_benchmark(header.id)
        assert list((storage.root / "recordings").iterdir()) == []

    @pytest.mark.sampled(0, keep=["0-6-KeyboardInterrupt", "1-6-OSError"])
    @pytest.mark.parametrize("kind", [KeyboardInterrupt, OSError])
    @pytest.mark.parametrize(("first", "every"), [(0, 1), (0, 6), (1, 6)])
    def test_deleting_from_several_recordings_is_done_or_not(
        self, storage: FileStorage, tmp_path: Path, kind: type[BaseException], first: int, every: int
    ) -> None:
        header = storage.store_benchmark(query())
        for i in range(3):
            storage.record_episodes([episode(header.id, score=float(score)) for score in (i == 2, 1)])
        (storage.root / next(storage.root.rglob("*.mcap"))).rename(storage.root / "dropped\udcff.mcap")
        seen = set()
        for k in itertools.count(first, every):
            root = tmp_path / f"{k}"
            shutil.copytree(storage.root, root)
            calls = Calls(k, kind)
            with FileStorage(root) as one, pytest.MonkeyPatch.context() as patch:
                doomed = one.list_episodes(F("metadata.score") == 1)
                calls.patch(patch)
                try:
                    assert one.delete_episodes(F("metadata.score") == 1) == 4
                except (KeyboardInterrupt, StorageError):
                    assert calls.left < 0
            before = state_of(root)
            with FileStorage(root) as other:
                left = {h.id for h in other.list_episodes()}
            listed = list_recordings([root])
            of_files = TupliDataset.from_files(sorted(root.rglob("*.mcap")))
            assert len(left) == sum(item.episodes for item in listed) == len(of_files.preview())
            assert all(report.ok for report, _ in verify_paths([root]))
            assert state_of(root) == before
            seen.add(len(left))
            assert not left & {h.id for h in doomed} if len(left) == 2 else len(left) == 6
            with FileStorage(root) as other:
                other.delete_episodes(F("metadata.score") == 1)
                other.compact()
                assert other.count_episodes() == 2
            assert not (root / "deleting.json").exists()
            shutil.rmtree(root)
            if calls.left >= 0:
                break
        assert seen == {2, 6}
        assert k > 6

    def test_a_deletion_of_somebody_elses_stays_in_the_storage(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id), episode(header.id)])
        (tmp_path / "outside").mkdir()
        outside = tmp_path / "outside" / "a.mcap"
        shutil.copy(storage.root / made[0].recording, outside)
        (storage.root / "link").symlink_to(tmp_path / "outside")
        names = ["../outside/a.mcap", "link/a.mcap", str(outside), made[0].recording]
        deleting = storage.root / "deleting.json"
        uuids = dict.fromkeys(names, made[0].id.partition("-")[0])
        notes = {"version": 1, "deleted": {name: [0] for name in names}, "uuids": uuids}
        deleting.write_text(json.dumps(notes))
        assert [h.id for h in storage.list_episodes()] == [made[1].id]
        assert storage.delete_episodes(F("episode") == 0) == 0
        assert list(outside.parent.iterdir()) == [outside]
        assert not deleting.exists()
        deleting.write_text("{")
        with pytest.raises(FormatError, match=r"deleting\.json: expected episodes to delete: .*; delete it"):
            storage.list_episodes()

    def test_a_plain_recording_can_be_dropped_in(self, storage: FileStorage) -> None:
        storage.root.mkdir()
        with RecordEpisodes(gym.make("CartPole-v1"), storage.root / "plain.mcap") as env:
            env.reset(seed=1)
            while not any(env.step(env.action_space.sample())[2:4]):
                pass
        (header,) = storage.list_episodes()
        assert header.benchmark_id == ""
        assert header.seed == 1
        assert header.terminated

    def test_explain_names_the_index(self, storage: FileStorage) -> None:
        storage.declare_key("metadata.score")
        assert "USING COVERING INDEX ix_value" in storage.explain(F("metadata.score") > 3)

    @pytest.mark.sampled(0)
    def test_several_processes_at_once(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        context = multiprocessing.get_context("spawn")
        workers = [context.Process(target=_work, args=(storage, header.id, i)) for i in range(3)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
            assert worker.exitcode == 0
        assert storage.count_episodes() == 12
        assert len(storage.list_artifacts()) == 1
        assert sorted(h.metadata["score"] for h in storage.list_episodes()) == sorted(
            [0.0, 1.0, 2.0, 3.0] * 3
        )

    def test_several_threads_at_once(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        with ThreadPoolExecutor(4) as pool:
            list(pool.map(lambda i: _work(storage, header.id, i), range(4)))
        assert storage.count_episodes() == 16

    def test_a_full_disk_is_one_error(self, storage: FileStorage, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        header = storage.store_benchmark(query())
        monkeypatch.setattr(os, "fsync", refuse)
        with pytest.raises(StorageError, match=r"cannot store the artifact .*No space left on device"):
            storage.store_artifact(b"abc", ArtifactMetadata(name="x"))
        with pytest.raises(StorageError, match=r"cannot store the benchmark .*No space left on device"):
            storage.store_benchmark(query("other"))
        with pytest.raises(StorageError, match="No space left on device"):
            storage.publish_benchmark(header.id)
        monkeypatch.undo()
        assert storage.list_benchmarks() == [header]
        assert storage.list_artifacts() == []
        assert [p.name for p in storage.root.rglob(".*")] == [".lock"]  # no temporary file is left

    @pytest.mark.parametrize("code", [sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR_WRITE, None])
    def test_a_catalog_that_cannot_be_written_is_replaced(
        self, storage: FileStorage, monkeypatch: pytest.MonkeyPatch, code: int | None
    ) -> None:
        header = storage.store_benchmark(query())
        made = [storage.record_episode(episode(header.id)).id for _ in range(2)]
        storage.close()
        catalog = catalog_path(storage.root)
        assert catalog is not None
        catalog.unlink()
        if code is None:
            catalog.mkdir()
        put_recording = Catalog.put_recording

        def refuse(self: Catalog, *args: Any, **facts: Any) -> None:
            put_recording(self, *args, **facts)
            if code is not None and self.path is not None:
                err = sqlite3.OperationalError("database or disk is full")
                err.sqlite_errorcode = code
                with database._translated(self.path):
                    raise OperationalError("INSERT", None, err)

        monkeypatch.setattr(Catalog, "put_recording", refuse)
        with FileStorage(storage.root) as other:
            with pytest.warns(UserWarning, match="cannot be used: .*; TUPLI_MCAP_CACHE_DIR .* in memory"):
                assert sorted(h.id for h in other.list_episodes()) == sorted(made)
            other.delete_episode(made[0])
            assert [h.id for h in other.list_episodes()] == made[1:]

    def test_a_storage_that_can_only_be_read(
        self, storage: FileStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episode(episode(header.id))
        storage.close()
        open_file, before = os.open, state_of(storage.root)

        def refuse(path: Any, flags: int, *args: Any, **kwargs: Any) -> int:
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT) and str(path).startswith(f"{storage.root}/"):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            return open_file(path, flags, *args, **kwargs)

        monkeypatch.setattr(os, "open", refuse)  # permissions do not bind root
        for cache in ("empty", "filled already", None):
            if cache is None:
                monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", "/proc/none")
            with FileStorage(storage.root) as other, warnings.catch_warnings():
                warnings.simplefilter("ignore" if cache is None else "error")
                assert [h.id for h in other.list_episodes(F("n_tuples") > 0, include_tuples=True)] == [
                    made.id
                ]
                assert other.list_benchmarks() == [header]
                with pytest.raises(StorageError, match="cannot change the storage: .*Permission denied"):
                    other.delete_episode(made.id)
        assert state_of(storage.root) == before

    def test_a_catalog_in_the_storage_is_left_alone(self, storage: FileStorage) -> None:
        header = storage.store_benchmark(query())
        storage.record_episodes([episode(header.id), episode(header.id)])
        victim = storage.root / "victim"
        victim.write_bytes(b"not a child of it")
        with sqlite3.connect(storage.root / "catalog.sqlite") as connection:
            connection.execute("CREATE TABLE recording (id)")
        connection.close()
        journal = storage.root / "catalog.sqlite-journal"
        journal.write_bytes(hot_journal(victim))
        before = state_of(storage.root)
        with FileStorage(storage.root) as other:
            assert other.count_episodes(F("n_tuples") > 0) == 2
            other.reindex()
            assert other.count_episodes() == 2
        list(verify_paths([storage.root]))
        assert state_of(storage.root) == before
        assert victim.exists()

    def test_a_directory_in_the_place_of_another_has_its_own_episodes(self, tmp_path: Path) -> None:
        place, path = tmp_path / "lab", tmp_path / "lab" / "a.mcap"
        found: list[int | None] = []
        seeds, recorded = self._three_of_one_size(tmp_path)
        for recording, gone in zip(recorded, (None, path, place), strict=True):
            if gone is not None:
                shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
            place.mkdir(exist_ok=True)
            shutil.copyfile(recording, path)
            os.utime(path, ns=(0, 0))  # as archives that are made alike have it
            with FileStorage(place) as storage:
                found += [h.seed for h in storage.list_episodes()]
        assert found == seeds

    def _three_of_one_size(self, directory: Path) -> tuple[list[int], list[Path]]:
        """Seeds and recordings; times and checksums in the compressed index make a few bytes of difference."""
        of_size: dict[int, list[int]] = {}
        for seed in range(1000):
            path = directory / f"{seed}.mcap"
            with RecordEpisodes(gym.make("CartPole-v1"), path, compression="none", attachments={}) as env:
                env.reset(seed=seed)
                env.step(0)
            seeds = of_size.setdefault(path.stat().st_size, [])
            seeds.append(seed)
            if len(seeds) == 3:
                return seeds, [directory / f"{seed}.mcap" for seed in seeds]
        raise AssertionError("expected recordings of one size")

    def test_a_killed_recording_is_there(self, storage: FileStorage, monkeypatch: pytest.MonkeyPatch) -> None:
        header = storage.store_benchmark(query())
        script = textwrap.dedent("""
            import os, sys, gymnasium as gym
            from tupli_mcap.benchmark import TupliEnvWrapper
            from tupli_mcap.storage import FileStorage
            env = TupliEnvWrapper.load(FileStorage(sys.argv[1]), sys.argv[2])
            env.reset(seed=0)
            for action in range(5):
                env.step(action % 2)
            os.kill(os.getpid(), 9)
        """)
        done = subprocess.run([sys.executable, "-c", script, str(storage.root), header.id], check=False)
        assert done.returncode == -signal.SIGKILL
        (item,) = storage.list_episodes(include_tuples=True)
        assert (item.n_tuples, item.end) == (5, "interrupted")
        with monkeypatch.context() as patch:
            patch.setattr(entries, "Recording", None)  # a dead recording is read once
            assert storage.count_episodes() == 1
        storage.delete_episode(item.id)
        assert storage.compact() > 0
        assert list(storage.root.rglob("*.mcap*")) == []

    # --- bundles ---

    def bundle(self, storage: FileStorage, target: Path) -> tuple[str, str]:
        item = storage.store_artifact(b"gusts", ArtifactMetadata(name="wind", extra={"rows": 7}))
        env = gym.make("CartPole-v1")
        env.unwrapped.gravity = 2.0  # type: ignore[attr-defined]
        header = storage.store_benchmark(query(env=env, artifacts=(item.id,)))
        storage.record_episodes([episode(header.id, score=1.0), episode(header.id, score=2.0)])
        storage.record_episode(episode(header.id, score=3.0))
        assert storage.bundle(header.id, target) == target
        return header.id, item.id

    def test_a_bundle_is_all_another_storage_needs(self, storage: FileStorage, tmp_path: Path) -> None:
        benchmark, artifact = self.bundle(storage, tmp_path / "all.mcap")
        with FileStorage(tmp_path / "other") as other:
            assert other.import_bundle(tmp_path / "all.mcap") == benchmark
            assert other.import_bundle(tmp_path / "all.mcap") == benchmark
            assert other.load_artifact(artifact) == b"gusts"
            assert other.list_artifacts()[0].name == "wind"
            assert other.list_artifacts()[0].extra == {"rows": 7}
            items = other.list_episodes(include_tuples=True)
            assert sorted(item.metadata["score"] for item in items) == [1.0, 2.0, 3.0]
            assert {item.benchmark_id for item in items} == {benchmark}
            assert other.load_benchmark(benchmark).metadata.name == "cart"

    def test_a_bundle_of_one_recording(self, storage: FileStorage, tmp_path: Path) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id, score=float(i)) for i in range(3)])
        storage.delete_episode(made[1].id)
        storage.bundle(header.id, tmp_path / "b.mcap")
        with Recording(tmp_path / "b.mcap") as recording:
            assert [e.metadata["score"] for e in recording.episodes] == [0.0, 2.0]
            assert recording.benchmark.id == header.id

    def test_an_imported_environment_is_not_trusted(
        self, storage: FileStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.bundle(storage, tmp_path / "all.mcap")
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "somebody else"))
        with Recording(tmp_path / "all.mcap") as recording, pytest.raises(UntrustedError, match="would run"):
            recording.benchmark.make_env()
        with FileStorage(tmp_path / "other") as other:
            other.import_bundle(tmp_path / "all.mcap", trust=True)
        with Recording(tmp_path / "all.mcap") as recording:
            assert recording.benchmark.make_env().unwrapped.gravity == 2.0  # type: ignore[attr-defined]

    def test_bundles_refuse_what_is_not_there(self, storage: FileStorage, tmp_path: Path) -> None:
        benchmark, artifact = self.bundle(storage, tmp_path / "all.mcap")
        with pytest.raises(StorageError, match="exists and is not overwritten"):
            storage.bundle(benchmark, tmp_path / "all.mcap")
        with pytest.raises(NotFoundError, match="there is no benchmark"):
            storage.bundle("0" * 64, tmp_path / "none.mcap")
        storage.delete_artifact(artifact, force=True)
        with pytest.raises(NotFoundError, match="there is no artifact"):
            storage.bundle(benchmark, tmp_path / "none.mcap")
        assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == ["all.mcap"]
        with RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "bare.mcap", benchmark_id=benchmark, attachments={}
        ) as env:
            env.reset()
            env.step(0)
        before = storage.list_episodes()
        with pytest.raises(StorageError, match="names a benchmark, but carries no environment"):
            storage.import_bundle(tmp_path / "bare.mcap")
        assert storage.list_episodes() == before

    @pytest.mark.parametrize("carries_environment", [True, False])
    def test_a_recording_without_a_benchmark_is_imported_without_one(
        self, storage: FileStorage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, carries_environment: bool
    ) -> None:
        path = tmp_path / "run.mcap"
        if carries_environment:
            with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
                for seed in range(3):
                    env.reset(seed=seed, options={})
                    env.step(0)
        else:
            with EpisodeWriter(path, spaces.Box(-1, 1, (2,)), spaces.Discrete(2)) as writer:
                for score in range(3):
                    writer.begin(metadata={"score": score})
                    writer.step(np.zeros(2, np.float32), 0, 1.0)
                    writer.end(np.ones(2, np.float32))
        with Recording(path) as recording:
            ids = [f"{recording.uuid}-{n}" for n in range(3)]
            rewards = recording.read().rewards
        assert read_bundle(storage, path, dry_run=True)[:6] == ("", "", 3, 3, 0, 0)
        assert not storage.root.exists()
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "somebody else"))
        for _ in range(2):
            assert storage.import_bundle(path, trust=True) == ""
            assert [header.id for header in storage.list_episodes(F("benchmark_id") == "")] == ids
        assert [one.name for one in (storage.root / "recordings").glob("*.mcap")] == ["run.mcap"]
        dataset = tupli_mcap.open(storage.root)
        assert (dataset.read().rewards == rewards).all() and storage.list_benchmarks() == []
        if carries_environment:
            with Recording(storage.root / "recordings" / "run.mcap") as recording:
                recording.benchmark.make_env().close()  # it is trusted
        # what was deleted beside the file is left out
        tupli_mcap.open(path).filter(F("id") == ids[2]).delete()
        with FileStorage(tmp_path / "second") as second:
            assert read_bundle(second, path, dry_run=True)[2:4] == (2, 2)
            assert read_bundle(second, path)[2:4] == (2, 2)
            assert [header.id for header in second.list_episodes()] == ids[:2]
        # what was deleted in the storage stays so; another file of the same name goes beside it
        storage.delete_episode(ids[1])
        with pytest.warns(UserWarning, match="not copied: 1 episode that had been deleted there"):
            storage.import_bundle(path)
        assert [header.id for header in storage.list_episodes()] == [ids[0], ids[2]]
        with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "live.mcap") as env:
            env.reset()
            env.step(0)
            for dry_run in (True, False):
                with pytest.raises(
                    RecordingError, match="is being recorded; import it when its writer has closed it"
                ):
                    read_bundle(storage, tmp_path / "live.mcap", dry_run=dry_run)
        record_rollouts("CartPole-v1", tmp_path / "other" / "run.mcap", episodes=1)
        storage.import_bundle(tmp_path / "other" / "run.mcap")
        record_rollouts("CartPole-v1", tmp_path / "third.mcap", episodes=1)
        storage.import_bundle((tmp_path / "third.mcap").rename(tmp_path / "third"))
        assert {header.recording for header in storage.list_episodes()} == {
            f"recordings/{name}.mcap" for name in ("run", "run-2", "third")
        }

    def test_an_artifact_without_metadata_is_not_copied(self, storage: FileStorage, tmp_path: Path) -> None:
        item = storage.store_artifact(b"0.5", ArtifactMetadata(name="wind"))
        header = storage.store_benchmark(query(artifacts=(item.id,)))
        storage.record_episode(episode(header.id))
        (storage.root / "artifacts" / f"{item.id}.json").unlink()
        assert storage.load_artifact(item.id) == b"0.5"
        with pytest.warns(UserWarning, match="not copied: 1 episode: there is no artifact with id"):
            assert copy_episodes(storage, FileStorage(tmp_path / "other")) == {}

    def test_recordings_of_one_long_name(self, storage: FileStorage, tmp_path: Path) -> None:
        for place in (tmp_path / "a", tmp_path / "b"):
            record_rollouts("CartPole-v1", place / "x.mcap", episodes=1)
            storage.import_bundle((place / "x.mcap").rename(place / f"b{'é' * 124}.mcap"))
        found = [header.recording for header in storage.list_episodes()]
        assert found == [f"recordings/b{'é' * 114}{end}.mcap" for end in ("-2", "")]
        assert storage.delete_episodes("episode >= 0") == 2

    def test_a_recording_whose_name_is_no_utf_8_is_imported_where_it_is_listed(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        path = record_rollouts("CartPole-v1", tmp_path / "run.mcap", episodes=1).path
        storage.import_bundle(path.rename(tmp_path / os.fsdecode(b"\xff.mcap")))
        assert [header.recording for header in storage.list_episodes()] == ["recordings/recording.mcap"]

    def test_another_name_is_shown_and_the_benchmark_stays_the_same(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        header = storage.store_benchmark(query("pole"))
        storage.record_episode(episode(header.id))
        storage.edit_benchmark(header.id, name="cart pole", description="wind")
        storage.publish_benchmark(header.id, "lab")
        edited = storage.edit_benchmark(header.id, name="cart pole, windy")
        assert edited.id == header.id
        assert edited.stored_metadata == header.metadata
        for found in (edited, storage.load_benchmark(header.id), *storage.list_benchmarks()):
            assert (found.metadata.name, found.metadata.description) == ("cart pole, windy", "wind")
        assert storage.list_benchmarks(F("metadata.name") == "pole") == []
        assert storage.store_benchmark(query("pole")).metadata.name == "cart pole, windy"
        storage.bundle(header.id, tmp_path / "b.mcap")
        other = FileStorage(tmp_path / "other")
        assert read_bundle(other, tmp_path / "b.mcap", dry_run=True).name == "cart pole, windy"
        assert other.import_bundle(tmp_path / "b.mcap") == header.id
        assert other.load_benchmark(header.id).metadata == edited.metadata
        copied = copy_episodes(storage, FileStorage(tmp_path / "third"), benchmark_id=header.id)
        assert copied[header.id].episodes == 1
        assert all(report.ok for report, _ in verify_paths([other.root]))
        document = json.loads((storage.root / "benchmarks" / f"{header.id}.json").read_text())
        validator("benchmark.schema.json").validate(document)
        assert storage.undo_benchmark_edit(header.id, dry_run=True).metadata.name == "cart pole"
        assert storage.undo_benchmark_edit(header.id).metadata.name == "cart pole"
        assert storage.undo_benchmark_edit(header.id).metadata == header.metadata
        with pytest.raises(StorageError, match="has no edit to take back"):
            storage.undo_benchmark_edit(header.id)
        for nothing in ({}, {"name": " "}):
            with pytest.raises(StorageError, match="expected a name or a description"):
                storage.edit_benchmark(header.id, **nothing)

    def test_a_plain_recording_gets_a_benchmark_of_its_environment(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        for name in ("a", "b"):
            with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / f"{name}.mcap") as env:
                env.reset(seed=1)
                env.step(0)
            bundle_recording(tmp_path / f"{name}.mcap", tmp_path / f"{name}-bundle.mcap")
        ids = {storage.import_bundle(tmp_path / f"{name}-bundle.mcap") for name in ("a", "b")}
        (header,) = storage.list_benchmarks()
        assert ({header.id}, header.metadata.name) == (ids, "CartPole-v1")
        assert [episode.benchmark_id for episode in storage.list_episodes()] == [header.id] * 2
        with TupliEnvWrapper.load(storage=storage, benchmark_id=header.id) as env:
            assert env.unwrapped.spec.id == "CartPole-v1"
        with EpisodeWriter(tmp_path / "robot.mcap", spaces.Box(-1, 1, (2,)), spaces.Discrete(2)) as writer:
            writer.begin()
            writer.step(np.zeros(2, np.float32), 0, 0.0)
        bundle_recording(tmp_path / "robot.mcap", tmp_path / "copy.mcap")
        with Recording(tmp_path / "copy.mcap") as copy:
            assert (copy.benchmark_id, len(copy)) == ("", 1)
        assert storage.import_bundle(tmp_path / "copy.mcap") == ""

    def test_importing_what_was_annotated_since(self, storage: FileStorage, tmp_path: Path) -> None:
        path = tmp_path / "run.mcap"
        with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
            for seed in range(3):
                env.reset(seed=seed)
                env.step(0)
        storage.import_bundle(path)
        tupli_mcap.open(path)[:2].annotate(good=True)
        for dry_run in (True, False):
            with pytest.warns(
                UserWarning, match="there already with other metadata, and left so: 2 episodes$"
            ):
                read_bundle(storage, path, dry_run=dry_run)
        assert [header.metadata for header in storage.list_episodes()] == [{}, {}, {}]

    def test_a_hidden_file_is_imported_to_be_seen(self, storage: FileStorage, tmp_path: Path) -> None:
        path = tmp_path / ".run.mcap"
        with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
            env.reset()
            env.step(0)
        for _ in range(2):
            storage.import_bundle(path)
            assert [header.recording for header in storage.list_episodes()] == ["recordings/run.mcap"]

    def test_importing_at_home_changes_nothing(self, storage: FileStorage, tmp_path: Path) -> None:
        header = storage.store_benchmark(query())
        made = storage.record_episodes([episode(header.id, score=float(i)) for i in range(3)])
        storage.bundle(header.id, tmp_path / "b.mcap", F("metadata.score") > 0)
        storage.import_bundle(tmp_path / "b.mcap")
        assert [h.id for h in storage.list_episodes()] == [h.id for h in made]
        storage.delete_episode(made[1].id)
        with pytest.warns(UserWarning, match="not copied: 1 episode that had been deleted there"):
            storage.import_bundle(tmp_path / "b.mcap")
        assert {h.id for h in storage.list_episodes()} == {made[0].id, made[2].id}
        storage.restore_episodes()
        assert [h.id for h in storage.list_episodes()] == [h.id for h in made]

    def test_a_bundle_without_episodes(self, storage: FileStorage, tmp_path: Path) -> None:
        env = gym.make("CartPole-v1")
        told = query()
        record = capture(env)
        told = told.model_copy(update={"serialized": pack(record, (), facts_about(env))})
        header = storage.store_benchmark(told)
        storage.bundle(header.id, tmp_path / "b.mcap")
        with FileStorage(tmp_path / "other") as other:
            assert other.import_bundle(tmp_path / "b.mcap") == header.id
            assert other.list_episodes() == []

    def test_export(self, storage: FileStorage, tmp_path: Path) -> None:
        first, second = (storage.store_benchmark(query(name)).id for name in ("one", "two"))
        for benchmark in (first, second):
            storage.record_episodes([episode(benchmark, score=float(i)) for i in range(3)])
        storage.record_episode(episode(first, score=7.0))
        of_first = FilterEQ(key="benchmark_id", value=first)
        storage.export(tmp_path / "e.mcap", of_first & (F("metadata.score") > 1))
        with Recording(tmp_path / "e.mcap") as recording:
            assert recording.benchmark_id == first
            assert sorted(e.metadata["score"] for e in recording.episodes) == [2.0, 7.0]
            assert recording.benchmark.record.name == "CartPole-v1"
        with pytest.raises(StorageError, match="found 7 episodes of 2"):
            storage.export(tmp_path / "f.mcap")
        with pytest.raises(StorageError, match="nothing matches"):
            storage.export(tmp_path / "f.mcap", F("metadata.score") > 100)
        with pytest.raises(StorageError, match="exists and is not overwritten"):
            storage.export(tmp_path / "e.mcap", of_first)

    def test_several_recordings_in_one_file_keep_their_runs_annotations_and_times(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        benchmark = ""
        for name in ("first", "second"):
            about = {"name": name, "metadata": {"lr": len(name)}, "tags": [name]}
            env = TupliEnvWrapper(
                gym.make("CartPole-v1"),
                storage=storage,
                benchmark_id=benchmark or None,
                record_info=True,
                **about,
            )
            benchmark = benchmark or env.store(name="pole")
            with env:
                env.reset(seed=len(name))
                for _ in range(3):
                    env.step(0)
        stored = storage.list_episodes()
        tupli_mcap.open(storage.root / stored[1].recording).annotate(good=True)
        storage.bundle(benchmark, tmp_path / "bundle.mcap")
        storage.export(tmp_path / "export.mcap")
        merge_recordings([storage.root / one.recording for one in stored], tmp_path / "merge.mcap")
        with Recording(tmp_path / "merge.mcap") as merged:
            for name in ("bundle", "export"):
                with Recording(tmp_path / f"{name}.mcap") as recording:
                    assert (recording.runs, recording.run_places) == (merged.runs, merged.run_places)
                    assert recording.all_metadata() == merged.all_metadata()
                    for field in ("start_time", "end_time", "seed"):
                        assert (recording.index[field] == merged.index[field]).all()
                    assert (recording.read(["times"]).times == merged.read(["times"]).times).all()
                    assert verify_recording(recording.path).ok
            assert [(run.name, run.metadata, run.tags) for run in merged.runs] == [
                ("first", {"lr": 5}, ("first",)), ("second", {"lr": 6}, ("second",)),
            ]  # fmt: skip
            assert [one.metadata.get("good") for one in merged.episodes] == [None, True]

    def test_recordings_that_differ_do_not_fit_into_one_file(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        benchmark = storage.store_benchmark(query()).id
        for state in ([0.5, 1.0], [0.5, 1.0, 2.0]):
            item = RLTuple(state=state, action=0, reward=1.0, terminal=True)
            storage.record_episode(Episode(benchmark_id=benchmark, metadata={}, tuples=[item]))
        for write in (storage.export, lambda target: storage.bundle(benchmark, target)):
            with pytest.raises(
                StorageError, match="differ, so that one file cannot hold them all .*filter on"
            ):
                write(tmp_path / "all.mcap")
        assert not list(tmp_path.glob("*.mcap*"))

    def test_a_recording_from_a_storage_lacks_its_artifacts(
        self, storage: FileStorage, tmp_path: Path
    ) -> None:
        benchmark, artifact = self.bundle(storage, tmp_path / "all.mcap")
        (header, *_) = storage.list_episodes()
        shutil.copy(storage.root / header.recording, tmp_path / "one.mcap")
        with FileStorage(tmp_path / "other") as other:
            with pytest.raises(StorageError, match=f"lacks the artifact {artifact}"):
                other.import_bundle(tmp_path / "one.mcap")
            other.store_artifact(b"gusts", ArtifactMetadata(name="wind"))
            assert other.import_bundle(tmp_path / "one.mcap") == benchmark


def _work(storage: FileStorage, benchmark_id: str, worker: int) -> None:
    storage.store_artifact(b"shared", ArtifactMetadata(name=f"from {worker}"))
    for i in range(4):
        storage.record_episode(episode(benchmark_id, score=float(i)))
        storage.list_episodes()


def state_of(root: Path) -> dict[str, tuple[int, int, int]]:
    """Everything in a directory, with size, time of change and inode."""
    found = {path: path.lstat() for path in (root, *root.rglob("*"))}
    return {str(path): (status.st_size, status.st_mtime_ns, status.st_ino) for path, status in found.items()}


class Calls:
    """Lets so many changes of files pass, and breaks off at the next."""

    def __init__(self, left: int, kind: type[BaseException]) -> None:
        self.left, self._kind = left, kind

    def patch(self, patch: pytest.MonkeyPatch) -> None:
        for name in ("replace", "unlink", "rename", "rmdir"):
            patch.setattr(os, name, self._counted(getattr(os, name)))

    def _counted(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def counted(path: Any, *args: Any, **kwargs: Any) -> Any:
            if not str(path).endswith(".tmp"):  # what is removed whether it was used or not
                self._count()
            if call is _REPLACE:
                self._count()
            return call(path, *args, **kwargs)

        return counted

    def _count(self) -> None:
        self.left -= 1
        if self.left == -1:
            raise self._kind(errno.EIO, os.strerror(errno.EIO))


_REPLACE = os.replace


def hot_journal(victim: Path) -> bytes:
    """A rollback journal that SQLite plays back, deleting the file that it names as its super-journal."""
    magic = bytes.fromhex("d9d505f920a163d7")
    name = os.fsencode(victim)
    header = magic + struct.pack(">IIIII", 0, 0, 2, 512, 4096)
    lock_page = (1 << 30) // 4096 + 1
    tail = struct.pack(">I", lock_page) + name + struct.pack(">II", len(name), sum(name)) + magic
    return header.ljust(512, b"\0") + tail


# --- the contract can fail ---


class _Forgetful(FileStorage):
    """Wrong in one place each: every test named below must notice."""

    def delete_episode(self, uri: str) -> None:
        pass


class _Duplicating(FileStorage):
    def store_artifact(self, artifact: bytes, metadata: ArtifactMetadata) -> Any:
        return super().store_artifact(artifact + uuid.uuid4().bytes, metadata)


class _Careless(FileStorage):
    def delete_artifact(self, uri: str, *, force: bool = False) -> None:
        super().delete_artifact(uri, force=True)


class _Unfiltered(FileStorage):
    def list_episodes(self, filter: Any = None, include_tuples: bool = False, **page: Any) -> Any:
        return super().list_episodes(None, include_tuples, **page)


class _Unsorted(FileStorage):
    def list_headers(self, filter: Any, limit: Any, offset: int, sort: Any) -> Any:
        return super().list_headers(filter, limit, offset, None)


class _Believing(FileStorage):
    def open_recording(self, recording: str) -> Recording:
        return Recording(self.root / recording)


@pytest.mark.parametrize(
    ("broken", "test"),
    [
        (_Forgetful, "test_delete_episodes"),
        (_Duplicating, "test_artifact_round_trip"),
        (_Duplicating, "test_artifacts_are_deduplicated"),
        (_Careless, "test_an_artifact_in_use_is_not_deleted"),
        (_Unfiltered, "test_episodes_filter_and_page"),
        (_Unsorted, "test_episodes_in_an_order"),
    ],
)
def test_the_contract_notices_broken_storages(tmp_path: Path, broken: type[FileStorage], test: str) -> None:
    with broken(tmp_path / "lab") as storage, pytest.raises((AssertionError, pytest.fail.Exception)):
        getattr(StorageContract(), test)(storage)


def test_the_contract_notices_ids_used_as_paths(tmp_path: Path) -> None:
    with _Believing(tmp_path / "lab") as storage, pytest.raises((TupliError, AssertionError)):
        StorageContract().test_ids_are_no_paths(storage)


def test_pytupli_s_error_name() -> None:
    assert TupliStorageError is StorageError


# --- spaces from values ---

BOX_3 = gym.spaces.Box(-np.inf, np.inf, (3,), np.float64)


@pytest.mark.parametrize(
    ("values", "space"),
    [
        ([1, 2], gym.spaces.Box(-(2**63), 2**63 - 1, (), np.int64)),
        ([1, 2.5], gym.spaces.Box(-np.inf, np.inf, (), np.float64)),
        ([True, False], gym.spaces.Box(0, 1, (), np.bool_)),
        ([2**64 - 1, 1], gym.spaces.Box(0, 2**64 - 1, (), np.uint64)),
        ([[1.0, 2.0], [3.0, 4.0]], gym.spaces.Box(-np.inf, np.inf, (2,), np.float64)),
        ([np.zeros((2, 3), np.uint8)], gym.spaces.Box(0, 255, (2, 3), np.uint8)),
        ([np.float32(1)], gym.spaces.Box(-np.inf, np.inf, (), np.float32)),
        (["ab", "b"], gym.spaces.Text(2, min_length=0, charset="ab")),
        ([{"b": 1, "a": 2.0}], None),
        ([(1, 2.0)], None),
        ([np.zeros((2, 3)), np.zeros((0, 3))], gym.spaces.Sequence(BOX_3, stack=True)),
    ],
)  # fmt: skip
def test_inferred_spaces(values: list[Any], space: gym.Space[Any] | None) -> None:
    found = infer_space(values)
    if space is not None:
        assert found == space
    for value in values:
        assert found.contains(conform(value, found))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "expected at least one value"),
        ([None], "expected numbers, flags, texts, arrays, dicts or tuples, found builtins.NoneType"),
        ([[1.0], [1.0, [2.0]]], "expected a list with items of one shape"),
        ([np.zeros(2), np.zeros((2, 2))], r"expected values of one shape, found shapes"),
        ([{"a": 1}, {"b": 1}], r"expected every step to be like the first .*, step 1 has"),
        ([(1, 2), (1,)], "step 1 has"),
        (["a", 1], "step 1 has 1"),
        ([{"a": {"b": object()}}], r"state\.a\.b: expected numbers"),
    ],
)
def test_values_without_a_space(values: list[Any], message: str) -> None:
    with pytest.raises(SpaceError, match=message):
        infer_space(values, "state")


def test_conform_changes_nothing() -> None:
    box = gym.spaces.Box(-1, 1, (), np.float32)
    with pytest.raises(SpaceError, match="expected a value of Box"):
        conform(0.1, box)
    assert conform(0.5, box) == 0.5
    double = gym.spaces.Box(-np.inf, np.inf, (), np.float64)
    assert conform(2**53, double) == 2.0**53
    for odd in (2**53 + 1, 2**63 - 1, np.uint64(2**64 - 1), [2**53 + 1]):
        with pytest.raises(SpaceError, match="expected a value of Box"):
            conform(odd, double)
    with pytest.raises(SpaceError, match="expected a value of Discrete"):
        conform(1.5, gym.spaces.Discrete(3))


def test_interrupted_episodes_that_have_ended_are_listed_while_others_are_recorded(tmp_path: Path) -> None:
    space, state = spaces.Box(-1, 1, (1,)), np.zeros(1, np.float32)

    def listed() -> list[int]:
        with FileStorage(tmp_path) as storage:
            return [header.episode for header in storage.list_episodes()]

    def begin(mode: Any) -> EpisodeWriter:
        return EpisodeWriter(tmp_path / "a.mcap", space, spaces.Discrete(2), num_envs=2, mode=mode)

    def record(writer: EpisodeWriter, env: int) -> None:
        writer.begin(env=env)
        writer.step(state, 0, 0.0, env=env)

    with begin("x") as writer:
        for env in (0, 1):
            record(writer, env)
        assert listed() == []
        writer.end(state, env=1)
        assert listed() == [1], "it ended, before the next one began"
    assert listed() == [0, 1]
    with begin("a") as writer:
        assert listed() == [0, 1]
        record(writer, 0)
        assert listed() == [0, 1], "nothing was recorded of sub-environment 1 since"
    assert listed() == [0, 1, 2]


class MyStorage(FileStorage):
    """A subclass of a user."""


class MyClient(TupliAPIClient):
    """A subclass of a user."""


@pytest.mark.parametrize("kind", [MyStorage, MyClient])
def test_a_copy_of_a_subclass_is_of_the_subclass(kind: type[Any], tmp_path: Path) -> None:
    with kind("http://127.0.0.1:9" if kind is MyClient else tmp_path) as storage:
        assert type(pickle.loads(pickle.dumps(storage))) is type(copy.copy(storage)) is kind


def of_returns(root: Path, count: int) -> Path:
    """A storage with as many episodes of one and two steps, some of which have equal returns."""
    lengths = [1 + i % 2 for i in range(count)]
    data = [np.zeros((length, 2), np.float32) for length in lengths]
    rewards = [np.full(length, i % 17) for i, length in enumerate(lengths)]
    made = root / f"{count}.mcap"
    write_rollout(made, states=data, actions=data, rewards=rewards, terminals=[True] * count)
    assert run("import", made, "--storage", root / str(count)).code == 0
    assert len(run("episodes", root / str(count), "--limit", 1).out.splitlines()) == 2  # it is catalogued
    return root / str(count)


def test_the_first_episodes_in_an_order_are_found_without_the_others(tmp_path: Path) -> None:
    few, many = (of_returns(tmp_path, count) for count in (500, 4000))
    asked = ("--sort", "-return", "--limit", 3)
    assert calls(lambda: run("episodes", many, *asked)) < 2 * calls(lambda: run("episodes", few, *asked))


def test_the_first_of_a_dataset_are_found_without_the_others(tmp_path: Path) -> None:
    few, many = (of_returns(tmp_path, count) for count in (500, 4000))

    def best(root: Path) -> list[float]:
        dataset = tupli_mcap.open(root).filter("steps = 2").sort("return", descending=True)
        found = dataset.head(3)
        assert found.chosen_by == ("steps == 2", "sort: return, descending", "head: 3")
        assert [header.id for header in found.headers] == [header.id for header in dataset.headers[:3]]
        return found.returns.tolist()

    assert best(few) == best(many) == [32.0] * 3
    asked = [lambda root=root: tupli_mcap.open(root).sort("return").head(3) for root in (few, many)]
    assert calls(asked[1]) < 2 * calls(asked[0])


def test_a_dataset_in_an_order_narrows_and_sorts_as_any(tmp_path: Path) -> None:
    root = of_returns(tmp_path, 40)
    now = tupli_mcap.open(root)
    assert len(now) == 40  # they are listed
    for chosen in (
        lambda dataset: dataset.sort("return"),
        lambda dataset: dataset.sort("steps", descending=True).filter("return > 3").head(4),
        lambda dataset: dataset.sort("steps").sort("return", descending=True).head(9),
        lambda dataset: dataset.sort("ended").head(9).sort("return").filter("return > 30")[-3:],
        lambda dataset: dataset.sort("return").filter_steps("step = 1").head(3),
        lambda dataset: dataset.head(4),
        lambda dataset: dataset.sort("return").head(0),
    ):
        later = chosen(tupli_mcap.open(root))
        assert later.chosen_by == chosen(now).chosen_by
        assert [h.id for h in later.headers] == [h.id for h in chosen(now).headers]
        assert later.n_steps == chosen(now).n_steps
    with pytest.raises(FilterError, match="no episode has metadata.none"):
        len(tupli_mcap.open(root).filter("metadata.none > 3").sort("return").head(2))


@pytest.mark.parametrize("limit", [1, 30])
@pytest.mark.parametrize("key", ["return", "-return", "steps", "-steps", "ended", "seed", "run.name"])
def test_the_first_episodes_in_an_order_are_those_of_all(tmp_path: Path, key: str, limit: int) -> None:
    storage = of_returns(tmp_path, 40)
    for chosen in ((), ("--filter", "return > 3")):
        whole = run("episodes", storage, "--sort", key, *chosen, "--json").json
        assert (
            run("episodes", storage, "--sort", key, "--limit", limit, *chosen, "--json").json == whole[:limit]
        )
