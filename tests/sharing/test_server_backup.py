"""Backups of servers are whole, and come back anywhere."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import buckets
import pytest
from postgres import Cluster
from serving import PASSWORD, serving
from stored_items import episode, query

from tupli_mcap.cli import app
from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.recording import verify_recording
from tupli_mcap.schema import ArtifactMetadata, F, Group
from tupli_mcap.server.backup import back_up, restore
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import TupliAPIClient
from tupli_mcap.wrappers.rollout import record_rollouts

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3
KINDS = ("sqlite and a directory", "postgresql and s3")


@contextlib.contextmanager
def place(kind: str, directory: Path, postgres: Cluster) -> Iterator[Settings]:
    """Where a server may keep things; nothing is there."""
    settings = Settings(directory)
    with contextlib.ExitStack() as stack:
        if "postgresql" in kind:
            database = stack.enter_context(postgres.database(empty=True))
            bucket = stack.enter_context(buckets.bucket())
            settings = replace(settings, database=database, blobs=f"{bucket.url}/x")
        yield settings


@contextlib.contextmanager
def signed_in(settings: Settings) -> Iterator[TupliAPIClient]:
    with serving(settings) as url, TupliAPIClient(url) as admin:
        admin.login("admin", PASSWORD)
        yield admin


def contents(admin: TupliAPIClient) -> dict[str, Any]:
    """All that a server shows its admin."""
    items = admin.list_episodes(include_tuples=True)
    return {
        "benchmarks": [admin.load_benchmark(header.id) for header in admin.list_benchmarks()],
        "artifacts": {item.id: admin.load_artifact(item.id) for item in admin.list_artifacts()},
        "episodes": repr([item.model_dump() for item in items]),
        "users": admin.list_users(),
        "groups": admin.list_groups(),
    }


def fill(admin: TupliAPIClient) -> None:
    admin.create_group(Group(name="lab"))
    admin.declare_key("metadata.score")
    artifact = admin.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
    benchmark = admin.store_benchmark(query(artifacts=(artifact,))).id
    made = admin.record_episodes([episode(benchmark, 3 + i, float(i)) for i in range(3)])
    admin.record_episodes([episode(benchmark, 9, 7.5)])
    admin.publish_episode(made[0].id, "lab")
    admin.delete_episode(made[1].id)


@pytest.mark.parametrize(("here", "there"), [KINDS, KINDS[::-1]])
def test_a_backup_comes_back_anywhere(
    here: str, there: str, tmp_path: Path, postgres: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    backup = tmp_path / "backup"
    with place(here, tmp_path / "here", postgres) as settings, signed_in(settings) as admin:
        fill(admin)
        before = contents(admin)
        first = back_up(settings, backup)
        assert first[:3] == (1, 2, 1) and first.copied == 3
        assert back_up(settings, backup) == first._replace(copied=0)
    with place(there, tmp_path / "there", postgres) as settings:
        options = [f"--database={settings.database}", f"--blobs={settings.blobs}"] if settings.blobs else []
        for _ in range(2):
            code = app(
                ["restore-server", str(backup), str(settings.directory), *options], standalone_mode=False
            )
            said = capsys.readouterr()
            if code:
                assert (
                    "the target's database holds a server's data already; restore into an empty one"
                    in said.err
                )
            else:
                assert "restored 1 user, 2 recordings, 1 artifact" in said.out
        with signed_in(settings) as admin:
            assert contents(admin) == before
            assert admin.count_episodes(F("metadata.score") == 7.5) == 1
            fill_more = admin.record_episodes([episode(before["benchmarks"][0].id)])
            assert admin.count_episodes(F("id") == fill_more[0].id) == 1
    with signed_in(Settings(backup)) as admin:  # as it is
        assert contents(admin) == before


def test_what_is_gone_is_not_in_the_next_backup(tmp_path: Path) -> None:
    settings, backup = Settings(tmp_path / "served"), tmp_path / "backup"
    with signed_in(settings) as admin:
        fill(admin)
        back_up(settings, backup)
        admin.delete_episodes(F("steps") == 9)
        told = back_up(settings, backup)
        assert (told.recordings, told.copied) == (1, 0)
    assert len(list(backup.rglob("*.mcap"))) == 1


def test_what_a_directory_had_is_gone_from_the_next_backup_too(tmp_path: Path) -> None:
    """Where it was there, the server of the backup would take it for a new recording of the admin's."""
    settings, backup = Settings(tmp_path / "served"), tmp_path / "backup"
    for name in ("kept", "gone"):
        record_rollouts("CartPole-v1", settings.directory / "runs" / f"{name}.mcap", steps=30, seed=1)
    (settings.directory / "recordings").mkdir()
    with signed_in(settings) as admin:
        fill(admin)
        back_up(settings, backup)
        admin.delete_episodes(F("recording") == "runs/gone.mcap")
        back_up(settings, backup)
        before = contents(admin)
    with signed_in(Settings(backup)) as admin:
        assert contents(admin) == before


