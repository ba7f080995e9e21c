"""What one user, one request or one connection may take of a server."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
from persons import Person
from postgres import Cluster
from serving import ENGINES, PASSWORD, serving, settings_of
from sqlalchemy import func, select, update
from stored_items import episode, query

from tupli_mcap.errors import FilterError, NotFoundError, StorageError
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.schema import (
    ArtifactMetadata,
    BenchmarkMetadata,
    BenchmarkQuery,
    F,
    FilterNOT,
    FilterOR,
    Group,
)
from tupli_mcap.server.database import Database, TooLongError, UnavailableError
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts, limits
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import FAILURE, UPLOAD
from tupli_mcap.server.uploads import GoneError, Upload
from tupli_mcap.storage import TupliAPIClient
from tupli_mcap.storage.api.upload import send_file
from tupli_mcap.storage.catalog import queries
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.wrappers.rollout import record_rollouts


@contextlib.contextmanager
def server_with(directory: Path, **limits: Any) -> Iterator[TupliAPIClient]:
    """The admin of a server."""
    with serving(Settings(directory, **limits)) as url, TupliAPIClient(url) as admin:
        admin.login("admin", PASSWORD)
        yield admin


def token_of(user: TupliAPIClient) -> dict[str, str]:
    return {"Authorization": f"Bearer {user._session._token()}"}


def begin(user: TupliAPIClient, data: bytes) -> httpx.Response:
    digest = base64.b64encode(hashlib.sha256(data).hexdigest().encode()).decode()
    headers = {"Upload-Length": str(len(data)), "Upload-Metadata": f"sha256 {digest}", **token_of(user)}
    return httpx.post(f"{user.url}/v1/uploads", headers=headers)


@pytest.fixture
def another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Makes users, each on a machine of their own."""
    with contextlib.ExitStack() as stack:

        def made(admin: TupliAPIClient, name: str) -> TupliAPIClient:
            admin.signup(name, "password")
            monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / name))
            user = stack.enter_context(TupliAPIClient(admin.url))
            user.login(name, "password")
            return user

        yield made


# --- requests ---


def test_bodies_are_of_a_size_that_is_said_before(tmp_path: Path) -> None:
    with server_with(tmp_path / "served", max_message=1000, max_body=5000) as admin:
        headers = token_of(admin)
        for path, size in (("/v1/episodes/list", 1001), ("/v1/artifacts", 5001), ("/v1/tokens", 2000)):
            refused = httpx.post(admin.url + path, content=b"x" * size, headers=headers)
            assert refused.status_code == 413, path
            assert "expected a body of at most" in refused.json()["detail"]
        unsaid = httpx.post(f"{admin.url}/v1/episodes/list", content=iter([b"{}"]), headers=headers)
        assert unsaid.status_code == 413
        assert admin.store_artifact(b"x" * 5000, ArtifactMetadata(name="x")).id


def test_a_stranger_sends_no_long_body(tmp_path: Path) -> None:
    """It would be parsed before anybody looks who has sent it."""
    deep = b'{"hash": "h", "serialized": "x", "metadata": {"extra": [' + b"[]," * 1000 + b"[]]}}"
    with server_with(tmp_path / "served", max_message=1000, guests=True) as admin:
        for path in (
            "/v1/benchmarks",
            "/v1/artifacts",
            "/benchmarks/create",
            "/artifacts/upload",
            "/episodes/record",
        ):
            for headers in ({}, {"Authorization": "Bearer forged"}, {"Authorization": "Bearer"}):
                headers["Content-Type"] = "application/json"
                refused = httpx.post(admin.url + path, content=deep, headers=headers)
                assert refused.status_code == 401, path
                assert "expected at most 1000 bytes of somebody who is not signed in" in refused.text
        known = httpx.post(f"{admin.url}/v1/benchmarks", content=deep, headers=token_of(admin))
        assert known.status_code == 400


