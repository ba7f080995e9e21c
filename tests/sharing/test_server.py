"""Who may do what on a server, and what attackers try. The routes come from its OpenAPI document, so that none is
forgotten."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import httpx
import jwt
import numpy as np
import pytest
from serving import PASSWORD, serving
from stored_items import episode, query
from typer.testing import CliRunner

from tupli_mcap.cli.app import app
from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.recording import Recording
from tupli_mcap.schema import (
    RIGHT,
    ArtifactMetadata,
    EpisodeHeader,
    F,
    Group,
    GroupMembership,
    GroupMembershipQuery,
    UserRole,
    format_filter,
)
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.people.tokens import SignInError as EndedError
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage import FileStorage, TupliAPIClient
from tupli_mcap.storage.api.answers import SignInError
from tupli_mcap.storage.api.upload import send_file
from tupli_mcap.wrappers.rollout import record_rollouts

FOR_ALL = {
    ("GET", "/health"), ("GET", "/ready"), ("POST", "/v1/tokens"), ("POST", "/v1/tokens/refresh"),
    ("POST", "/v1/tokens/end"), ("POST", "/access/users/token"), ("OPTIONS", "/v1/uploads"),
}  # fmt: skip
OTHERWISE = {
    ("POST", "/v1/users"): 403,
    ("POST", "/access/users/create"): 403,
    ("POST", "/access/users/refresh-token"): 403,
}
"""What guests are told there: routes that ask for rights, or for a token of another kind."""
READING = {
    ("GET", "/metrics"),
    ("GET", "/v1/me"), ("GET", "/v1/users"), ("GET", "/v1/groups"), ("GET", "/v1/groups/{name}"),
    ("GET", "/v1/roles"), ("POST", "/v1/benchmarks/list"), ("GET", "/v1/benchmarks/{uri}"),
    ("POST", "/v1/artifacts/list"), ("GET", "/v1/artifacts/{uri}"), ("GET", "/v1/artifacts/{uri}/users"),
    ("POST", "/v1/episodes/list"), ("POST", "/v1/episodes/count"), ("GET", "/v1/episodes/deleted"),
    ("POST", "/v1/tickets"),
    ("POST", "/v1/query"), ("POST", "/v1/query/tickets"), ("GET", "/v1/manifest"), ("GET", "/v1/data"),
    ("GET", "/v1/files/{name}"), ("HEAD", "/v1/files/{name}"), ("GET", "/v1/episodes/{uri}.rrd"),
    ("GET", "/access/users/list"), ("GET", "/access/groups/list"), ("GET", "/access/groups/read"),
    ("GET", "/access/roles/list"), ("GET", "/benchmarks/load"), ("POST", "/benchmarks/list"),
    ("GET", "/artifacts/download"), ("POST", "/artifacts/list"), ("POST", "/episodes/list"),
}  # fmt: skip
"""Routes that change nothing; every other one needs a token that may write."""
BODIES: dict[str, Any] = {
    "/v1/tokens": {"username": "x", "password": "y"},
    "/v1/tokens/refresh": {"refresh_token": "x"},
    "/v1/tokens/end": {"refresh_token": "x"},
    "/v1/users": {"username": "eve", "password": "y"},
    "/v1/users/{username}/password": {"password": "y"},
    "/v1/groups": {"name": "g"},
    "/v1/groups/{name}/members": [{"user": "ann"}],
    "/v1/roles": {"role": "r", "rights": []},
    "/v1/api-tokens": {"name": "t"},
    "/v1/benchmarks": {"hash": "h", "serialized": "s", "metadata": {"name": "n"}},
    "/v1/episodes/delete": {"filter": {"type": "EQ", "key": "steps", "value": 1}},
    "/v1/episodes/publish": {"filter": None, "group": "g"},
    "/v1/share": {"filter": {"type": "EQ", "key": "steps", "value": 1}, "group": "g"},
    "/v1/episodes/keys": {"key": "metadata.x"},
    "/v1/tickets": {"recording": "x"},
    "/access/users/create": {"username": "eve", "password": "y"},
    "/access/users/change-password": {"username": "admin", "password": "y"},
    "/access/users/token": {"username": "x", "password": "y"},
    "/access/groups/create": {"name": "g"},
    "/access/groups/add-members": {"group_name": "x", "members": []},
    "/access/groups/remove-members": {"group_name": "x", "members": []},
    "/access/roles/create": {"role": "r", "rights": []},
    "/benchmarks/create": {"hash": "h", "serialized": "s", "metadata": {"name": "n"}},
    "/episodes/record": {"benchmark_id": "x", "metadata": {}, "tuples": []},
}
PARAMETERS = {
    **dict.fromkeys(
        ("benchmark_id", "artifact_id", "episode_id", "username", "group_name", "role_name"), "x"
    ),
    **dict.fromkeys(("group", "publish_in", "unpublish_from"), "global"),
    "id": "x",
}
BOTH = pytest.mark.parametrize("users", ["sqlite", "postgresql"], indirect=True)
ONE = pytest.mark.sampled(1)  # who may use a route, the database does not decide
HEADERS = {
    "Artifact-Metadata": base64.b64encode(b'{"name": "x"}').decode(),
    "Upload-Length": "5",
    "Upload-Offset": "0",
    "Upload-Metadata": f"sha256 {base64.b64encode(b'0' * 64).decode()}",
}


class Users(NamedTuple):
    """Clients of one server: the admin, and three users."""

    url: str
    admin: TupliAPIClient
    ann: TupliAPIClient
    bob: TupliAPIClient
    eve: TupliAPIClient


def client(url: str, name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> TupliAPIClient:
    """A user's client, on a machine of their own."""
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(place / name))
    monkeypatch.setenv("TUPLI_MCAP_DATA_DIR", str(place / name))
    found = TupliAPIClient(url)
    found.login(name, PASSWORD if name == "admin" else f"{name}-password")
    return found


