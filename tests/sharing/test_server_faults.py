"""Servers, databases and buckets that are killed: a few rounds of tools/server_faults.py, and that it can fail."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

import buckets
import pytest
import server_faults
from acknowledged import Thing, User
from faults import Faults
from persons import Person
from serving import serving

from tupli_mcap.errors import StorageError
from tupli_mcap.server.database import pending
from tupli_mcap.server.library import Library
from tupli_mcap.server.settings import Settings
from tupli_mcap.wrappers.rollout import record_rollouts


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of boto3
@pytest.mark.sampled(0, keep=["postgresql-2"])
@pytest.mark.parametrize(("engine", "kills"), [("sqlite", 2), ("postgresql", 2)])
def test_nothing_acknowledged_is_lost_and_nothing_half_there(
    engine: str, kills: int, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if engine == "postgresql":
        request.getfixturevalue("postgres")  # skips where it is not installed
    try:
        rounds = list(server_faults.campaign(engine, kills, 7, tmp_path))
    except buckets.NoStoreError as err:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(err))
    assert [wrong for _, _, wrong in rounds if wrong] == []


def test_what_is_lost_half_there_or_twice_is_found(tmp_path: Path) -> None:
    """The user's notes say something else than what the server has."""
    with serving(Settings(tmp_path / "served")) as url:
        Person(url, "admin").ask("POST", "/v1/users", {"username": "ann", "password": "ann's password"})
        ann = User(url, "ann", tmp_path, "1")
        made = [ann._made() for _ in range(12)]
        for thing in made:
            ann._store(thing)
        assert list(ann.compare(url, "admin")) == []
        recordings = [thing for thing in made if thing.count]
        one, two, three = recordings[:3]
        ids = [e["id"] for e in ann.person.ask("POST", "/v1/episodes/list", {})["items"]]
        one.count += 1
        two.shown = {True}
        three.here = {False}
        ann.things.append(Thing(b"never sent", 0))
        ann.things[-1].here = {True}
        ann._recorded.append("lost")
        found = " ".join(ann.compare(url, "admin"))
        assert f"{one.count - 1} of {one.count} episodes are there" in found
        assert "expected to be published: {True}, found 0" in found
        assert "expected to be there: {False}, found True" in found
        assert "expected to be there: {True}, found False" in found
        assert "episode lost is lost" in found and ids


# --- what it has found ---


def test_what_a_killed_server_was_making_is_deleted_at_a_later_start(tmp_path: Path) -> None:
    """Artifacts and episodes on their way; not before a day has gone, for another process may be at work."""
    settings = Settings(tmp_path / "served")
    Library(settings).close()
    (settings.making / "left").mkdir()
    (settings.making / "left" / "new").write_bytes(b"half")
    Library(settings).close()
    assert (settings.making / "left").exists()
    Library(Settings(tmp_path / "served", pending_seconds=0)).close()
    assert list(settings.making.iterdir()) == []


def test_a_server_that_has_its_key_starts_on_a_full_disk(tmp_path: Path) -> None:
    settings = Settings(tmp_path / "served")
    Library(settings).close()
    key = settings.secret.read_bytes()
    with Faults(settings.own, 0, errno.ENOSPC, lasting=True, kinds=frozenset({"create"}))():
        Library(settings).close()  # raises if it makes a file
    assert settings.secret.read_bytes() == key


def test_what_cannot_be_deleted_keeps_nobody_waiting(tmp_path: Path) -> None:
    """A request has done what it was sent for, a server starts, and cleans up everything else."""
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=30, seed=1)
    settings = Settings(tmp_path / "served", pending_seconds=0)
    with serving(settings) as url:
        admin = Person(url, "admin")
        stored = settings.directory / admin.send((tmp_path / "run.mcap").read_bytes())
        stored.unlink()
        stored.mkdir()  # no call for a file deletes a directory
        assert admin.ask("POST", "/v1/episodes/delete", {"filter": "episode >= 0"})["episodes"] > 0
    (settings.own / "uploads" / "left").mkdir()
    (settings.making / "left").mkdir()
    with contextlib.closing(Library(settings)) as library, library.database.reading() as connection:
        assert not list(settings.making.iterdir())
        assert pending(connection, seconds=0) == [str(stored.relative_to(settings.directory))]
    stored.rmdir()
    with contextlib.closing(Library(settings)) as library, library.database.reading() as connection:
        assert pending(connection, seconds=0) == []


def test_a_directory_that_is_gone_is_said_at_a_clean_up(tmp_path: Path) -> None:
    """By an error of ours, as any other would end the clean-ups of the server for ever."""
    settings = Settings(tmp_path / "served")
    with contextlib.closing(Library(settings)) as library:
        for folder in (settings.making, settings.own / "uploads"):
            folder.rmdir()
            with pytest.raises(StorageError, match="cannot clean up .* No such file or directory"):
                library.look_after()
            folder.mkdir()
        library.look_after()