def test_json_has_a_limit_of_marks(tmp_path: Path) -> None:
    """Short lists within lists take a hundred times the memory of their text."""
    kinds: list[list[str]] = [[], [""], ["application/json"], ["Application/Problem+JSON"]]
    kinds += [["application/json", "text/plain"], ["text/plain", "application/json"]]
    deep = b'{"metadata": [' + b"[]," * 1000 + b"[]]}"
    with server_with(tmp_path / "served", max_marks=1000) as admin:
        for path in ("/v1/benchmarks", "/benchmarks/create", "/episodes/record", "/v1/episodes/list"):
            for kind in kinds:
                headers = [*token_of(admin).items(), *(("Content-Type", one) for one in kind)]
                refused = httpx.post(admin.url + path, content=deep, headers=headers)
                assert refused.status_code == 413, (path, kind, refused.text)
                assert "expected JSON with at most 1000 commas" in refused.json()["detail"]
        assert admin.store_artifact(b"[" * 5000, ArtifactMetadata(name="brackets")).id


@pytest.mark.parametrize(
    ("filter", "message"),
    [
        ({"type": "IN", "key": "steps", "value": list(range(20_001))}, "at most 20000 values, found more"),
        (
            {"type": "OR", "filters": [{"type": "EQ", "key": "steps", "value": 1}] * 20_001},
            "at most 20000 values",
        ),
        ({"type": "OR", "filters": [{}] * 1_000_000}, "at most 20000 values"),
        ({"type": "AND", "filters": [{"filters": [3] * 15_000}] * 2}, "at most 20000 values"),
        ({"type": "EQ", "key": "steps"}, "needs a key and a value"),
        (3, "filter"),
        (f"steps in [{'1,' * 10_000}]", "text of at most 20000 characters, found 200"),
        ("steps in [1", "needs ',' at character 11, found the end"),
        ("not " * 33 + "seed = 1", "nest at most 32 deep"),
    ],
)
def test_filters_that_cost_too_much_are_refused(tmp_path: Path, filter: Any, message: str) -> None:
    with server_with(tmp_path / "served") as admin:
        for path in ("/v1/episodes/list", "/v1/episodes/count", "/v1/episodes/delete", "/v1/benchmarks/list"):
            refused = httpx.post(
                admin.url + path, json={"filter": filter}, headers=token_of(admin), timeout=60
            )
            assert refused.status_code == 400, path
            assert message in refused.json()["detail"], path


def nested(depth: int, kind: str) -> str:
    """The JSON of a comparison in so many combinations."""
    opening, closing = f'{{"type": "{kind}", "filters": [', "]}"
    return opening * depth + '{"type": "EQ", "key": "id", "value": "x"}' + closing * depth


def test_filters_that_are_too_deep_are_refused(tmp_path: Path) -> None:
    asked = ("episodes/list", "episodes/count", "artifacts/list", "benchmarks/list", "query", "query/tickets")
    with server_with(tmp_path / "served", guests=True) as admin:
        headers = {"Content-Type": "application/json"}
        for path, kind in itertools.product(asked, ("AND", "OR", "NOT")):
            for depth in (33, 150, 160, 500, 5000):
                body = f'{{"filter": {nested(depth, kind)}}}'
                refused = httpx.post(f"{admin.url}/v1/{path}", content=body, headers=headers)
                assert refused.status_code == 400, (path, kind, depth)
                assert "nest at most 32 deep" in refused.text or depth > 160, refused.text
        body = '{"filter": ' + "[" * 100_000
        refused = httpx.post(f"{admin.url}/v1/episodes/list", content=body, headers=headers)
        assert refused.status_code == 400, refused.text[:200]
        body = f'{{"filter": {nested(32, "AND")}}}'
        assert httpx.post(f"{admin.url}/v1/episodes/list", content=body, headers=headers).status_code == 200


@pytest.mark.parametrize("of", ["sqlite", "postgresql"])
def test_questions_that_take_too_long_are_given_up(of: str, tmp_path: Path, request: Any) -> None:
    with contextlib.ExitStack() as stack:
        url = f"sqlite:///{tmp_path / 'server.sqlite'}"
        if of == "postgresql":
            postgres: Cluster = request.getfixturevalue("postgres")
            url = stack.enter_context(postgres.database())
        rows = [
            EpisodeRow(i, 0, i, "terminal", 1.0, None, 0, "me", '["me"]', '{"x": 1}') for i in range(50_000)
        ]
        unlikely = [F("metadata.x") == i for i in range(10, 510)]  # which takes seconds
        with contextlib.closing(Database(url, 0.5)) as database:
            with database.writing() as connection:  # may take longer
                queries.put_recording(connection, "a.mcap", Entry(RecordingStamp(1, 2, 3), "u", "", rows))
            for asked in (F("metadata.x") > 5, F("metadata.x") != 5, FilterNOT(filters=[F("steps") < 0])):
                with pytest.raises((TooLongError, FilterError), match="takes too long; narrow the filter"):
                    with database.reading() as connection:
                        list(queries.find_episodes(connection, FilterOR(filters=[*unlikely, asked])))
        with contextlib.closing(Database(url)) as database, database.reading() as connection:
            assert queries.count_episodes(connection, F("metadata.x") != 5) == 50_000