@pytest.fixture
def users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Users]:
    with contextlib.ExitStack() as stack:
        database = ""
        if getattr(request, "param", "sqlite") == "postgresql":
            database = stack.enter_context(request.getfixturevalue("postgres").database())
        url = stack.enter_context(serving(Settings(tmp_path / "served", database=database)))
        admin = client(url, "admin", tmp_path, monkeypatch)
        for name in ("ann", "bob", "eve"):
            admin.signup(name, f"{name}-password")
        rest = [client(url, name, tmp_path, monkeypatch) for name in ("ann", "bob", "eve")]
        yield Users(url, admin, *rest)
        for each in (admin, *rest):
            each.close()


def members(group: str, user: str, *roles: str) -> GroupMembershipQuery:
    member = GroupMembership(user=user, roles=list(roles))
    return GroupMembershipQuery(group_name=group, members=[member])


def token_of(user: TupliAPIClient) -> dict[str, str]:
    return {"Authorization": f"Bearer {user._session._token()}"}


def routes(url: str) -> list[tuple[str, str]]:
    document = httpx.get(f"{url}/openapi.json", timeout=120).json()
    found = [(method.upper(), path) for path, item in document["paths"].items() for method in item]
    assert len(found) > 45
    return found


def call(url: str, method: str, path: str, headers: dict[str, str], **names: str) -> httpx.Response:
    known = {"uri": "0" * 64, "name": "x", "username": "nobody", "user": "x", "role_name": "x", "token": "x",
             "upload_id": "0" * 32} | names  # fmt: skip
    target = url + path.format(**known)
    body = None if method in ("GET", "HEAD", "DELETE") else BODIES.get(path, {})
    if path == "/artifacts/upload":
        form: dict[str, Any] = {"files": {"data": b"x"}, "data": {"metadata": '{"name": "x"}'}}
        return httpx.post(target, headers=headers, timeout=120, **form)
    told: dict[str, Any] = {"headers": {**HEADERS, **headers}, "json": body, "params": PARAMETERS}
    if method == "PATCH":
        told |= {"json": None, "content": b"x"}
    return httpx.request(method, target, **told, timeout=120)  # a viewer may be loaded first


# --- every route ---


@ONE
@BOTH
def test_without_a_token_nothing_is_shown(users: Users) -> None:
    for method, path in routes(users.url):
        status = call(users.url, method, path, {}).status_code
        if (method, path) in FOR_ALL:
            assert status in (200, 204, 401), (method, path)
        else:
            assert status == OTHERWISE.get((method, path), 401), (method, path, status)


@ONE
@BOTH
def test_a_token_that_may_read_changes_nothing(users: Users) -> None:
    made = users.admin._session.ask("POST", "/v1/api-tokens", {"name": "laptop", "scope": "read"})
    token = {"Authorization": f"Bearer {made['token']}"}
    for path in ("/v1/users", "/access/users/create"):  # for which even the rights of an admin do not count
        told = {"username": f"of{path.count('/')}", "password": "long enough"}
        refused = httpx.post(users.url + path, headers=token, json=told)
        assert (refused.status_code, "may only read" in refused.text) == (403, True), path
    users.admin._session.ask("DELETE", f"/v1/api-tokens/{made['id']}")
    made = users.ann._session.ask("POST", "/v1/api-tokens", {"name": "laptop", "scope": "read"})
    token = {"Authorization": f"Bearer {made['token']}"}
    listed = {name: value for name, value in made.items() if name != "token"}
    assert users.ann._session.ask("GET", "/v1/api-tokens") == [listed]
    for method, path in routes(users.url):
        if (method, path) in FOR_ALL or path == "/access/users/refresh-token":
            continue
        status = call(users.url, method, path, token).status_code
        if (method, path) in READING:
            assert status in (200, 403, 404), (method, path, status)
        else:
            assert status == 403, (method, path, status)
    assert users.ann.list_benchmarks() == []
    users.ann._session.ask("DELETE", f"/v1/api-tokens/{made['id']}")
    assert httpx.get(f"{users.url}/v1/me", headers=token).status_code == 401


class Things(NamedTuple):
    """What ann has stored."""

    benchmark: str
    artifact: str
    episodes: list[EpisodeHeader]