def test_a_backup_while_much_comes_and_goes(tmp_path: Path) -> None:
    settings, stop = Settings(tmp_path / "served"), threading.Event()
    with signed_in(settings) as admin:
        benchmark = admin.store_benchmark(query()).id

        def come_and_go() -> None:
            with TupliAPIClient(admin.url) as client:
                while not stop.is_set():
                    made = client.record_episodes([episode(benchmark)])
                    client.delete_episodes(F("recording") == made[0].recording)
                    client.record_episodes([episode(benchmark)])

        thread = threading.Thread(target=come_and_go)
        thread.start()
        try:
            for i in range(5):
                back_up(settings, tmp_path / f"backup{i}")
        finally:
            stop.set()
            thread.join()
    for i in range(5):
        with signed_in(Settings(tmp_path / f"backup{i}")) as admin:
            headers = admin.list_episodes()
            for name in {header.recording for header in headers}:
                assert verify_recording(tmp_path / f"backup{i}" / name).ok
            assert len(list((tmp_path / f"backup{i}").rglob("*.mcap"))) == len(headers)


@pytest.mark.parametrize("call", ["sqlite3.connect", "os.link", "os.replace"])
def test_a_killed_backup_is_called_again(tmp_path: Path, call: str) -> None:
    """A new one, before and after it has a database; nothing of the killed one stays."""
    settings, backup = Settings(tmp_path / "served"), tmp_path / "backup"
    with signed_in(settings) as admin:
        fill(admin)
        before = contents(admin)
    module, _, function = call.partition(".")
    kill = (
        f"import os, sys, {module}\n"
        "from pathlib import Path\n"
        "from tupli_mcap.server.backup import back_up\n"
        "from tupli_mcap.server.settings import Settings\n"
        f"{module}.{function} = {module}.dbapi2.{function} = lambda *_, **__: os.kill(os.getpid(), 9)\n"
        "back_up(Settings(Path(sys.argv[1])), Path(sys.argv[2]))"
    ).replace("os.dbapi2.", "os.")
    words = [sys.executable, "-c", kill, str(settings.directory), str(backup)]
    assert subprocess.run(words, check=False).returncode == -9
    back_up(settings, backup)
    assert [path.name for path in (backup / "server").iterdir()] == ["server.sqlite"]
    with signed_in(Settings(backup)) as admin:
        assert contents(admin) == before


def test_files_that_a_failed_backup_has_copied_are_not_given_to_the_admin(tmp_path: Path) -> None:
    settings, backup = Settings(tmp_path / "served"), tmp_path / "backup"
    with signed_in(settings) as admin:
        admin.create_group(Group(name="lab"))
        back_up(settings, backup)
        benchmark = admin.store_benchmark(query()).id
        names = sorted(admin.record_episodes([episode(benchmark)])[0].recording for _ in range(2))
        damaged = settings.directory / names[-1]
        damaged.write_bytes(b"x" * damaged.stat().st_size)
        with pytest.raises(FormatError, match="is damaged"):
            back_up(settings, backup)
    assert (backup / names[0]).exists()
    with signed_in(Settings(backup)) as admin:
        assert admin.list_groups() and admin.list_episodes() == []


def test_a_backup_says_where_it_looked_in_vain(tmp_path: Path) -> None:
    settings = Settings(tmp_path / "served")
    backup = tmp_path / "backup"
    with signed_in(settings) as admin:
        fill(admin)
    back_up(settings, backup)
    for root in (settings.directory, backup):
        (root / "recordings").rename(tmp_path / f"elsewhere-{root.name}")
    lost = f"{settings.directory}/recordings/.* is gone, and the database names it; is --blobs right"
    with pytest.raises(StorageError, match=lost):
        back_up(settings, backup)
    lost = f"{backup}/recordings/.* is gone, and the database names it; restore another backup$"
    with pytest.raises(StorageError, match=lost):
        restore(backup, Settings(tmp_path / "restored"))