@pytest.mark.parametrize(
    ("method", "path", "told"),
    [
        ("POST", "/episodes/record", {"benchmark_id": "x", "metadata": {}, "tuples": [{}] * 1000}),
        ("POST", "/access/groups/add-members", {"group_name": "x", "members": [{}] * 1000}),
        (
            "POST",
            "/access/groups/add-members",
            {"group_name": "x", "members": [{"user": "a", "roles": [1] * 1000}]},
        ),
        ("POST", "/access/roles/create", {"role": "x", "rights": ["x"] * 1000}),
    ],
)
def test_a_body_of_many_defects_is_refused_at_the_first_one(
    tmp_path: Path, method: str, path: str, told: Any
) -> None:
    """A list of all of them would fill the memory."""
    with server_with(tmp_path / "served") as admin:
        refused = httpx.request(method, admin.url + path, json=told, headers=token_of(admin))
        assert refused.status_code == 422
        assert len(refused.json()["detail"]) <= 3  # of one item


@pytest.mark.parametrize(
    ("body", "media", "why"),
    [
        (
            b'{"limit": 2}',
            "application/x-www-form-urlencoded",
            "and Content-Type: application/json, found appl",
        ),
        (b"", None, "and Content-Type: application/json, found none"),
        (b'{"limit": ', "application/json", "found a mistake at character 10: Expecting value"),
    ],
)
def test_a_body_that_is_no_json_is_told_why(tmp_path: Path, body: bytes, media: str | None, why: str) -> None:
    with server_with(tmp_path / "served") as admin:
        headers = {**token_of(admin), **({"Content-Type": media} if media else {})}
        answer = httpx.post(f"{admin.url}/v1/episodes/list", content=body, headers=headers)
        assert answer.status_code == 400
        assert answer.json()["detail"].startswith(f"expected JSON as the body, {why}")


def test_a_probe_may_ask_for_the_head_only(tmp_path: Path) -> None:
    with server_with(tmp_path / "served") as admin:
        for path in ("/health", "/ready"):
            answer = httpx.head(admin.url + path)
            assert (answer.status_code, answer.content) == (200, b"")


def test_lists_come_in_pages(tmp_path: Path) -> None:
    with server_with(tmp_path / "served", max_page=3) as admin:
        benchmarks = [admin.store_benchmark(query(name=f"b{i}")).id for i in range(7)]
        for i in range(4):
            admin.store_artifact(b"%d" % i, ArtifactMetadata(name=f"a{i}"))
        admin.record_episodes([episode(benchmarks[0]) for _ in range(4)])
        assert [header.id for header in admin.list_benchmarks()] == benchmarks
        assert [item.name for item in admin.list_artifacts()] == [f"a{i}" for i in range(4)]
        assert len(admin.list_episodes()) == 4

        def page(told: dict[str, Any]) -> Any:
            answer = httpx.post(f"{admin.url}/v1/benchmarks/list", json=told, headers=token_of(admin)).json()
            return [benchmarks.index(item["id"]) for item in answer["items"]], answer["next"]

        first, cursor = page({})
        assert first == [0, 1, 2]
        second, cursor = page({"cursor": cursor, "limit": 2})
        assert second == [3, 4]
        assert page({"cursor": cursor, "limit": 1000}) == ([5, 6], None)
        assert page({"offset": 2, "limit": 0}) == ([], None)


def test_a_page_lacks_nothing_where_items_are_deleted_meanwhile(tmp_path: Path) -> None:
    with server_with(tmp_path / "served") as admin:
        ids = [admin.store_artifact(b"%d" % i, ArtifactMetadata(name=f"a{i}")).id for i in range(6)]

        def page(cursor: str | None) -> Any:
            told = {"limit": 2, "cursor": cursor}
            url = f"{admin.url}/v1/artifacts/list"
            answer = httpx.post(url, json=told, headers=token_of(admin)).json()
            return [ids.index(item["id"]) for item in answer["items"]], answer["next"]

        first, cursor = page(None)
        admin.delete_artifact(ids[0])
        admin.delete_artifact(ids[1])  # the one that the cursor names
        second, cursor = page(cursor)
        assert (first, second, page(cursor)) == ([0, 1], [2, 3], ([4, 5], None))