@pytest.fixture
def things(users: Users) -> Things:
    artifact = users.ann.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
    benchmark = users.ann.store_benchmark(query(artifacts=(artifact,))).id
    return Things(benchmark, artifact, users.ann.record_episodes([episode(benchmark), episode(benchmark, 5)]))


@pytest.mark.parametrize("path", ["list", "count", "delete", "publish"])
def test_a_misspelt_field_is_refused(users: Users, things: Things, path: str) -> None:
    told = {"filtr": "steps > 1000", **({"group": "global"} if path == "publish" else {})}
    refused = httpx.post(f"{users.url}/v1/episodes/{path}", json=told, headers=token_of(users.ann))
    assert refused.status_code == 400
    assert refused.json()["detail"] == "expected another request: filtr: there is no such field"
    assert users.ann.count_episodes() == 2 and users.bob.count_episodes() == 0
    for other in ("benchmarks/list", "artifacts/list", "query", "query/tickets", "tickets"):
        told = {"after": "x", **({"recording": "x"} if other == "tickets" else {})}
        refused = httpx.post(f"{users.url}/v1/{other}", json=told, headers=token_of(users.ann))
        assert refused.status_code == 400 and "after: there is no such field" in refused.text, other
    assert httpx.post(
        f"{users.url}/episodes/list", json={"after": "x"}, headers=token_of(users.ann)
    ).json(), "PyTupli's route ignores it"


def statuses(user: Users, caller: TupliAPIClient, things: Things) -> dict[tuple[str, str], int]:
    """What each route that names something of ann's answers."""
    ids = {"/v1/benchmarks": things.benchmark, "/v1/artifacts": things.artifact}
    found = {}
    for method, path in routes(user.url):
        if "{uri}" in path:
            uri = next((ids[start] for start in ids if path.startswith(start)), things.episodes[0].id)
            found[method, path] = call(user.url, method, path, token_of(caller), uri=uri).status_code
    assert len(found) == 13
    return found


def test_what_may_not_be_read_is_not_there(users: Users, things: Things) -> None:
    for stranger in (users.bob, users.eve):
        assert set(statuses(users, stranger, things).values()) == {404}
        told = {"recording": things.episodes[0].recording}
        with pytest.raises(NotFoundError):
            stranger._session.ask("POST", "/v1/tickets", told)
        assert stranger.list_benchmarks() == stranger.list_artifacts() == stranger.list_episodes() == []
        assert stranger.count_episodes() == stranger.delete_episodes(F("steps") > 0) == 0
    reading = {key: status for key, status in statuses(users, users.admin, things).items() if key[0] == "GET"}
    assert set(reading.values()) == {404}  # what is private stays so for an admin


def test_what_is_published_in_a_group_is_read_there_and_nowhere_else(users: Users, things: Things) -> None:
    users.ann.create_group(Group(name="robots", description="those with arms"))
    users.ann.add_group_members(members("robots", "bob", "member"))
    users.ann.publish_benchmark(things.benchmark, "robots")
    users.ann.publish_artifact(things.artifact, "robots")
    users.ann.publish_episode(things.episodes[0].id, "robots")
    for (method, path), status in statuses(users, users.bob, things).items():
        assert status == (200 if method == "GET" else 403), (method, path, status)
    assert set(statuses(users, users.eve, things).values()) == {404}
    assert users.bob.load_artifact(things.artifact) == b"wind"
    assert [header.id for header in users.bob.list_episodes()] == [things.episodes[0].id]
    with pytest.raises(StorageError, match="only its owner may delete"):
        users.bob.delete_episodes(F("steps") > 0)
    doomed = {(things.episodes[0].recording, things.episodes[0].id.rpartition("-")[0]): [0]}
    with pytest.raises(StorageError, match="only its owner may delete"):
        users.bob.delete_numbers(doomed, dry_run=True)  # as it would be without
    assert users.ann.delete_numbers(doomed, dry_run=True) == 1 <= users.ann.count_episodes()

    users.ann.remove_group_members(members("robots", "bob"))
    assert set(statuses(users, users.bob, things).values()) == {404}
    users.ann.add_group_members(members("robots", "bob", "member"))
    users.ann.unpublish_episodes(F("steps") > 0, "robots")
    assert users.bob.list_episodes() == []