def test_backups_at_the_same_time_wait_for_each_other(tmp_path: Path) -> None:
    settings, backup = Settings(tmp_path / "served"), tmp_path / "backup"
    with signed_in(settings) as admin:
        fill(admin)
        before = contents(admin)
        with ThreadPoolExecutor(4) as pool:
            told = list(pool.map(lambda _: back_up(settings, backup), range(4)))
    assert sorted(each.copied for each in told) == [0, 0, 0, 3]
    with signed_in(Settings(backup)) as admin:
        assert contents(admin) == before


def test_what_a_killed_restore_has_left_is_for_the_server_to_delete(tmp_path: Path) -> None:
    settings, backup, there = Settings(tmp_path / "served"), tmp_path / "backup", Settings(tmp_path / "there")
    with signed_in(settings) as admin:
        fill(admin)
        back_up(settings, backup)
    kill = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from tupli_mcap.server.backup import restore\n"
        "from tupli_mcap.server.settings import Settings\n"
        "os.link = lambda *_, **__: os.kill(os.getpid(), 9)\n"
        "restore(Path(sys.argv[1]), Settings(Path(sys.argv[2])))"
    )
    words = [sys.executable, "-c", kill, str(backup), str(there.directory)]
    assert subprocess.run(words, check=False).returncode == -9
    left = [path.name for path in there.own.iterdir() if not path.name.startswith("server.sqlite")]
    assert left == ["making"] and list(there.making.iterdir())
    assert restore(backup, there).users == 1


def test_files_that_a_failed_restore_has_copied_are_not_given_to_the_admin(tmp_path: Path) -> None:
    settings, backup, there = Settings(tmp_path / "served"), tmp_path / "backup", Settings(tmp_path / "there")
    with signed_in(settings) as admin:
        benchmark = admin.store_benchmark(query()).id
        names = sorted(admin.record_episodes([episode(benchmark)])[0].recording for _ in range(2))
        back_up(settings, backup)
    damaged = backup / names[-1]
    damaged.write_bytes(b"x" * damaged.stat().st_size)
    with pytest.raises(FormatError, match="is damaged"):
        restore(backup, there)
    assert (there.directory / names[0]).exists()
    with signed_in(there) as admin:
        assert admin.list_episodes() == []


def test_what_is_no_backup_is_left_alone(tmp_path: Path) -> None:
    settings = Settings(tmp_path / "served")
    with pytest.raises(StorageError, match="expected the data of a server in"):
        back_up(settings, tmp_path / "backup")
    with signed_in(settings) as admin:
        fill(admin)
        (tmp_path / "thesis").mkdir()
        (tmp_path / "thesis" / "thesis.tex").touch()
        with pytest.raises(StorageError, match="expected a backup or nothing in"):
            back_up(settings, tmp_path / "thesis")
        with pytest.raises(StorageError, match="expected the backup of a server in"):
            restore(tmp_path / "thesis", Settings(tmp_path / "new"))
        thesis = tmp_path / "thesis" / "thesis.tex"
        for place in (thesis, thesis / "below"):
            with pytest.raises(StorageError, match="cannot back up into '.*thesis.*': Not a directory"):
                back_up(settings, place)
        back_up(settings, tmp_path / "good")
        with pytest.raises(StorageError, match=r"cannot restore into '.*thesis\.tex': Not a directory"):
            restore(tmp_path / "good", Settings(thesis))
        damaged = next((tmp_path / "served" / "recordings").rglob("*.mcap"))
        data = bytearray(damaged.read_bytes())
        data[100] ^= 1
        damaged.write_bytes(data)
        with pytest.raises(FormatError, match=r"recordings/.*mcap is damaged: expected the SHA-256"):
            back_up(settings, tmp_path / "backup")
        data[100] ^= 1
        damaged.write_bytes(data)
        assert back_up(settings, tmp_path / "backup").recordings  # goes on in what the failed one has left


def test_the_data_of_a_server_is_neither_replaced_nor_taken_for_a_backup(tmp_path: Path) -> None:
    settings, other = Settings(tmp_path / "served"), Settings(tmp_path / "other")
    with signed_in(settings) as admin, signed_in(other) as other_admin:
        fill(admin)
        other_admin.create_group(Group(name="kept"))
        for inside in (settings.directory, settings.directory / "backup"):
            with pytest.raises(StorageError, match="expected a directory outside of"):
                back_up(settings, inside)
        with pytest.raises(StorageError, match="found the data of a server, or a backup that was served"):
            back_up(settings, other.directory)
        with pytest.raises(StorageError, match="found the data of a server that runs or was killed"):
            restore(settings.directory, Settings(tmp_path / "new"))
    with signed_in(other) as other_admin:
        assert [group.name for group in other_admin.list_groups()] == ["kept"]