def test_a_page_lacks_nothing_where_a_recording_replaces_its_parts(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "whole.mcap", episodes=6)
    with Recording(tmp_path / "whole.mcap") as recording, server_with(tmp_path / "served") as admin:
        for i, numbers in enumerate(([0, 1], [2, 3, 4])):
            rewrite_recording(recording, tmp_path / f"part{i}.mcap", episodes=numbers)
            admin.push(tmp_path / f"part{i}.mcap")

        def page(cursor: str | None) -> Any:
            told = {"limit": 3, "cursor": cursor}
            url = f"{admin.url}/v1/episodes/list"
            answer = httpx.post(url, json=told, headers=token_of(admin)).json()
            return [item["episode"] for item in answer["items"]], answer["next"]

        first, cursor = page(None)
        admin.push(tmp_path / "whole.mcap")
        assert (first, page(cursor)[0]) == ([0, 1, 2], [3, 4, 5])


def test_a_sorted_list_comes_in_pages(tmp_path: Path, another: Any) -> None:
    with server_with(tmp_path / "served", max_page=2) as admin:
        benchmark = admin.store_benchmark(query()).id
        made = admin.record_episodes([episode(benchmark, score=score) for score in (3.0, 1.0, 4.0, 1.0, 5.0)])
        places = [header.id for header in made]

        def page(cursor: str | None, user: TupliAPIClient = admin) -> httpx.Response:
            told = {"cursor": cursor, "sort": "-return"}
            return httpx.post(f"{admin.url}/v1/episodes/list", json=told, headers=token_of(user))

        def listed(**asked: Any) -> list[int]:
            return [places.index(header.id) for header in admin.list_episodes(**asked)]

        assert listed(sort="-return") == [4, 2, 0, 1, 3]
        assert listed(sort="return", limit=3) == [1, 3, 0]
        answer = page(None).json()
        assert [places.index(item["id"]) for item in answer["items"]] == [4, 2]
        assert [places.index(item["id"]) for item in page(answer["next"]).json()["items"]] == [0, 1]
        admin.publish_episode(places[1])
        eve = another(admin, "eve")
        assert [header.id for header in eve.list_episodes(sort="-return")] == [places[1]]
        refused = page(answer["next"], eve)  # which page comes after it would tell its return
        assert (refused.status_code, refused.json()["error"]) == (404, "NotFoundError")
        admin.delete_episode(places[2])
        assert page(answer["next"]).status_code == 404
        assert listed(sort="-return") == [4, 0, 1, 3]


@pytest.mark.parametrize("with_tuples", [False, True])
def test_a_list_of_pytupli_s_is_made_while_it_is_sent(tmp_path: Path, with_tuples: bool) -> None:
    """It has no pages, and a server holds one page of it in memory."""
    with server_with(tmp_path / "served", max_page=2) as admin:
        benchmark = admin.store_benchmark(query()).id
        path, told = f"{admin.url}/episodes/list", {"include_tuples": with_tuples}
        assert httpx.post(path, json=told, headers=token_of(admin)).text == "[]"
        for count in (3, 1, 2):
            admin.record_episodes([episode(benchmark) for _ in range(count)])
            answer = httpx.post(path, json=told, headers=token_of(admin))
            assert answer.headers["Transfer-Encoding"] == "chunked"
            listed = answer.json()
            assert [each["id"] for each in listed] == [header.id for header in admin.list_episodes()]
            assert {len(each.get("tuples", "")) for each in listed} == {3 if with_tuples else 0}
        none = {"type": "GT", "key": "steps", "value": 100, **told}
        assert httpx.post(path, json=none, headers=token_of(admin)).text == "[]"
        refused = httpx.post(path, json={**none, "key": "unknown"}, headers=token_of(admin))
        assert refused.status_code == 400