def test_groups_that_one_may_not_see_are_not_named(users: Users, things: Things) -> None:
    users.ann.create_group(Group(name="spies"))
    for group in ("global", "spies", "bob"):
        users.ann.publish_benchmark(things.benchmark, group)
        users.ann.publish_artifact(things.artifact, group)
        users.ann.publish_episode(things.episodes[0].id, group)

    def told(user: TupliAPIClient) -> list[list[str]]:
        artifact = {"artifact_id": things.artifact}
        pytupli = httpx.post(f"{user.url}/episodes/list", json={}, headers=token_of(user), timeout=120)
        sent = httpx.get(
            f"{user.url}/artifacts/download", params=artifact, headers=token_of(user), timeout=120
        )
        seen = [
            *user.list_benchmarks(), user.load_benchmark(things.benchmark), *user.list_artifacts(),
            *user.list_episodes(F("id") == things.episodes[0].id),
        ]  # fmt: skip
        groups = [item.published_in for item in seen]
        groups += [item["published_in"] for item in pytupli.json() if item["id"] == things.episodes[0].id]
        return [*groups, json.loads(sent.headers["X-Metadata"])["published_in"]]

    assert told(users.ann) == told(users.admin) == 6 * [["ann", "global", "spies", "bob"]]
    assert told(users.eve) == 6 * [["ann", "global", "bob"]]
    place = F("published_in")
    guesses = (place == "spies", place.isin(["spies", "x"]), place.contains("SPI"), ~(place != "spies"))
    for user, count in ((users.eve, 0), (users.ann, 1)):
        for guess in guesses:
            assert user.count_episodes(guess) == len(user.list_episodes(guess)) == count, guess
            assert len(user.list_benchmarks(guess)) == len(user.list_artifacts(guess)) == count
            asked = {"filter": format_filter(guess), "format": "json"}
            page = httpx.get(f"{user.url}/episodes", params=asked, headers=token_of(user), timeout=120).json()
            assert (len(page["episodes"]), page["count"]) == (count, count)
    for user, shown in ((users.eve, False), (users.ann, True)):
        (ann,) = [each for each in user.list_users() if each.username == "ann"]
        assert ("spies" in [held.group for held in ann.memberships]) == shown
    users.ann.delete_group("spies")
    assert told(users.ann) == told(users.eve) == 6 * [["ann", "global", "bob"]]


def test_nothing_is_published_in_a_group_that_is_not_there_or_not_known(users: Users, things: Things) -> None:
    """Whoever makes a group of that name later would see it."""
    users.eve.create_group(Group(name="secret"))
    for group in ("robbots", "secret"):
        for publish in (
            lambda group=group: users.ann.publish_benchmark(things.benchmark, group),
            lambda group=group: users.ann.publish_artifact(things.artifact, group),
            lambda group=group: users.ann.publish_episode(things.episodes[0].id, group),
        ):
            with pytest.raises(StorageError, match=f"{group}. It does not exist, or you are not in it"):
                publish()
    users.ann.publish_benchmark(things.benchmark, "bob")  # a user's own group
    assert [header.id for header in users.bob.list_benchmarks()] == [things.benchmark]


def test_a_recording_is_cut_to_what_may_be_read(users: Users, things: Things) -> None:
    users.ann.publish_episode(things.episodes[1].id)
    (header,) = users.eve.list_episodes()
    with (
        users.eve.open_recording(header.recording) as cut,
        users.ann.open_recording(header.recording) as whole,
    ):
        assert (cut.uuid, len(cut), len(whole)) == (whole.uuid, 1, 2)
        np.testing.assert_array_equal(cut.episodes[0].states, whole.episodes[1].states)
    users.ann.delete_episode(things.episodes[0].id)
    with users.ann.open_recording(header.recording) as left:
        assert [int(number) for number in left.index["episode"]] == [1]


def test_the_same_content_of_two_users(users: Users, things: Things) -> None:
    """Neither is told of the other."""
    other = users.bob.store_artifact(b"wind", ArtifactMetadata(name="my wind"))
    assert (other.created_by, other.name) == ("bob", "my wind")
    mine = users.bob.store_benchmark(query(artifacts=(other.id,)))
    assert (mine.id, mine.created_by) == (things.benchmark, "bob")
    users.ann.delete_artifact(things.artifact, force=True)
    assert users.bob.load_artifact(other.id) == b"wind"
    users.bob.delete_benchmark(mine.id)
    assert users.ann.load_benchmark(things.benchmark).created_by == "ann"


def test_who_deletes_an_artifact_is_not_told_of_private_benchmarks(users: Users, things: Things) -> None:
    users.ann.publish_artifact(things.artifact)
    with pytest.raises(StorageError, match="is needed by a private benchmark of its owner") as failed:
        users.admin.delete_artifact(things.artifact)
    assert things.benchmark not in str(failed.value)
    with pytest.raises(StorageError, match=f"is needed by benchmark {things.benchmark}"):
        users.ann.delete_artifact(things.artifact)


def test_who_may_delete_hides_the_same_content_of_all(users: Users, things: Things) -> None:
    users.bob.store_artifact(b"wind", ArtifactMetadata(name="my wind"))
    users.bob.store_benchmark(query(artifacts=(things.artifact,)))
    for user in (users.ann, users.bob):
        user.publish_benchmark(things.benchmark)
        user.publish_artifact(things.artifact)
    users.eve.store_artifact(b"wind", ArtifactMetadata(name="private"))
    users.admin.store_artifact(b"wind", ArtifactMetadata(name="private"))  # its own one is not in that group
    users.admin.unpublish_benchmark(things.benchmark, "global")
    users.admin.unpublish_artifact(things.artifact, "global")
    assert users.eve.list_benchmarks() == []
    assert [item.created_by for item in users.eve.list_artifacts()] == ["eve"]
    users.eve.delete_artifact(things.artifact)
    assert users.eve.list_artifacts() == []


# --- names, passwords, tokens ---


