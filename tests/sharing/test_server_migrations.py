"""The tables of a server are brought up to date from the first ones on, with all that is in them."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from first_tables import fill_first
from postgres import Cluster
from sqlalchemy import Engine, create_engine, inspect, text

from tupli_mcap.errors import StorageError
from tupli_mcap.schema import F
from tupli_mcap.server import migrations, tables
from tupli_mcap.server.database import Database
from tupli_mcap.server.people import accounts
from tupli_mcap.storage.catalog import queries, tables as catalog
from tupli_mcap.storage.catalog.database import prepared_sqlite
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import RecordingStamp


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """An empty database."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'server.sqlite'}"
        return
    postgres: Cluster = request.getfixturevalue("postgres")
    with postgres.database(empty=True) as url:
        yield url


def test_rows_of_the_first_version_stay(url: str) -> None:
    fill_first(url)
    for _ in range(2):
        database = Database(url)
        with database.reading() as connection:
            first, second = queries.find_episodes(connection, F("metadata.score") == 1)
            assert first.published_in == ["admin", "lab"]
            assert second.metadata["name"] == "a" * 600
            assert queries.count_episodes(connection, F("metadata.name") >= "a" * 600) == 1
            assert queries.count_episodes(connection, F("metadata.name") > "a" * 600) == 0
            assert queries.count_episodes(connection, F("metadata.none") != 1) == 1
            assert accounts.verify_password(connection, "ann", "ann-password")
            plain = connection.execute(text("SELECT episode, readable FROM episode ORDER BY id")).all()
            assert [tuple(row) for row in plain][:2] == [(0, True), (1, True)]
        with database.writing() as connection:
            row = EpisodeRow(0, 0, 3, "terminal", 1.0, 2**70, 0, "admin", '["admin"]', "{}")
            stamp = RecordingStamp(1, 2, 3)
            queries.put_recording(connection, "x.mcap", Entry(stamp, "u", "", [row]))
            assert queries.count_episodes(connection, None) == 3
        database.close()


def test_who_was_the_first_to_store_a_recording_is_known(url: str) -> None:
    fill_first(url)
    engine = create_engine(url)
    with engine.begin() as connection:
        (uuid,) = connection.execute(text("SELECT uuid FROM file")).scalars()
        for number, owner, of in ((30, "ann", uuid), (20, "eve", uuid), (40, "eve", "0"), (10, "bob", "0")):
            name = f"{owner}-{of}.mcap"
            told = {"path": name, "owner": owner, "uuid": of, "number": number}
            columns = "path, created_by, uuid, place, digest, size, episodes, deleted"
            row = text(f"INSERT INTO file ({columns}) VALUES (:path, :owner, :uuid, :path, '', 1, 1, '[]')")
            connection.execute(row, told)
            columns = 'number, time, "user", action, target'
            row = text(f"INSERT INTO audit ({columns}) VALUES (:number, 0, :owner, 'store_recording', :path)")
            connection.execute(row, told)
    engine.dispose()
    database = Database(url)
    with database.reading() as connection:
        for table in ("claim", "file"):
            rows = connection.execute(text(f"SELECT uuid, created_by FROM {table} ORDER BY uuid, rank")).all()
            assert [tuple(row) for row in rows if row.uuid == "0"] == [("0", "bob"), ("0", "eve")]
            assert [row.created_by for row in rows if row.uuid == uuid] == ["admin", "eve", "ann"]
    database.close()


def test_the_last_revision_makes_the_tables_that_the_code_says(url: str) -> None:
    database = Database(url)
    with database.reading() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": url.startswith("postgresql")})
        different = compare_metadata(context, [tables.METADATA, catalog.METADATA])
    database.close()
    assert different == []


def test_declared_keys_get_the_flags_of_episodes(url: str) -> None:
    fill_first(url)
    engine = create_engine(url)
    with engine.begin() as connection:
        migrations.upgrade(connection, "6")
        told = json.dumps({"score": 1, "good": True, "bad": {"x": False}, "all": [True]})
        connection.execute(text("UPDATE episode SET metadata = :told WHERE episode = 0"), {"told": told})
        number = connection.execute(text("SELECT count(*) FROM declared")).scalar_one()
        for n, key in enumerate(("metadata.good", "metadata.bad.x", "metadata.all")):
            row = {"key": key, "number": number + n}
            connection.execute(text("INSERT INTO declared (key, number) VALUES (:key, :number)"), row)
    engine.dispose()
    database = Database(url)
    with database.reading() as connection:
        found = connection.execute(
            text("SELECT flags FROM value WHERE episode_id = (SELECT min(id) FROM episode WHERE episode = 0)")
        )
        assert set(found.scalars()) == {0b111001 << 2 * number}
    database.close()


def test_several_start_at_once(url: str) -> None:
    fill_first(url)
    opened: list[Database] = []
    threads = [threading.Thread(target=lambda: opened.append(Database(url))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 4
    for database in opened:
        with database.reading() as connection:
            assert queries.count_episodes(connection, None) == 2
        database.close()


def test_several_set_the_journal_at_once(tmp_path: Path) -> None:
    path = tmp_path / "server.sqlite"
    with ThreadPoolExecutor(8) as pool:
        for _ in range(150):
            path.unlink(missing_ok=True)
            with contextlib.closing(sqlite3.connect(path)) as connection:
                connection.execute("CREATE TABLE first (number)")
            engines = [
                prepared_sqlite(create_engine(f"sqlite:///{path}"), "journal_mode = WAL") for _ in range(8)
            ]
            start = threading.Barrier(8)

            def connect(engine: Engine, start: threading.Barrier = start) -> None:
                start.wait()
                engine.connect().close()

            list(pool.map(connect, engines))
            for engine in engines:
                engine.dispose()


def test_what_fails_in_the_middle_changes_nothing(url: str) -> None:
    fill_first(url)
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(
            text("ALTER TABLE episode ADD COLUMN success BIGINT")
        )  # so that one more cannot be added
    with pytest.raises(StorageError, match="success"):
        Database(url)
    with engine.begin() as connection:
        assert not inspect(connection).has_table("alembic_version")
        connection.execute(text("ALTER TABLE episode DROP COLUMN success"))
    engine.dispose()
    Database(url).close()


def test_a_later_version_is_refused(url: str) -> None:
    Database(url).close()
    engine = create_engine(url)
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '999'"))
    engine.dispose()
    with pytest.raises(StorageError, match=r"of a later version \(revision '999'\) .* update tupli-mcap"):
        Database(url)