# --- the disk ---


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 4 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = shutil.which("mount")
    options = ["-t", "tmpfs", "-o", "size=4m", "none", place]
    if mount is None or subprocess.run([mount, *options], capture_output=True).returncode:
        pytest.skip("mounting is not allowed here, so there is no small disk")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def test_an_upload_that_fills_the_disk_is_deleted(small_disk: Path, tmp_path: Path) -> None:
    """Else it would keep the disk full for everybody, and count as stored, until it expires."""
    large = tmp_path / "large.mcap"
    large.write_bytes(os.urandom(8 << 20))
    with server_with(small_disk) as admin:
        benchmark = admin.store_benchmark(query()).id
        with pytest.raises(
            StorageError, match=r"^the server's disk is full; send it again when there is room \("
        ):
            send_file(admin._session, large)
        assert not [*(small_disk / "server/uploads").iterdir()]
        assert admin._session.ask("GET", "/v1/me")["used"] < 1 << 20
        admin.record_episodes([episode(benchmark)])
        assert len(admin.list_episodes()) == 1


def test_files_of_the_server_are_not_named_to_clients(tmp_path: Path) -> None:
    with server_with(tmp_path) as admin:
        (tmp_path / "artifacts").write_text("no directory")
        with pytest.raises(StorageError, match="the server cannot reach what it keeps things in") as failed:
            admin.store_artifact(b"weights", ArtifactMetadata(name="weights"))
        assert str(tmp_path) not in str(failed.value)


def test_a_full_disk_is_named_and_keeps_nobody_from_reading(small_disk: Path) -> None:
    ballast = small_disk / "ballast"
    with server_with(small_disk) as admin:
        admin.record_episodes([episode(admin.store_benchmark(query()).id)])
        with pytest.raises(OSError, match="No space left"), ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        with pytest.raises(
            StorageError, match=r"^the server's disk is full; try again when there is room \("
        ):
            for i in range(1000):
                admin.create_group(Group(name=f"group{i}"))
        assert len(admin.list_episodes()) == 1
        ballast.unlink()
        admin.create_group(Group(name="later"))


# --- users ---


def test_a_user_keeps_so_many_bytes(tmp_path: Path, another: Any) -> None:
    with server_with(tmp_path / "served", quota=20_000) as admin:
        ann = another(admin, "ann")
        ann.store_artifact(b"x" * 15_000, ArtifactMetadata(name="x"))
        ann.store_artifact(b"x" * 15_000, ArtifactMetadata(name="x"))  # nothing new
        with pytest.raises(StorageError, match="ann may store 20,000 bytes"):  # of 2 bytes for each letter
            told = BenchmarkQuery(hash="h", serialized="ä" * 3000, metadata=BenchmarkMetadata(name="b"))
            ann.store_benchmark(told)
        stored = ann._session.ask("GET", "/v1/me")["used"]
        assert 15_000 < stored < 15_500  # with its header
        with pytest.raises(
            StorageError,
            match=r"ann may store 20,000 bytes, and would use 24,\d{3} with this; delete .* recordings, or",
        ):
            ann.store_artifact(b"y" * 9000, ArtifactMetadata(name="y"))
        with pytest.raises(StorageError, match="ann may store 20,000 bytes"):
            ann.store_artifact(b"y", ArtifactMetadata(name="y", description="d" * 5000))
        rest = 20_000 - stored
        assert begin(ann, b"z" * rest).status_code == 201
        full = begin(ann, b"z" * (rest + 1))
        assert (full.status_code, full.json()["error"]) == (507, "StorageError")
        assert f"may store 20,000 bytes, and would use {20_001 + rest:,} with this" in full.json()["detail"]
        assert begin(ann, b"z" * rest).status_code == 201  # the same one
        assert (ann.whoami().used, ann.whoami().quota) == (20_000, 20_000)

        with pytest.raises(StorageError, match="Insufficient permissions"):
            ann.set_quota("ann", 10**9)
        with pytest.raises(StorageError, match="bytes.*integer"):
            admin._session.ask("PUT", "/v1/users/ann/quota", {"bytes": True})
        admin.set_quota("ann", 60_000)
        benchmark = ann.store_benchmark(query()).id
        ann.record_episodes([episode(benchmark)])
        assert ann.whoami().used > 20_000
        with pytest.raises(StorageError, match="may store 60,000 bytes, and would use"):
            ann.store_artifact(b"y" * 60_000, ArtifactMetadata(name="y"))
        ann.delete_episodes(F("steps") > 0)
        ann.delete_benchmark(benchmark)
        assert ann.whoami().used == 20_000
        admin.set_quota("ann", None)
        assert ann.whoami().quota == 20_000
        with pytest.raises(NotFoundError, match="User does not exist"):
            admin.set_quota("nobody", 1)