def test_users_and_groups_have_one_name_space(users: Users) -> None:
    for name in ("ann", "global", "$$GUEST$$"):
        with pytest.raises(StorageError, match="already exists"):
            users.eve.create_group(Group(name=name))
    users.eve.create_group(Group(name="lab"))
    for name in ("lab", "global", "bob"):
        with pytest.raises(StorageError, match="already exists|expected a user name"):
            users.admin.signup(name, "password")
    users.admin.delete_user("bob")
    with pytest.raises(StorageError, match="has or had this name"):  # who would own what bob made
        users.admin.signup("bob", "password")
    with pytest.raises(NotFoundError, match="Group not found"):
        users.ann.read_group("lab")


def test_groups_and_roles_have_names_that_addresses_can_have(users: Users) -> None:
    for name in (".", "..", "a/b", "", "\u3164"):
        with pytest.raises(StorageError, match="expected a group name"):
            users.eve.create_group(Group(name=name))
        with pytest.raises(StorageError, match="expected a role name"):
            users.admin.create_role(UserRole(role=name, rights=[]))


def test_nobody_gives_rights_that_they_lack(users: Users) -> None:
    users.eve.create_group(Group(name="lab"))
    with pytest.raises(StorageError, match="Insufficient permissions in group: lab"):
        users.eve.add_group_members(members("lab", "eve", "admin"))
    with pytest.raises(StorageError, match="Group not found|Insufficient permissions"):
        users.eve.add_group_members(members("global", "eve", "admin"))
    with pytest.raises(StorageError, match="Insufficient permissions"):
        users.eve.create_role(UserRole(role="mighty", rights=[RIGHT.ROLE_MANAGEMENT]))
    with pytest.raises(StorageError, match="cannot be deleted"):
        users.admin.delete_role("admin")


def test_a_new_password_ends_every_sign_in(users: Users) -> None:
    old = token_of(users.ann)
    made = users.ann._session.ask("POST", "/v1/api-tokens", {"name": "robot", "scope": "write"})
    with pytest.raises(
        StorageError, match=r"^the old password is not right; nothing was changed \(says http.*\)$"
    ):
        users.ann.change_password("ann", "new-password", old="wrong")
    users.ann.change_password("ann", "new-password", old="ann-password")
    for token in (old, {"Authorization": f"Bearer {made['token']}"}):
        assert httpx.get(f"{users.url}/v1/me", headers=token).status_code == 401
    with pytest.raises(StorageError, match="tupli-mcap login"):
        users.ann.list_benchmarks()
    users.ann.login("ann", "new-password")
    assert users.ann.whoami().username == "ann"


@pytest.mark.parametrize("ending", ["new password", "deletion"])
def test_nothing_overtakes_the_end_of_a_sign_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    """A request that was let in before, and is done afterwards, leaves nothing with which one is signed in."""
    let_in, is_over, verify = threading.Semaphore(0), threading.Event(), accounts.verify_password

    def verify_slowly(*told: Any) -> bool:
        right = verify(*told)
        let_in.release()
        assert is_over.wait(60)
        return right

    library = Library(Settings(tmp_path))
    hashed = [accounts.hash_password(password, 8) for password in ("the old one", "the new one")]
    with library.database.writing() as connection:
        accounts.create_user(connection, "ann", hashed[0])
        ann = accounts.caller_named(connection, "ann")
    assert ann is not None
    monkeypatch.setattr(accounts, "verify_password", verify_slowly)
    with ThreadPoolExecutor() as pool:
        begun = [
            pool.submit(library.sign_in, "ann", "the old one", "127.0.0.1"),
            pool.submit(library.change_password, ann, "ann", "a third one", old="the old one"),
        ]
        assert all(let_in.acquire(timeout=60) for _ in begun)
        with library.database.writing() as connection:
            if ending == "deletion":
                accounts.delete_user(connection, "ann")
            else:
                accounts.change_password(connection, "ann", hashed[1])
        is_over.set()
        for each in begun:
            with pytest.raises((EndedError, NotFoundError)):
                each.result()
    with library.database.writing() as connection:
        with pytest.raises(EndedError, match="this sign-in has ended"):
            library.tokens.create_api_token(connection, ann, "robot", "write", None)
        assert verify(connection, "ann", "the new one") == (ending == "new password")
    library.close()


def exchanged(users: Users, refresh: str) -> str | None:
    """The next refresh token; None if the server refuses."""
    answer = httpx.post(f"{users.url}/v1/tokens/refresh", json={"refresh_token": refresh})
    assert answer.status_code in (200, 401)
    found: str | None = answer.json().get("refresh_token")
    return found


@pytest.fixture
def refresh(users: Users) -> str:
    told = {"username": "ann", "password": "ann-password"}
    return str(httpx.post(f"{users.url}/v1/tokens", json=told).json()["refresh_token"])


def test_a_refresh_token_whose_answer_was_lost_is_exchanged_again(users: Users, refresh: str) -> None:
    lost = [exchanged(users, refresh) for _ in range(2)]
    second = exchanged(users, refresh)
    assert second and len({refresh, second, *lost}) == 4
    assert exchanged(users, second)


def test_after_an_hour_no_answer_counts_as_lost(
    users: Users, refresh: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tupli_mcap.server.people.tokens._LOST_SECONDS", 0)
    second = exchanged(users, refresh)
    assert second
    assert exchanged(users, refresh) is None
    assert exchanged(users, second) is None


def test_a_refresh_token_that_two_have_ends_the_sign_in(users: Users, refresh: str) -> None:
    second = exchanged(users, refresh)
    assert second
    third = exchanged(users, second)
    assert third
    assert exchanged(users, refresh) is None
    assert exchanged(users, third) is None


def test_a_refresh_token_that_was_taken_for_lost_ends_the_sign_in(users: Users, refresh: str) -> None:
    second, of_thief = exchanged(users, refresh), exchanged(users, refresh)
    assert second
    assert of_thief
    assert exchanged(users, second) is None
    assert exchanged(users, of_thief) is None


def test_an_expired_access_token_is_renewed_by_the_client(users: Users) -> None:
    kept = users.ann._session.tokens
    kept.put(users.url, "ann", {**kept.tokens(users.url), "access_token": "expired"})
    assert users.ann.whoami().username == "ann"


def test_forged_tokens(users: Users, tmp_path: Path) -> None:
    secret = (tmp_path / "served" / "server" / "secret").read_bytes()
    good = {"typ": "access", "sub": "admin", "epoch": 0, "exp": int(time.time()) + 60}
    forged = [
        jwt.encode(good, "another secret that is long enough!", algorithm="HS256"),
        jwt.encode(good, None, algorithm="none"),
        jwt.encode({**good, "exp": int(time.time()) - 1}, secret, algorithm="HS256"),
        jwt.encode({**good, "typ": "ticket"}, secret, algorithm="HS256"),
        jwt.encode({**good, "epoch": 7}, secret, algorithm="HS256"),
        jwt.encode({**good, "sub": "nobody"}, secret, algorithm="HS256"),
        jwt.encode({**good, "sub": ["admin"]}, secret, algorithm="HS256"),
        "tmcap_guess", "x.y.z", "x" * 5000,
    ]  # fmt: skip
    for token in forged:
        answer = httpx.get(f"{users.url}/v1/me", headers={"Authorization": f"Bearer {token}"})
        assert answer.status_code == 401, token
    real = jwt.encode(good, secret, algorithm="HS256")
    assert httpx.get(f"{users.url}/v1/me", headers={"Authorization": f"Bearer {real}"}).status_code == 200


def test_a_wrong_password_tells_nothing_of_the_user_and_many_are_throttled(users: Users) -> None:
    answers = [
        httpx.post(f"{users.url}/v1/tokens", json={"username": name, "password": "wrong"})
        for name in ("ann", "nobody", "", "ann'; --")
    ]
    assert {(answer.status_code, answer.json()["detail"]) for answer in answers} == {
        (401, "Incorrect username or password")
    }
    for _ in range(20):
        last = httpx.post(f"{users.url}/v1/tokens", json={"username": "ann", "password": "wrong"})
    assert last.status_code == 429
    assert 0 < int(last.headers["Retry-After"]) <= 60


# --- uploads and files ---


def begin(url: str, token: dict[str, str], data: bytes, length: int | None = None) -> str:
    digest = base64.b64encode(hashlib.sha256(data).hexdigest().encode()).decode()
    headers = {"Upload-Length": str(length or len(data)), "Upload-Metadata": f"sha256 {digest}", **token}
    answer = httpx.post(f"{url}/v1/uploads", headers=headers)
    assert answer.status_code == 201, answer.text
    return url + answer.headers["Location"]


def patch(place: str, token: dict[str, str], data: bytes, offset: int = 0) -> httpx.Response:
    return httpx.patch(place, headers={"Upload-Offset": str(offset), **token}, content=data)


def test_an_upload_goes_on_where_it_was_broken_off(users: Users, tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=100, seed=1)
    data, token = (tmp_path / "run.mcap").read_bytes(), token_of(users.ann)
    place = begin(users.url, token, data)
    assert patch(place, token, data[:1000]).headers["Upload-Offset"] == "1000"
    assert begin(users.url, token, data) == place  # asked again, it is the same one
    assert httpx.head(place, headers=token).headers["Upload-Offset"] == "1000"
    assert patch(place, token, data[500:], 500).status_code == 409
    assert httpx.head(place, headers=token_of(users.eve)).status_code == 410
    name = users.ann.push(tmp_path / "run.mcap")
    assert users.ann.push(tmp_path / "run.mcap") == name
    with users.ann.open_recording(name) as sent, Recording(tmp_path / "run.mcap") as original:
        assert sent.uuid == original.uuid
    assert users.ann.count_episodes() == len(Recording(tmp_path / "run.mcap"))


def test_what_an_upload_was_begun_with_last_holds(users: Users, tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=200, seed=1)
    begin(users.url, token_of(users.ann), (tmp_path / "run.mcap").read_bytes())
    send_file(users.ann._session, tmp_path / "run.mcap", sent_before=2)
    with Recording(tmp_path / "run.mcap") as sent:
        assert users.ann.count_episodes() == len(sent) - 2  # the first ones were deleted on the server


def test_what_tus_asks_for(users: Users) -> None:
    able = httpx.options(f"{users.url}/v1/uploads")
    assert (able.status_code, able.content) == (204, b"")
    told = {name: able.headers[f"Tus-{name}"] for name in ("Resumable", "Version", "Extension", "Max-Size")}
    assert told == {
        "Resumable": "1.0.0", "Version": "1.0.0", "Extension": "creation,termination", "Max-Size": str(1 << 40)
    }  # fmt: skip
    asked = {"Origin": "http://elsewhere.example", "Access-Control-Request-Method": "POST"}
    assert not [
        each
        for each in httpx.options(f"{users.url}/v1/uploads", headers=asked).headers
        if "access-control" in each
    ]
    token = token_of(users.ann)
    place = begin(users.url, {**token, "Tus-Resumable": "1.0.0"}, b"abc")
    for method, url in (
        ("POST", f"{users.url}/v1/uploads"),
        *((each, place) for each in ("HEAD", "PATCH", "DELETE")),
    ):
        other = httpx.request(method, url, headers={**token, "Tus-Resumable": "0.2", "Upload-Offset": "0"})
        assert (other.status_code, other.headers["Tus-Version"]) == (412, "1.0.0"), method
    wrong = patch(place, {**token, "Content-Type": "application/octet-stream"}, b"abc")
    assert (wrong.status_code, wrong.json()["detail"]) == (
        415, "expected Content-Type: application/offset+octet-stream, found application/octet-stream"
    )  # fmt: skip
    right = {**token, "Content-Type": "application/offset+octet-stream", "Tus-Resumable": "1.0.0"}
    assert patch(place, right, b"ab").headers["Upload-Offset"] == "2"
    assert httpx.delete(place, headers=token).status_code == 204


def test_what_is_no_recording_is_not_kept(users: Users, tmp_path: Path) -> None:
    token = token_of(users.ann)
    for sent, announced, status in ((b"nonsense" * 100, None, 400), (b"x" * 800, b"y" * 800, 460)):
        place = begin(users.url, token, announced or sent)
        answer = patch(place, token, sent)
        assert answer.status_code == status, answer.text
        assert str(tmp_path) not in answer.text
        assert httpx.head(place, headers=token).status_code == 410
    place = begin(users.url, token, b"abc", length=3)
    assert patch(place, token, b"abcd").status_code == 413
    kept = [path for path in (tmp_path / "served").rglob("*.mcap") if path.is_file()]
    assert (kept, users.ann.list_episodes()) == ([], [])


def test_ranges_and_versions_of_a_file(users: Users, things: Things) -> None:
    told = users.ann._session.ask("POST", "/v1/tickets", {"recording": things.episodes[0].recording})
    url = users.url + told["path"]
    whole = httpx.get(url)
    assert hashlib.sha256(whole.content).hexdigest() == told["digest"] == whole.headers["ETag"].strip('"')
    part = httpx.get(url, headers={"Range": "bytes=-10", "If-Match": whole.headers["ETag"]})
    assert (part.status_code, part.content) == (206, whole.content[-10:])
    assert httpx.get(url, headers={"If-Match": '"another"'}).status_code == 412
    other = url.replace("recordings/", "recordings/../")
    assert httpx.get(other).status_code in (401, 404)


def test_a_ticket_for_a_whole_recording_is_for_no_part_of_it(users: Users, tmp_path: Path) -> None:
    """Its reader would get other bytes than the ticket names."""
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=100, seed=1)
    name = users.ann.push(tmp_path / "run.mcap")
    ticket = users.ann._ticket(name)
    assert ticket.whole and ticket.episodes > 2
    assert users.ann.delete_episodes(F("episode") == 1) == 1
    refused = httpx.get(users.url + ticket.path)
    assert (refused.status_code, refused.json()["detail"]) == (412, "this has changed; open it again")
    again = users.ann._ticket(name)
    assert not again.whole and httpx.get(users.url + again.path).status_code == 200