def test_a_user_begins_so_many_uploads(tmp_path: Path, another: Any) -> None:
    with server_with(tmp_path / "served", max_uploads=2) as admin:
        first = begin(admin, b"a")
        assert [begin(admin, data).status_code for data in (b"b", b"c", b"a")] == [201, 429, 201]
        assert begin(another(admin, "ann"), b"c").status_code == 201
        httpx.delete(admin.url + first.headers["Location"], headers=token_of(admin))
        assert begin(admin, b"c").status_code == 201


def test_what_a_deleted_user_kept_for_themselves_goes(tmp_path: Path, another: Any) -> None:
    with server_with(tmp_path / "served") as admin:
        ann = another(admin, "ann")
        artifacts = [ann.store_artifact(data, ArtifactMetadata(name="x")).id for data in (b"a", b"b")]
        benchmark = ann.store_benchmark(query(artifacts=(artifacts[0],))).id
        made = ann.record_episodes([episode(benchmark), episode(benchmark)])
        alone = ann.record_episodes([episode(benchmark, 5)])
        ann.publish_benchmark(benchmark)
        ann.publish_artifact(artifacts[0])
        ann.publish_episode(made[0].id)
        with pytest.raises(StorageError, match="Insufficient permissions"):
            another(admin, "eve").delete_user("ann")
        admin.delete_user("ann")
        assert [header.id for header in admin.list_benchmarks()] == [benchmark]
        assert [item.id for item in admin.list_artifacts()] == [artifacts[0]]
        assert [header.id for header in admin.list_episodes()] == [made[0].id]
        kept = [
            path.name for path in (tmp_path / "served").glob("*/**/*") if path.parent.parent.name != "server"
        ]
        assert artifacts[0] in kept and artifacts[1] not in kept
        assert made[0].recording.rpartition("/")[2] in kept
        assert alone[0].recording.rpartition("/")[2] not in kept