def test_a_directory_that_is_a_storage_is_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with FileStorage(tmp_path / "lab") as storage:
        artifact = storage.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
        benchmark = storage.store_benchmark(query(artifacts=(artifact,))).id
        made = storage.record_episodes([episode(benchmark), episode(benchmark), episode(benchmark)])
        storage.delete_episode(made[1].id)
    for _ in range(2):
        with serving(Settings(tmp_path / "lab")) as url:
            admin = client(url, "admin", tmp_path, monkeypatch)
            assert [header.id for header in admin.list_episodes()] == [made[0].id, made[2].id]
            assert admin.load_benchmark(benchmark).created_by == "admin"
            assert admin.load_artifact(artifact) == b"wind"
            with admin.open_recording(made[0].recording) as recording:
                assert len(recording) == 2
            admin.close()
    with serving(Settings(tmp_path / "lab")) as url:
        admin = client(url, "admin", tmp_path, monkeypatch)
        assert admin.delete_episodes(F("steps") > 0) == 2
        admin.close()
    assert not (tmp_path / "lab" / made[0].recording).exists()


def test_what_was_deleted_from_a_storage_that_is_served_stays_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FileStorage(tmp_path / "lab") as storage:
        artifact = storage.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
        benchmark = storage.store_benchmark(query()).id
    for found in (1, 0):
        with serving(Settings(tmp_path / "lab")) as url:
            admin = client(url, "admin", tmp_path, monkeypatch)
            assert len(admin.list_benchmarks()) == len(admin.list_artifacts()) == found
            if found:
                admin.delete_benchmark(benchmark)
                admin.delete_artifact(artifact)
            admin.close()


def test_what_of_a_storage_cannot_be_served_keeps_no_server_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with FileStorage(tmp_path / "lab") as storage:
        gone, kept = (storage.store_artifact(data, ArtifactMetadata(name="a")).id for data in (b"1", b"2"))
    (tmp_path / "lab/artifacts" / gone).unlink()
    warned = pytest.warns(match=f"not served: there is no artifact with id '{gone}'")
    with warned, serving(Settings(tmp_path / "lab")) as url:
        admin = client(url, "admin", tmp_path, monkeypatch)
        assert [each.id for each in admin.list_artifacts()] == [kept]
        admin.close()


def test_what_a_user_stores_while_another_process_starts_is_not_the_admin_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(tmp_path / "lab")
    with FileStorage(settings.directory) as storage:
        artifact = storage.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
    with serving(settings) as url:
        admin = client(url, "admin", tmp_path, monkeypatch)
        admin.signup("ann", "ann-password")
        ann = client(url, "ann", tmp_path, monkeypatch)
        benchmark = ann.store_benchmark(query()).id
        with FileStorage(settings.directory) as storage:
            gone = storage.store_artifact(b"rain", ArtifactMetadata(name="rain")).id
        (settings.directory / "artifacts" / gone).unlink()
        stored: list[Any] = []
        with warnings.catch_warnings(), contextlib.closing(Library(settings)) as another:
            warnings.simplefilter("always")
            # it warns of the missing artifact: at that moment, Ann stores an episode
            monkeypatch.setattr(
                warnings, "showwarning", lambda *_: stored.extend(ann.record_episodes([episode(benchmark)]))
            )
            assert another.adopt() == 0
        assert len(stored) == 1 and admin.count_episodes() == 0
        assert [item.id for item in admin.list_artifacts()] == [artifact]
        ann.close()
        admin.close()


def test_guests_see_what_is_published_where_they_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(Settings(tmp_path / "served", guests=True)) as url:
        admin = client(url, "admin", tmp_path, monkeypatch)
        benchmark = admin.store_benchmark(query()).id
        made = admin.record_episodes([episode(benchmark), episode(benchmark)])
        admin.publish_benchmark(benchmark)
        admin.publish_episode(made[0].id)
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "guest"))
        with TupliAPIClient(url) as guest:
            assert [header.id for header in guest.list_benchmarks()] == [benchmark]
            (header,) = guest.list_episodes()
            with guest.open_recording(header.recording) as recording:
                assert len(recording) == 1
            with pytest.raises(StorageError, match="guests may change nothing .* sign in"):
                guest.store_artifact(b"x", ArtifactMetadata(name="x"))
        admin.close()


def test_a_ticket_of_a_deleted_user_is_not_that_of_a_guest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(Settings(tmp_path / "served", guests=True)) as url:
        admin = client(url, "admin", tmp_path, monkeypatch)
        admin.signup("ann", "ann-password")
        ann = client(url, "ann", tmp_path, monkeypatch)
        made = admin.record_episodes([episode(admin.store_benchmark(query()).id)])
        admin.publish_episode(made[0].id)
        paths = [ann._session.ask("POST", "/v1/query/tickets", {})["path"]]
        paths += [ann._session.ask("POST", "/v1/tickets", {"recording": made[0].recording})["path"]]
        guest = httpx.post(f"{url}/v1/query/tickets", json={}).json()["path"]
        admin.delete_user("ann")
        assert [httpx.get(url + path).status_code for path in paths] == [401, 401]
        assert httpx.get(url + guest).status_code == 200
        admin.close()
        ann.close()


def test_a_sign_in_that_has_ended_makes_no_guest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(Settings(tmp_path / "served", guests=True)) as url:
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "guest"))
        said = CliRunner().invoke(app, ["whoami", "--url", url]).stdout
        assert "nobody is signed in" in said and "GUEST" not in said
        admin = client(url, "admin", tmp_path, monkeypatch)
        monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "there"))
        with TupliAPIClient(url) as there:
            there.login("admin", PASSWORD)
            there.change_password("admin", "another password", old=PASSWORD)
        with pytest.raises(StorageError, match="sign in"):
            admin.list_benchmarks()
        for _ in range(2):  # not with what guests see
            with pytest.raises(SignInError, match="sign-in of admin at .* has ended; sign in again"):
                admin.list_benchmarks()
        assert admin.username == "admin"
        admin.logout()
        assert (admin.username, admin.list_benchmarks()) == ("", [])
        admin.login("admin", "another password")
        assert admin.list_benchmarks() == []
        admin.close()