@pytest.mark.sampled(1)
@pytest.mark.parametrize("engine", ENGINES)
def test_who_asks_much_leaves_the_others_their_turn(
    engine: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Eve's requests wait for the writer, so that none is answered before ann's are."""
    with contextlib.ExitStack() as stack:
        settings = stack.enter_context(settings_of(engine, request, tmp_path / "served"))
        url = stack.enter_context(serving(settings))
        admin = Person(url, "admin")
        for name in ("ann", "eve"):
            admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
        ann, eve = Person(url, "ann"), Person(url, "eve")
        browser = stack.enter_context(httpx.Client(base_url=url, timeout=120))
        browser.post("/sign-in", data={"username": "eve", "password": "eve's password"})
        code = re.findall(r'name="code" value="(\w+)"', browser.get("/groups").text)[0]
        database = stack.enter_context(contextlib.closing(Database(settings.database_place)))
        pool = stack.enter_context(ThreadPoolExecutor(120))

        def create(number: int) -> httpx.Response:
            if number % 2:
                return browser.post("/groups", data={"name": f"g{number}", "code": code})
            return eve.call("POST", "/v1/groups", {"name": f"g{number}"})

        with database.writing():
            asked = [pool.submit(create, number) for number in range(120)]
            refused = [each.result() for each in itertools.islice(as_completed(asked), 16)]
            assert {each.status_code for each in refused} == {429}
            assert {each.headers.get("Retry-After", "1") for each in refused} == {"1"}
            assert ann.ask("GET", "/v1/me")["username"] == "ann"
            assert ann.ask("POST", "/v1/episodes/count", {}) == 0
            assert sum(each.done() for each in asked) == 16
        answers = [each.result().status_code for each in asked]
        assert (answers.count(429), answers.count(400)) == (16, 4)  # a user may create 100 groups
        assert set(answers) == {200, 303, 400, 429}


# --- connections ---


@pytest.fixture
def impatient(tmp_path: Path) -> Iterator[tuple[str, int]]:
    with serving(Settings(tmp_path / "served", head_seconds=0.5, stall_seconds=0.5)) as url:
        yield "127.0.0.1", urlsplit(url).port or 0


def ended(connection: socket.socket) -> bytes:
    """What a server has sent when it ends a connection."""
    connection.settimeout(60)
    found = bytearray()
    with contextlib.suppress(ConnectionResetError):
        while data := connection.recv(1 << 16):
            found += data
    return bytes(found)


@pytest.mark.parametrize(
    "sent",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: x\r\n",
        b"POST /v1/tokens HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{",
    ],
)
def test_who_does_not_finish_a_request_is_cut_off(impatient: tuple[str, int], sent: bytes) -> None:
    with socket.create_connection(impatient) as connection:
        connection.sendall(sent)
        assert ended(connection) == b""


def test_who_sends_a_head_bit_by_bit_is_cut_off(impatient: tuple[str, int]) -> None:
    with socket.create_connection(impatient) as connection:
        with pytest.raises(OSError, match="reset|pipe"):
            for _ in range(600):
                connection.sendall(b"X")
                time.sleep(0.1)


def test_who_does_not_take_the_answer_is_cut_off(tmp_path: Path) -> None:
    with server_with(tmp_path / "served", stall_seconds=0.5) as admin:
        uri = admin.store_artifact(b"\0" * (64 << 20), ArtifactMetadata(name="large")).id
        with socket.create_connection(("127.0.0.1", urlsplit(admin.url).port or 0)) as connection:
            head = "".join(f"{key}: {value}\r\n" for key, value in token_of(admin).items())
            connection.sendall(f"GET /v1/artifacts/{uri} HTTP/1.1\r\nHost: x\r\n{head}\r\n".encode())
            connection.recv(1000)
            metrics = httpx.get(f"{admin.url}/metrics", headers=token_of(admin))
            while "tupli_mcap_requests_running 2.0" in metrics.text:  # that one, and this question
                time.sleep(0.1)
                metrics = httpx.get(f"{admin.url}/metrics", headers=token_of(admin))
            assert len(ended(connection)) < 64 << 20


def test_the_unfinished_uploads_of_a_deleted_user_are_deleted(tmp_path: Path) -> None:
    library = Library(Settings(tmp_path / "served"))
    library.first_password()
    with library.database.writing() as connection:
        accounts.create_user(connection, "ann", "no hash")
        admin, ann = (accounts.caller_named(connection, name) for name in ("admin", "ann"))
        assert admin is not None and ann is not None
    for caller in (admin, ann):
        upload = library.begin_upload(caller, 5, hashlib.sha256(b"hello").hexdigest(), 0)
        assert isinstance(upload, Upload)
        with library.uploads.writing(upload) as incoming:
            incoming.write([b"hell"])
    assert len(list((tmp_path / "served/server/uploads").iterdir())) == 2
    library.delete_user(admin, "ann")
    library.look_after()
    (left,) = (tmp_path / "served/server/uploads").iterdir()
    with library.database.reading() as connection:
        assert library.uploads.find(connection, admin, left.name).offset == 4
    library.close()


@pytest.mark.parametrize("gone", ["user", "upload"])
def test_what_is_deleted_while_its_last_bytes_arrive_is_not_stored(gone: str, tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=30, seed=1)
    data = (tmp_path / "run.mcap").read_bytes()
    with contextlib.closing(Library(Settings(tmp_path / "served"))) as library:
        library.first_password()
        with library.database.writing() as connection:
            accounts.create_user(connection, "ann", "no hash")
            admin, ann = (accounts.caller_named(connection, name) for name in ("admin", "ann"))
        assert admin is not None and ann is not None
        upload = library.begin_upload(ann, len(data), hashlib.sha256(data).hexdigest(), 0)
        assert isinstance(upload, Upload)
        with library.uploads.writing(upload) as incoming:
            incoming.write([data])
            library.delete_user(admin, "ann") if gone == "user" else library.forget_upload(upload)
            with pytest.raises(GoneError, match="no such upload"):
                library.take_in(ann, incoming)
        with library.database.reading() as connection:
            assert queries.count_episodes(connection, None) == 0
    assert not list((tmp_path / "served").rglob("*.mcap"))


def test_an_upload_stays_if_the_database_fails_as_it_is_stored(tmp_path: Path) -> None:
    """Else its bytes would have to be sent again."""
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=30, seed=1)
    data = (tmp_path / "run.mcap").read_bytes()
    with contextlib.closing(Library(Settings(tmp_path / "served"))) as library:
        library.first_password()
        with library.database.writing() as connection:
            admin = accounts.caller_named(connection, "admin")
            fail = "CREATE TRIGGER fails BEFORE INSERT ON recording BEGIN INSERT INTO nowhere VALUES (1); END"
            connection.exec_driver_sql(fail)
        assert admin is not None
        upload = library.begin_upload(admin, len(data), hashlib.sha256(data).hexdigest(), 0)
        assert isinstance(upload, Upload)
        with library.uploads.writing(upload) as incoming:
            incoming.write([data])
            with pytest.raises(UnavailableError, match="nowhere"):
                library.take_in(admin, incoming)
        with library.database.writing() as connection:
            connection.exec_driver_sql("DROP TRIGGER fails")
        again = library.begin_upload(admin, len(data), upload.digest, 0)
        assert isinstance(again, Upload) and again.offset == len(data)
        with library.uploads.writing(again) as incoming:
            name = library.take_in(admin, incoming)
        assert library.begin_upload(admin, len(data), upload.digest, 0) == name
        assert not list(upload.path.parent.iterdir())


def test_uploads_that_nobody_goes_on_with_are_forgotten_after_a_week(tmp_path: Path) -> None:
    with contextlib.closing(Library(Settings(tmp_path / "served"))) as library:
        library.first_password()
        with library.database.reading() as connection:
            admin = accounts.caller_named(connection, "admin")
        assert admin is not None
        old, fresh, touched = (library.begin_upload(admin, 9, each * 64, 0) for each in "abc")
        long_ago = int(time.time()) - 8 * 24 * 3600
        assert isinstance(old, Upload) and isinstance(fresh, Upload) and isinstance(touched, Upload)
        for upload in (old, fresh, touched):
            upload.path.write_bytes(b"some")
        os.utime(old.path, (long_ago, long_ago))
        stray = old.path.with_name("of-nobody")
        stray.write_bytes(b"x")
        with library.database.writing() as connection:
            begun = UPLOAD.update().where(UPLOAD.c.id.in_([old.id, touched.id])).values(since=long_ago)
            connection.execute(begun)
        library.look_after()
        assert {path.name for path in old.path.parent.iterdir()} == {fresh.id, touched.id}
        with library.database.reading() as connection:
            assert library.uploads.find(connection, admin, touched.id).offset == 4
            with pytest.raises(GoneError, match="no such upload"):
                library.uploads.find(connection, admin, old.id)


def test_an_upload_without_a_byte_counts_for_an_hour(tmp_path: Path) -> None:
    with contextlib.closing(Library(Settings(tmp_path / "served", quota=20_000))) as library:
        library.first_password()
        with library.database.reading() as connection:
            admin = accounts.caller_named(connection, "admin")
        assert admin is not None
        begun, again, some = (library.begin_upload(admin, 6_000, each * 64, 0) for each in "abc")
        assert isinstance(begun, Upload) and isinstance(again, Upload) and isinstance(some, Upload)
        some.path.write_bytes(b"some")
        again.path.touch()
        with library.database.writing() as connection:
            connection.execute(UPLOAD.update().values(since=int(time.time()) - 3700))
        library.begin_upload(admin, 6_000, "b" * 64, 0)
        library.look_after()
        with library.database.reading() as connection:
            assert limits.used_by(connection, "admin") == 12_000
            assert library.uploads.find(connection, admin, again.id).offset == 0
            with pytest.raises(GoneError, match="no such upload"):
                library.uploads.find(connection, admin, begun.id)


def test_a_clock_that_is_set_back_keeps_nobody_from_signing_in(tmp_path: Path) -> None:
    """Who failed while the clock was wrong would wait until that time comes again."""
    settings = Settings(tmp_path / "served")
    with serving(settings) as url:
        signing_in = {"username": "admin", "password": "a wrong password"}
        asked = [httpx.post(f"{url}/v1/tokens", json=signing_in).status_code for _ in range(11)]
        assert asked == [401] * 10 + [429]
        database = Database(settings.database_place)
        with database.writing() as connection:
            connection.execute(update(FAILURE).values(time=FAILURE.c.time + 3600))
        assert httpx.post(f"{url}/v1/tokens", json=signing_in).status_code == 401
        with database.reading() as connection:
            assert connection.execute(select(func.max(FAILURE.c.time))).scalar_one() < time.time() + 60
        database.close()
