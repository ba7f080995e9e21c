"""What attackers try on a server, each really tried, on SQLite with a directory and on PostgreSQL with a bucket.

tokens: forged, expired, of the wrong type          test_server.test_forged_tokens
    swapped, revoked, those of before a new password, and those that make others TestTokens
    used twice, guessed                             test_server (refresh tokens; passwords are throttled), TestShares
every id of somebody else                           test_server_access, test_server (what_may_not_be_read_is_not_there)
rights that one has not: given, taken, taken over   TestRights, test_server.test_nobody_gives_rights_that_they_lack
names, keys and tokens that one user uses up         TestShares
all threads, by one user                            test_server_limits
names that look like those of others                TestShares
injection: SQL by ids, keys, filters, names, orders TestInjection
    paths, headers, log lines, terminal escapes     TestInjection
numbers and texts that no database can hold         TestInjection
forms of other pages (CSRF), sign-ins that lead out test_server_pages (TestForms, TestSigningIn)
framing                                             TestPages
scripts in every text that a file can carry         TestPages; in Chromium: test_page_browser
bodies: oversized, of no length, half, too deep     test_server_limits
    uploads that are longer than announced          test_server.test_what_is_no_recording_is_not_kept
    heads without an end, compressed bombs          TestSizes
    metadata and descriptions without an end        TestSizes
a quota that requests at once would exceed          TestSizes
a file with the UUID of somebody else's recording   test_server_shadowing
user enumeration by text and by time                TestEnumeration
names in uploads and in files, which lead nowhere   TestFiles
SSRF: addresses that a file or a request gives      TestFiles
answers that a proxy keeps for others               TestFiles
"""

from __future__ import annotations

import base64
import contextlib
import html
import itertools
import json
import logging
import re
import socket
import statistics
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, urlsplit

import httpx
import jwt
import numpy as np
import psutil
import pytest
import zstandard
from crafted import Model
from gymnasium import spaces
from pages import EVIL, robot
from persons import Person, announced, cart_benchmark
from served import served
from serving import ENGINES, PASSWORD, REAL_HASHES, serving, settings_of

from tupli_mcap import EpisodeWriter, Recording
from tupli_mcap.recording import rewrite_recording
from tupli_mcap.recording.edit.attach import add_attachments
from tupli_mcap.server.library import Library
from tupli_mcap.server.people import accounts
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.traffic import logs
from tupli_mcap.wrappers.rollout import record_rollouts

pytestmark = [
    pytest.mark.sampled(1),  # each on one of the two servers
    pytest.mark.filterwarnings("ignore::ResourceWarning"),  # of moto and boto3
]

SQL = (
    "' OR 1=1 --",
    "x'); DROP TABLE episode; --",
    '"; DELETE FROM account; --',
    "%",
    "_",
    "\\",
    "$1",
    ":x",
    "{}",
)
TEXTS = (
    *SQL,
    "\x00",
    "\n",
    "\r\nX-Evil: 1",
    "../../server/secret",
    "/etc/passwd",
    "\x1b]0;evil\x07",
    "\u202e",
    "日本",
    "a" * 5000,
)


class Lab(NamedTuple):
    """A server, with a recording, an artifact and a benchmark of ann's that nobody else sees; zoe keeps nothing."""

    url: str
    directory: Path
    ann: Person
    eve: Person
    zoe: Person
    admin: Person
    recording: str
    artifact: str
    episodes: list[str]


@pytest.fixture(scope="module", params=ENGINES)
def lab(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    root = tmp_path_factory.mktemp("lab")
    with settings_of(request.param, request, root / "served") as settings, serving(settings) as url:
        admin = Person(url, "admin")
        ann, eve, zoe = people(admin, "ann", "eve", "zoe")
        record_rollouts("CartPole-v1", root / "run.mcap", steps=60, seed=1)
        name = ann.send((root / "run.mcap").read_bytes())
        told = {"Artifact-Metadata": base64.b64encode(b'{"name": "wind"}').decode()}
        artifact = ann.ask("POST", "/v1/artifacts", headers=told, content=b"wind")["id"]
        ids = [each["id"] for each in ann.ask("POST", "/v1/episodes/list", {})["items"]]
        yield Lab(url, root / "served", ann, eve, zoe, admin, name, artifact, ids)


def people(admin: Person, *names: str) -> list[Person]:
    for name in names:
        admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
    return [Person(admin.url, name) for name in names]


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


class TestTokens:
    def test_a_token_of_one_kind_is_none_of_another(self, lab: Lab) -> None:
        told = {"username": "ann", "password": "ann's password"}
        pair = httpx.post(f"{lab.url}/v1/tokens", json=told).json()
        ticket = lab.ann.ask("POST", "/v1/tickets", {"recording": lab.recording})["path"].partition("=")[2]
        of_query = lab.ann.ask("POST", "/v1/query/tickets", {})["path"].partition("=")[2]
        made = lab.ann.ask("POST", "/v1/api-tokens", {"name": "robot"})["token"]
        access, refresh = pair["access_token"], pair["refresh_token"]
        for token in (refresh, ticket, of_query, made[:-1], access[:-2], f"{access}.x"):
            assert httpx.get(f"{lab.url}/v1/me", headers=bearer(token)).status_code == 401, token
        for token in (access, ticket, made, ""):
            told = {"refresh_token": token}
            assert httpx.post(f"{lab.url}/v1/tokens/refresh", json=told).status_code == 401, token
        file = f"{lab.url}/v1/files/{lab.recording}"
        for token in (access, refresh, made, of_query):
            assert httpx.get(file, params={"ticket": token}).status_code == 401, token
        rrd = f"{lab.url}/v1/episodes/{lab.episodes[0]}.rrd"
        assert httpx.get(rrd, params={"ticket": of_query}).status_code == 401
        assert httpx.get(f"{lab.url}/v1/manifest", params={"ticket": ticket}).status_code == 400
        assert httpx.get(file, params={"ticket": ticket}).status_code == 200
        for cookie in (access, ticket, made, of_query):
            page = httpx.get(f"{lab.url}/account", cookies={"tupli_mcap_session": cookie})
            assert page.status_code in (303, 401), cookie

    def test_a_ticket_is_for_one_recording(self, lab: Lab, tmp_path: Path) -> None:
        record_rollouts("CartPole-v1", tmp_path / "other.mcap", steps=20, seed=2)
        other = lab.ann.send((tmp_path / "other.mcap").read_bytes())
        ticket = lab.ann.ask("POST", "/v1/tickets", {"recording": other})["path"].partition("=")[2]
        found = httpx.get(f"{lab.url}/v1/files/{lab.recording}", params={"ticket": ticket})
        assert found.status_code == 401

    def test_a_new_password_ends_tickets(self, lab: Lab) -> None:
        (dan,) = people(lab.admin, "dan")
        lab.ann.ask("POST", "/v1/episodes/publish", {"group": "global"})
        path = dan.ask("POST", "/v1/tickets", {"recording": lab.recording})["path"]
        assert httpx.get(lab.url + path).status_code == 200
        dan.ask("PUT", "/v1/users/dan/password", {"password": "new password", "old": "dan's password"})
        assert httpx.get(lab.url + path).status_code == 401
        lab.ann.ask("POST", "/v1/episodes/publish", {"group": "global", "published": False})

    def test_the_end_of_a_sign_in_or_a_token_ends_tickets(self, lab: Lab) -> None:
        pair = httpx.post(
            f"{lab.url}/v1/tokens", json={"username": "ann", "password": "ann's password"}
        ).json()
        made = lab.ann.ask("POST", "/v1/api-tokens", {"name": "robot"})
        for token, end in (
            (pair["access_token"], ("POST", "/v1/tokens/end", {"refresh_token": pair["refresh_token"]})),
            (made["token"], ("DELETE", f"/v1/api-tokens/{made['id']}", None)),
        ):
            paths = []
            for address, told in (("/v1/tickets", {"recording": lab.recording}), ("/v1/query/tickets", {})):
                answer = httpx.post(lab.url + address, json=told, headers=bearer(token))
                paths.append(answer.json()["path"])
            inner = httpx.get(lab.url + paths[1]).json()["sources"][0]["url"]
            paths.append(f"/v1/{inner}")
            assert [httpx.get(lab.url + path).status_code for path in paths] == [200] * 3
            lab.ann.ask(*end)
            assert [httpx.get(lab.url + path).status_code for path in paths] == [401] * 3

    def test_a_manifest_makes_no_ticket_of_a_longer_life(self, lab: Lab) -> None:
        path = lab.ann.ask("POST", "/v1/query/tickets", {})["path"]
        time.sleep(1.1)  # lives are told in whole seconds
        inner = httpx.get(lab.url + path).json()["sources"][0]["url"]
        ends = [
            jwt.decode(each.partition("ticket=")[2], options={"verify_signature": False})["exp"]
            for each in (path, inner)
        ]
        assert ends[0] == ends[1]

    def test_a_machine_s_token_makes_no_more_of_itself(self, lab: Lab) -> None:
        made = lab.ann.ask("POST", "/v1/api-tokens", {"name": "robot", "scope": "write"})
        robot = Person(lab.url)
        robot.headers = bearer(made["token"])
        new = {"username": "ann", "password": "eve's password"}
        for method, path, told in (
            ("POST", "/v1/api-tokens", {"name": "another"}),
            ("PUT", "/v1/users/ann/password", {"password": "eve's password", "old": "ann's password"}),
            ("PUT", "/access/users/change-password", new),
            ("DELETE", "/v1/users/ann", None),
            ("DELETE", "/access/users/delete?username=ann", None),
        ):
            refused = robot.call(method, path, told)
            assert refused.status_code == 403 and "sign in with the password" in refused.text, path
        lab.ann.ask("DELETE", f"/v1/api-tokens/{made['id']}")

    def test_a_machine_s_token_makes_no_admin(self, lab: Lab) -> None:
        made = lab.admin.ask("POST", "/v1/api-tokens", {"name": "robot", "scope": "write"})
        robot = Person(lab.url)
        robot.headers = bearer(made["token"])
        member = {"user": "ann", "roles": ["admin"]}
        for method, path, told in (
            ("PUT", "/v1/groups/global/members", [member]),
            ("POST", "/access/groups/add-members", {"group_name": "global", "members": [member]}),
        ):
            refused = robot.call(method, path, told)
            assert refused.status_code == 403 and "sign in with the password" in refused.text, path
        lab.admin.ask("DELETE", f"/v1/api-tokens/{made['id']}")

    def test_the_secret_is_the_server_s_alone(self, lab: Lab) -> None:
        secret = lab.directory / "server" / "secret"
        assert (secret.stat().st_mode & 0o777, secret.parent.stat().st_mode & 0o777) == (0o600, 0o700)
        public = {"typ": "access", "sub": "admin", "epoch": 0, "exp": int(time.time()) + 60}
        for header in ({"kid": "../../../dev/null"}, {"jku": f"{lab.url}/v1/me"}, {"alg": "HS512"}):
            forged = jwt.encode(public, "\0" * 64, header.get("alg", "HS256"), headers=header)
            assert httpx.get(f"{lab.url}/v1/me", headers=bearer(forged)).status_code == 401


class TestRights:
    """A role that may do much with users or groups gets no further than that."""

    @pytest.fixture(scope="class")
    def managers(self, lab: Lab) -> tuple[Person, Person]:
        mia, gus = people(lab.admin, "mia", "gus")
        told = [{"user": "mia", "roles": ["user_admin"]}, {"user": "gus", "roles": ["group_admin"]}]
        lab.admin.ask("PUT", "/v1/groups/global/members", told)
        return mia, gus

    def test_who_manages_users_does_not_become_the_admin(self, lab: Lab, managers: Any) -> None:
        mia, _ = managers
        tries = [
            mia.call("PUT", "/v1/users/admin/password", {"password": "my password"}),
            mia.call(
                "PUT", "/access/users/change-password", {"username": "admin", "password": "my password"}
            ),
            mia.call("DELETE", "/v1/users/admin"),
            mia.call("DELETE", "/access/users/delete", params={"username": "admin"}),
            mia.call("PUT", "/v1/groups/global/members", [{"user": "mia", "roles": ["admin"]}]),
        ]
        assert {each.status_code for each in tries} <= {403, 404}
        assert Person(lab.url, "admin").ask("GET", "/v1/me")["memberships"][0]["roles"][-1] == "admin"
        people(mia, "new")
        mia.ask("PUT", "/v1/users/new/password", {"password": "other password"})
        mia.ask("DELETE", "/v1/users/new")

    def test_the_last_admin_stays(self, tmp_path: Path) -> None:
        """On every way, until there is another one."""
        with serving(Settings(tmp_path / "served")) as url:
            admin = Person(url, "admin")
            people(admin, "zoe")
            told = {"group_name": "global", "members": [{"user": "admin"}]}
            ways = (
                ("DELETE", "/v1/users/admin", None),
                ("DELETE", "/access/users/delete?username=admin", None),
                ("DELETE", "/v1/groups/global/members/admin", None),
                ("POST", "/access/groups/remove-members", told),
            )
            for way in ways:
                refused = admin.call(*way)
                assert refused.status_code == 403 and "the only admin" in refused.json()["detail"], way
            with httpx.Client(base_url=url, headers={"Accept": "text/html"}) as client:
                client.post("/sign-in", data={"username": "admin", "password": PASSWORD})
                found = re.search('name="code" value="([0-9a-f]+)"', client.get("/account").text)
                assert found is not None
                for path, sent in (
                    ("/users/delete", {"username": "admin"}),
                    ("/group/members/delete", {"name": "global", "user": "admin"}),
                ):
                    page = client.post(path, data={"code": found[1], **sent})
                    assert page.status_code == 403 and "the only admin" in page.text
            assert admin.ask("GET", "/v1/me")["memberships"][0]["roles"][-1] == "admin"
            admin.ask("PUT", "/v1/groups/global/members", [{"user": "zoe", "roles": ["admin"]}])
            admin.ask(*ways[2])
            zoe = Person(url, "zoe")
            zoe.ask(*ways[0])
            assert zoe.call("DELETE", "/v1/users/zoe").status_code == 403

    def test_who_manages_groups_does_not_lock_the_admin_out(self, lab: Lab, managers: Any) -> None:
        _, gus = managers
        tries = [
            gus.call("DELETE", "/v1/groups/global"),
            gus.call("DELETE", "/access/groups/delete", params={"group_name": "global"}),
            gus.call("DELETE", "/v1/groups/global/members/admin"),
            gus.call(
                "POST",
                "/access/groups/remove-members",
                {"group_name": "global", "members": [{"user": "admin"}]},
            ),
            gus.call("PUT", "/v1/groups/global/members", [{"user": "gus", "roles": ["admin"]}]),
            lab.admin.call("DELETE", "/v1/groups/global"),
        ]
        assert {each.status_code for each in tries} == {403}
        assert lab.admin.call("GET", "/v1/roles").status_code == 200


class TestShares:
    """What all users share: names, and indexes of keys. One user leaves enough for the others."""

    def test_names_of_groups(self, lab: Lab) -> None:
        made = [lab.eve.call("POST", "/v1/groups", {"name": f"squat{i}"}).status_code for i in range(100)]
        assert made.count(200) > 90  # she may have made some before
        for name in ("squat0", "squat1"):  # whose names stay taken
            lab.eve.ask("DELETE", f"/v1/groups/{name}")
        for path in ("/v1/groups", "/access/groups/create"):
            refused = lab.eve.call("POST", path, {"name": "robots"})
            assert refused.status_code == 400 and "at most 100 times create_group by eve" in refused.text
        lab.ann.ask("POST", "/v1/groups", {"name": "robots"})

    def test_names_that_look_alike(self, lab: Lab) -> None:
        lab.ann.ask("POST", "/v1/groups", {"name": "Lab élan 2"})
        alike = [
            "lab élan 2",
            "Lab elan 2",
            "Lab  élan 2 ",
            "Ｌａｂ élan 2",
            "Lab\u3164élan\u28002",
            "Lab e\u0301lan 2",
        ]
        for name in (*alike, "ANN", "ａｎｎ", "Global", "glo\u0307bal"):
            for path in ("/v1/groups", "/access/groups/create"):
                refused = lab.ann.call("POST", path, {"name": name})
                assert refused.status_code == 409, (name, refused.text)
        for name in ("Ann", "EVE", "Admin"):
            told = {"username": name, "password": f"{name}'s password"}
            assert lab.admin.call("POST", "/v1/users", told).status_code == 409, name
        for name in ("\u3164", "\u2800\u0301"):
            refused = lab.ann.call("POST", "/v1/groups", {"name": name})
            assert refused.status_code == 400 and "expected a group name" in refused.text
        lab.ann.ask("POST", "/v1/groups", {"name": "Lab élan 3"})

    def test_declared_keys(self, lab: Lab) -> None:
        for i in range(10):
            lab.eve.ask("POST", "/v1/episodes/keys", {"key": f"metadata.squat{i}"})
        refused = lab.eve.call("POST", "/v1/episodes/keys", {"key": "metadata.more"})
        assert refused.status_code == 400 and "at most 10 times declare_key by eve" in refused.text
        lab.eve.ask("POST", "/v1/episodes/keys", {"key": "metadata.squat3"})  # which is there
        for person in (lab.ann, lab.admin):
            person.ask("POST", "/v1/episodes/keys", {"key": f"metadata.of_{person.name}"})

    def test_guesses_at_once(self, lab: Lab) -> None:
        """Of guesses that arrive together, no more than ten tell whether they were right."""
        (dan,) = people(lab.admin, "guessed")

        def guess(number: int) -> int:
            told = {"username": "guessed", "password": f"guess {number}"}
            return httpx.post(f"{lab.url}/v1/tokens", json=told, timeout=120).status_code

        def change(number: int) -> int:
            told = {"password": "my new password", "old": f"guess {number}"}
            return dan.call("PUT", "/v1/users/guessed/password", told).status_code

        with ThreadPoolExecutor(30) as pool:
            assert sorted(pool.map(guess, range(30))) == [401] * 10 + [429] * 20
            assert sorted(pool.map(change, range(30))) == [403] * 10 + [429] * 20
        right = {"username": "guessed", "password": "guessed's password"}
        assert httpx.post(f"{lab.url}/v1/tokens", json=right).status_code == 429  # also who guesses right

    def test_right_passwords_at_once(self, lab: Lab) -> None:
        people(lab.admin, "many")
        with ThreadPoolExecutor(30) as pool:
            signed_in = list(pool.map(lambda _: Person(lab.url, "many"), range(30)))
        assert len({each.headers["Authorization"] for each in signed_in}) == 30

    @pytest.mark.parametrize("path", ["/v1/users", "/access/users/create", "/sign-in"])
    def test_sign_ups(self, path: str, tmp_path: Path) -> None:
        """Each takes the time of a core; names that are taken stay so."""
        with serving(Settings(tmp_path / "served", open_signup=True)) as url:
            told = {"username": "squat", "password": "short", "new": "true"}
            body = {"data": told} if path == "/sign-in" else {"json": told}
            statuses = [httpx.post(url + path, **body).status_code for _ in range(61)]  # type: ignore[arg-type]
            assert statuses == [400] * 60 + [429]
            people(Person(url, "admin"), "ann")  # who has the right to make users

    def test_tokens_for_machines(self, lab: Lab) -> None:
        made = [lab.eve.call("POST", "/v1/api-tokens", {"name": "robot"}) for _ in range(101)]
        assert made[-1].status_code == 400 and "at most 100 tokens of eve" in made[-1].text
        for each in made[:100]:
            if each.status_code == 200:
                lab.eve.ask("DELETE", f"/v1/api-tokens/{each.json()['id']}")


class TestInjection:
    @pytest.mark.sampled(12)
    @pytest.mark.parametrize("text", TEXTS, ids=repr)
    def test_of_ids_names_keys_and_orders(self, lab: Lab, text: str) -> None:
        """Nothing but a refusal, and nothing of ann's."""
        quoted = quote(text, safe="")
        answers = [
            *(lab.eve.call("GET", path.format(quoted)) for path in (
                "/v1/benchmarks/{}", "/v1/artifacts/{}", "/v1/files/{}", "/v1/episodes/{}.rrd", "/v1/groups/{}",
                "/episode/{}", "/dataset/{}", "/cover/{}", "/static/{}", "/viewer/0/{}", "/v1/files/recordings/{}",
            )),
            *(lab.eve.call("DELETE", path.format(quoted)) for path in (
                "/v1/benchmarks/{}", "/v1/episodes/{}", "/v1/uploads/{}", "/v1/api-tokens/{}", "/v1/users/{}",
            )),
            *(lab.eve.call("GET", path, params={name: text}) for path, name in (
                ("/benchmarks/load", "benchmark_id"), ("/artifacts/download", "artifact_id"),
                ("/access/groups/read", "group_name"), ("/v1/manifest", "filter"), ("/v1/manifest", "recording"),
                ("/v1/manifest", "ticket"), ("/v1/data", "id"),
            )),
            lab.eve.call("POST", "/v1/tickets", {"recording": text}),
            lab.eve.call("POST", "/v1/episodes/keys", {"key": text}),
            lab.eve.call("POST", "/v1/episodes/keys", {"key": f"{text}.{text}"}),
            lab.eve.call("POST", "/v1/query", {"recordings": [text]}),
            lab.eve.call("PUT", f"/v1/episodes/{lab.episodes[0]}/published", params={"group": text}),
            lab.eve.call("POST", "/v1/episodes/list", {"cursor": text}),
            lab.eve.call("POST", "/v1/episodes/list", {"sort": text}),
            lab.eve.call("POST", "/v1/tokens", {"username": text, "password": text}),
            lab.eve.call("POST", "/v1/tokens/refresh", {"refresh_token": text}),
        ]  # fmt: skip
        assert [a for a in answers if a.status_code >= 500 or a.status_code < 300] == []
        assert not [a for a in answers if "x-evil" in a.headers or lab.recording in a.text]

    @pytest.mark.sampled(12)
    @pytest.mark.parametrize("text", TEXTS, ids=repr)
    def test_of_filters(self, lab: Lab, text: str) -> None:
        key = f"metadata.{text}"
        for wanted in (
            {"type": "EQ", "key": "recording", "value": text},
            {"type": "IN", "key": "id", "value": [text, lab.episodes[0]]},
            {"type": "EQ", "key": key, "value": text},
            {"type": "GEQ", "key": key, "value": 0},
            {"type": "EQ", "key": text, "value": text},
            {"type": "EQ", "key": "published_in", "value": "ann"},
            {"type": "NE", "key": "created_by", "value": text},
        ):
            for path in ("/v1/episodes/list", "/v1/benchmarks/list", "/v1/artifacts/list"):
                answer = lab.zoe.call("POST", path, {"filter": wanted})
                assert answer.status_code == 400 or answer.json()["items"] == [], wanted
            counted = lab.zoe.call("POST", "/v1/episodes/count", {"filter": wanted})
            assert counted.status_code == 400 or counted.json() == 0
            deleted = lab.zoe.call("POST", "/v1/episodes/delete", {"filter": wanted})
            assert deleted.status_code == 400 or deleted.json() == {"episodes": 0}
            told = lab.zoe.call("POST", "/episodes/list", wanted)
            assert told.status_code == 400 or told.json() == []
        assert lab.ann.ask("POST", "/v1/episodes/count", {}) >= len(lab.episodes)

    @pytest.mark.sampled(
        4, keep=[f'{ENGINES[1]}-"x\'); DROP TABLE episode; --"', rf"{ENGINES[0]}-'\\r\\nX-Evil: 1'"]
    )
    @pytest.mark.parametrize("text", TEXTS, ids=repr)
    def test_of_the_pages(self, lab: Lab, text: str) -> None:
        for person in (lab.ann, lab.eve):
            with httpx.Client(base_url=lab.url, follow_redirects=False) as client:
                told = {"username": person.name, "password": f"{person.name}'s password"}
                assert client.post("/sign-in", data=told).status_code == 303
                for path, name in (
                    ("/", "q"), ("/episodes", "filter"), ("/episodes", "sort"), ("/episodes", "dataset"),
                    ("/download", "filter"), ("/compare", "episode"), ("/share", "dataset"), ("/group", "name"),
                    ("/sparks", "episode"), ("/viewer", "episode"),
                ):  # fmt: skip
                    answer = client.get(path, params={name: text})
                    assert answer.status_code < 500, (path, name, text)
                    assert "x-evil" not in answer.headers
                    assert text.count("DROP") == 0 or f">{text}<" not in answer.text

    @pytest.mark.sampled(9)
    @pytest.mark.parametrize(
        "told",
        [
            {"offset": 1 << 63}, {"offset": 10**30}, {"limit": 10**30}, {"limit": -1},
            {"cursor": base64.urlsafe_b64encode(f'["x", {10**30}]'.encode()).decode()},
            {"cursor": base64.urlsafe_b64encode(b'["x", 1e400]').decode()},
            {"cursor": base64.urlsafe_b64encode(b"[" * 9999).decode()},
            {"cursor": base64.urlsafe_b64encode(f'["x", {(1 << 63) - 1}]'.encode()).decode(), "sort": "return"},
            {"filter": {"type": "EQ", "key": "steps", "value": 10**300}},
            {"filter": {"type": "EQ", "key": "steps", "value": "\ud800"}},
        ],
        ids=lambda told: str(told)[:40],
    )  # fmt: skip
    def test_of_numbers_and_texts_that_no_database_holds(self, lab: Lab, told: dict[str, Any]) -> None:
        for kind in ("episodes", "benchmarks", "artifacts"):
            body = json.dumps(told)
            headers = {"Content-Type": "application/json"}
            answer = lab.eve.call("POST", f"/v1/{kind}/list", content=body, headers=headers)
            assert answer.status_code in (200, 400, 404), (kind, answer.text)

    def test_of_values_that_json_lacks_in_every_body(self, lab: Lab) -> None:
        """Strangers and users are told what is wrong, and are not sent their bodies back."""
        document = httpx.get(f"{lab.url}/openapi.json", timeout=120).json()
        text = '"\\ud800 a long text"'
        bodies = ("NaN", text, f'{{"zz": NaN, "password": {text}}}', f'[{{"user": NaN, "roles": [{text}]}}]')
        headers = {"Content-Type": "application/json"}
        asked = [(path, method) for path, of in document["paths"].items() for method in of if method != "get"]
        for (path, method), person, body in itertools.product(asked, (Person(lab.url), lab.eve), bodies):
            answer = person.call(method, re.sub("{.*}", "x", path), content=body, headers=headers)
            assert answer.status_code < 500 and "long text" not in answer.text, (path, body, answer.text)
        told = lab.eve.call("POST", "/access/users/token", content="NaN", headers=headers)
        assert told.status_code == 422
        assert told.json()["detail"][0].keys() == {"type", "loc", "msg"}

    def test_of_lone_surrogates_in_names_and_passwords(self, lab: Lab) -> None:
        headers = {"Content-Type": "application/json"}

        def ask(method: str, path: str, told: object) -> httpx.Response:
            return lab.admin.call(method, path, content=json.dumps(told), headers=headers)

        new = {"username": "surrogate", "password": "\ud800 is my password"}
        for refused in (
            ask("POST", "/v1/users", new),
            ask("POST", "/access/users/create", new),
            ask("PUT", "/v1/users/eve/password", {"password": new["password"]}),
            ask("PUT", "/access/users/change-password", {**new, "username": "eve"}),
        ):
            assert refused.status_code == 400 and "found a lone surrogate" in refused.json()["detail"]
        given = ask("PUT", "/v1/groups/global/members", [{"user": "eve", "roles": ["\ud800"]}])
        assert (given.status_code, given.json()["detail"]) == (404, "Role \ud800 not found")

    def test_of_names_of_users_and_groups(self, lab: Lab) -> None:
        for text in TEXTS:
            made = lab.admin.call("POST", "/v1/users", {"username": text, "password": "a password"})
            assert made.status_code == 400, text
            group = lab.eve.call("POST", "/v1/groups", {"name": text})
            assert group.status_code in (200, 400), text
            if group.status_code == 200:
                assert text.isprintable() and "/" not in text
                assert lab.eve.ask("GET", f"/v1/groups/{quote(text, safe='')}")["name"] == text
                lab.eve.ask("DELETE", f"/v1/groups/{quote(text, safe='')}")
        assert lab.ann.ask("POST", "/v1/episodes/count", {}) >= len(lab.episodes)


def test_log_lines_and_terminals(tmp_path: Path) -> None:
    """What is told to the log comes from strangers: it stays one line, without escapes."""
    with served(tmp_path / "served") as server:
        for text in ("\x1b]0;evil\x07", '\n{"event": "request", "user": "admin"}', "\u009b31m", "\u202e"):
            person = Person(server.url)
            person.call("POST", "/v1/tokens", {"username": text, "password": text})
            person.call("GET", f"/v1/files/{quote(text)}", params={"ticket": text})
            person.call("GET", "/health", headers={"User-Agent": "{evil}", "X-Forwarded-For": "evil"})
            with socket.create_connection(("127.0.0.1", server.port)) as connection:
                connection.sendall(b"GET /\x1b[31m HTTP/1.1\r\nHost: \x1b[31m\r\n\r\n")
                connection.recv(1000)
        server.stop()
        server.wait()
        lines = server.log()
    assert len([line for line in lines if line["event"] == "request"]) >= 8
    assert all(line.get("address", "127.0.0.1") == "127.0.0.1" and line.get("user") is None for line in lines)
    assert not set("\x1b\x9b\x07\u202e") & set(server.log_file.read_text())


def test_a_failure_in_the_log_holds_nothing_of_the_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(connection: object, name: str, password: str) -> bool:
        try:
            raise ValueError(f"{name} {password}")
        except ValueError as err:
            err.add_note(password)
            raise RuntimeError(password) from err

    for logger in (logging.getLogger(), logs.LOG):
        monkeypatch.setattr(logger, "handlers", logger.handlers)
        monkeypatch.setattr(logger, "level", logger.level)
    monkeypatch.setattr(accounts, "verify_password", broken)
    with serving(Settings(tmp_path / "served")) as url:
        logs.set_up()
        told = {"username": "MYNAME", "password": "MYSECRET" + "A" * 100_000}
        assert Person(url).call("POST", "/v1/tokens", told).status_code == 500
    logging.captureWarnings(False)
    lines = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    (failed,) = [line for line in lines if line["event"] == "failed"]
    assert "MYNAME" not in str(lines) and "MYSECRET" not in str(lines) and len(str(lines)) < 50_000
    assert failed["route"] == "/v1/tokens"
    trace = failed["exception"]
    assert re.search(r"library\.py:\d+, in sign_in: .*\n.*test_server_attacks\.py:\d+, in broken", trace)
    assert "builtins.ValueError\nwhich led to:\n" in trace and trace.endswith("builtins.RuntimeError")


class TestPages:
    def test_scripts_in_texts_and_framing(self, lab: Lab, tmp_path: Path) -> None:
        robot(tmp_path / "robot.mcap", text=EVIL)
        lab.ann.send((tmp_path / "robot.mcap").read_bytes())
        with httpx.Client(base_url=lab.url, headers={"Accept": "text/html"}, timeout=60) as client:
            client.post("/sign-in", data={"username": "ann", "password": "ann's password"})
            ids = [e["id"] for e in client.get("/episodes?format=json").json()["episodes"]]
            two = "&".join(f"episode={uri}" for uri in ids[:2])
            pages = [
                "/",
                "/episodes",
                "/dataset/-",
                f"/compare?{two}",
                "/account",
                "/groups",
                "/upload",
                "/share?dataset=-",
            ]
            pages += [f"/episode/{uri}" for uri in ids] + ["/nothing", "/episode/nothing"]
            seen = 0
            for path in pages:
                answer = client.get(path)
                assert answer.headers["X-Content-Type-Options"] == "nosniff", path
                if answer.headers["Content-Type"].startswith("text/html"):
                    policy = answer.headers["Content-Security-Policy"]
                    assert "frame-ancestors 'none'" in policy and "script-src" not in policy, path
                    assert "unsafe" not in policy, path
                assert "<script>document" not in answer.text and "<img src=x" not in answer.text, path
                seen += EVIL in html.unescape(answer.text)
            assert seen > 3
        for path in ("/v1/me", f"/v1/artifacts/{lab.artifact}"):
            answer = lab.ann.call("GET", path)
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert "html" not in answer.headers["Content-Type"]


class TestEnumeration:
    def test_by_text(self, lab: Lab) -> None:
        (ned,) = people(lab.admin, "ned")
        tries = {
            name: [
                httpx.post(f"{lab.url}/v1/tokens", json={"username": name, "password": "x"}),
                httpx.post(f"{lab.url}/access/users/token", json={"username": name, "password": "x"}),
                httpx.get(f"{lab.url}/v1/users"),
                httpx.put(f"{lab.url}/v1/users/{name}/password", json={"password": "x"}),
                ned.call("PUT", f"/v1/users/{name}/password", {"password": "x"}),
                ned.call("DELETE", f"/v1/users/{name}"),
                ned.call("PUT", f"/v1/users/{name}/quota", {"bytes": 1}),
                ned.call("GET", f"/v1/groups/{name}"),
            ]
            for name in ("eve", "nobody")
        }
        there, not_there = (
            [(answer.status_code, answer.text.replace(name, "NAME")) for answer in answers]
            for name, answers in tries.items()
        )
        assert there == not_there

    def test_by_time(self, tmp_path: Path) -> None:
        """A wrong password costs as much where there is no such user: the hash is what takes the time."""
        taken: dict[str, list[float]] = {"ann": [], "nobody": []}
        with serving(Settings(tmp_path / "served"), hashes=REAL_HASHES) as url:
            people(Person(url, "admin"), "ann")
            for _ in range(7):
                for name, seconds in taken.items():
                    begun = time.process_time()  # of the server, which runs in this process, too
                    answer = httpx.post(f"{url}/v1/tokens", json={"username": name, "password": "wrong"})
                    seconds.append(time.process_time() - begun)
                    assert answer.status_code == 401
        there, not_there = (min(seconds) for seconds in taken.values())
        assert 0.5 < there / not_there < 2, statistics.median(taken["ann"])


class TestFiles:
    def test_names_that_lead_elsewhere(self, tmp_path: Path) -> None:
        """Names in an upload and in a request: nothing from outside is read, nothing written there."""
        record_rollouts("CartPole-v1", tmp_path / "secret.mcap", steps=20, seed=5)
        outside = tmp_path / "outside"
        outside.mkdir()
        with serving(Settings(tmp_path / "served")) as url:
            (eve,) = people(Person(url, "admin"), "eve")
            place = tmp_path / "served" / "server" / "uploads"
            data = (tmp_path / "secret.mcap").read_bytes()
            begun = eve.begin(data)
            number = begun.headers["Location"].rpartition("/")[2]
            assert set(number) <= set("0123456789abcdef") and place.stat().st_mode & 0o077 == 0o055
            names = base64.b64encode(b"../../../outside/evil.mcap").decode()
            told = announced(data)
            told["Upload-Metadata"] += f",filename {names},filetype {names},relativePath {names}"
            assert eve.call("POST", "/v1/uploads", headers=told).headers["Location"].endswith(number)
            metadata = base64.b64encode(
                json.dumps({"name": "../../outside/evil", "extra": {"path": "/"}}).encode()
            )
            eve.ask("POST", "/v1/artifacts", headers={"Artifact-Metadata": metadata.decode()}, content=b"x")
            eve.send(data)
            for path in (
                "recordings/../../secret.mcap",
                "../secret.mcap",
                f"{tmp_path}/secret.mcap",
                "server/secret",
            ):
                assert eve.call("POST", "/v1/tickets", {"recording": path}).status_code == 404
                assert eve.call("GET", f"/v1/files/{quote(path)}").status_code in (404, 307), path
        assert list(outside.iterdir()) == []
        written = [
            path for path in (tmp_path / "served").rglob("*") if path.is_symlink() or "evil" in path.name
        ]
        assert written == []

    def test_the_benchmark_that_a_recording_names_leads_nowhere(self, tmp_path: Path) -> None:
        """Its id is part of the name under which a file is kept."""
        record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=20, seed=5)
        settings = Settings(tmp_path / "lab" / "served", pending_seconds=0)
        with serving(settings) as url, Recording(tmp_path / "run.mcap") as run:
            (eve,) = people(Person(url, "admin"), "eve")
            for uri in ("../../../outside", "x\0y", "a" * 300, f"{tmp_path}/outside"):
                path = tmp_path / "evil.mcap"
                rewrite_recording(run, path, benchmark_id=uri)
                data = path.read_bytes()
                begun, headers = eve.begin(data), {"Upload-Offset": "0"}
                sent = eve.call("PATCH", begun.headers["Location"], headers=headers, content=data)
                assert (sent.status_code, sent.json()["error"]) == (404, "NotFoundError"), uri
                path.unlink()
        assert {path.name for path in tmp_path.iterdir()} == {"lab", "run.mcap"}
        assert not (settings.directory / "recordings").exists()
        Library(settings).close()  # which cleans up

    def test_no_proxy_keeps_an_answer_for_others(self, lab: Lab) -> None:
        ticket = lab.ann.ask("POST", "/v1/tickets", {"recording": lab.recording})["path"]
        for path in ("/v1/me", f"/v1/files/{lab.recording}", f"/v1/artifacts/{lab.artifact}", "/v1/manifest"):
            answer = lab.ann.call("GET", path)
            assert (answer.status_code, answer.headers["cache-control"]) == (200, "private, no-cache")
        answer = httpx.get(lab.url + ticket)
        assert (answer.status_code, answer.headers["cache-control"]) == (200, "private, no-cache")
        assert httpx.get(f"{lab.url}/v1/me").headers["cache-control"] == "private, no-cache"

    def test_addresses_that_are_given_to_it_are_not_asked(self, lab: Lab, tmp_path: Path) -> None:
        """A listener nobody connects to, though its address stands wherever a request or a file can carry one."""
        with socket.create_server(("127.0.0.1", 0)) as listener:
            bait = f"http://127.0.0.1:{listener.getsockname()[1]}/x.mcap"
            robot(tmp_path / "bait.mcap", text=bait, images=False)
            name = lab.eve.send((tmp_path / "bait.mcap").read_bytes())
            told = {"name": bait, "extra": {"url": bait, "benchmark_id": bait}}
            lab.eve.ask(
                "POST", "/v1/artifacts", content=b"x",
                headers={"Artifact-Metadata": base64.b64encode(json.dumps(told).encode()).decode()},
            )  # fmt: skip
            headers = {"Host": bait[7:-7], "Origin": bait, "Referer": bait, "Forwarded": f"host={bait}",
                       "X-Forwarded-Host": bait[7:-7], "X-Accel-Redirect": bait, "X-Original-URL": bait}  # fmt: skip
            for method, path, body in (
                ("POST", "/v1/tickets", {"recording": bait}),
                ("POST", "/v1/query", {"recordings": [bait]}),
                ("POST", "/v1/query", {"recordings": [name]}),
                ("POST", "/v1/benchmarks", {"hash": "h", "serialized": bait, "metadata": {"name": bait}}),
                ("POST", "/episodes/record", {"benchmark_id": bait, "metadata": {}, "tuples": []}),
                ("GET", f"/v1/files/{bait}", None),
                ("GET", f"/v1/files/{quote(bait, safe='')}", None),
                ("GET", f"/v1/manifest?recording={quote(bait)}", None),
                ("GET", f"/sign-in?next={quote(bait)}", None),
                ("GET", "/v1/me", None),
            ):
                assert lab.eve.call(method, path, body, headers=headers).status_code < 500, path
            with httpx.Client(base_url=lab.url, timeout=60) as client:
                client.post("/sign-in", data={"username": "eve", "password": "eve's password"})
                for header in client.get("/episodes?format=json").json()["episodes"]:
                    assert (
                        client.get(f"/episode/{header['id']}", headers={"X-Forwarded-Host": bait}).status_code
                        == 200
                    )
            listener.settimeout(0.2)
            with pytest.raises(TimeoutError):
                listener.accept()


class TestSizes:
    def test_long_texts_that_everybody_s_lists_would_hold(self, lab: Lab) -> None:
        long, content = {"name": "x", "extra": {"a": "y" * 70_000}}, {"data": ("x", b"long")}
        told = {"hash": "h", "serialized": "x", "metadata": long}
        form: dict[str, Any] = {"files": content, "data": {"metadata": json.dumps(long)}}
        header = base64.b64encode(json.dumps(long).encode()).decode()
        for path, body, more in (
            ("/v1/benchmarks", told, {}),
            ("/benchmarks/create", told, {}),
            ("/artifacts/upload", None, form),
            ("/v1/artifacts", None, {"content": b"long", "headers": {"Artifact-Metadata": header}}),
        ):
            refused = lab.eve.call("POST", path, body, **more)
            assert refused.status_code == 413 and "at most 65536 bytes" in refused.text, path
        for path in ("/v1/groups", "/access/groups/create"):
            refused = lab.eve.call("POST", path, {"name": "long", "description": "d" * 1001})
            assert refused.status_code == 400 and "at most 1000 characters" in refused.text, path
        role = {"role": "long", "rights": [], "description": "d" * 1001}
        assert lab.admin.call("POST", "/v1/roles", role).status_code == 400

    def test_a_quota_holds_for_requests_at_once(self, tmp_path: Path) -> None:
        with serving(Settings(tmp_path / "served", quota=1_000_000)) as url:
            (eve,) = people(Person(url, "admin"), "eve")

            def store(number: int) -> int:
                told = {"Artifact-Metadata": base64.b64encode(b'{"name": "x"}').decode()}
                content = bytes([number]) * 900_000
                return eve.call("POST", "/v1/artifacts", headers=told, content=content).status_code

            with ThreadPoolExecutor(8) as pool:
                assert sorted(pool.map(store, range(8))) == [200, *[507] * 7]
            assert 900_000 < eve.ask("GET", "/v1/me")["used"] < 901_000  # with its header
        assert len(list((tmp_path / "served" / "artifacts").iterdir())) == 1

    def test_a_quota_holds_for_episodes_at_once(self, tmp_path: Path) -> None:
        with serving(Settings(tmp_path / "served")) as url:
            (eve,) = people(admin := Person(url, "admin"), "eve")
            benchmark = eve.ask("POST", "/v1/benchmarks", cart_benchmark())["id"]
            step = {"state": [0.0] * 4, "action": 0, "reward": 1.0}
            told = {"benchmark_id": benchmark, "metadata": {}, "tuples": [{**step, "terminal": True}]}

            def record(_: object) -> int:
                return eve.call("POST", "/episodes/record", told).status_code

            used = eve.ask("GET", "/v1/me")["used"]
            assert record(None) == 200
            size = eve.ask("GET", "/v1/me")["used"] - used
            quota = {"bytes": used + 2 * size + size // 2}
            admin.ask("PUT", "/v1/users/eve/quota", quota)
            with ThreadPoolExecutor(8) as pool:
                assert sorted(pool.map(record, range(8))) == [200, *[507] * 7]
            assert eve.ask("GET", "/v1/me")["used"] <= quota["bytes"]
            assert eve.ask("POST", "/v1/episodes/count", {}) == 2
        assert len(list((tmp_path / "served" / "recordings").rglob("*.mcap"))) == 2

    def test_long_metadata_of_episodes_and_runs(self, lab: Lab, tmp_path: Path) -> None:
        """A list holds the metadata of a thousand episodes, and the facts of the run of each."""
        box, long = spaces.Box(-1, 1, (1,)), {"text": "x" * 70_000}
        for kind in ("episode", "run"):
            path = tmp_path / f"{kind}.mcap"
            of_run = long if kind == "run" else None
            with EpisodeWriter(path, box, spaces.Discrete(2), metadata=of_run) as writer:
                writer.begin(metadata=long if kind == "episode" else {})
                writer.step(np.zeros(1, np.float32), 0, reward=1.0, terminal=True)
                writer.end(np.zeros(1, np.float32))
            begun = lab.eve.begin(path.read_bytes())
            told = {"headers": {"Upload-Offset": "0"}, "content": path.read_bytes()}
            refused = lab.eve.call("PATCH", begun.headers["Location"], **told)
            assert refused.status_code == 413 and "at most 65536 characters" in refused.text, kind

    def test_members_of_a_group_without_an_end(self, lab: Lab) -> None:
        """All who write would wait for them."""
        lab.ann.ask("POST", "/v1/groups", {"name": "endless"})
        many = [{"user": "eve", "roles": ["member"]}] * 1001
        for method, path, told in (
            ("PUT", "/v1/groups/endless/members", many),
            ("PUT", "/v1/groups/endless/members", [{"user": "eve", "roles": ["member"] * 1000}]),
            ("POST", "/access/groups/add-members", {"group_name": "endless", "members": many}),
            ("POST", "/access/groups/remove-members", {"group_name": "endless", "members": many}),
        ):
            refused = lab.ann.call(method, path, told)
            assert refused.status_code == 400 and "at most 1000 members and roles" in refused.text, path
        found = lab.ann.ask("PUT", "/v1/groups/endless/members", many[:500])
        assert found["members"] == ["ann", "eve"]

    def test_a_recording_whose_run_is_damaged_is_stored(self, lab: Lab, tmp_path: Path) -> None:
        """Such a run is named after its file, here as elsewhere."""
        path = tmp_path / "run.mcap"
        record_rollouts("CartPole-v1", path, steps=20, seed=6)
        add_attachments(path, {"run.json": ("application/json", b'{"runs": 3}')})
        with pytest.warns(UserWarning, match="the run is not known"):
            name = lab.eve.send(path.read_bytes())
        wanted = {"filter": {"type": "EQ", "key": "recording", "value": name}}
        first, *_ = lab.eve.ask("POST", "/v1/episodes/list", wanted)["items"]
        assert first["run"]["name"] == name.rpartition("/")[2].removesuffix(".mcap")

    def test_a_head_without_an_end(self, lab: Lab) -> None:
        parts = urlsplit(lab.url)
        with socket.create_connection((parts.hostname, parts.port or 0)) as connection:
            connection.sendall(b"GET /health HTTP/1.1\r\nHost: x\r\n")
            with pytest.raises(OSError, match="reset|pipe"):
                for _ in range(64):
                    connection.sendall(b"X-A: " + b"a" * (1 << 20) + b"\r\n")
        long = httpx.get(f"{lab.url}/health", headers={"X-A": "a" * 60_000})
        assert long.status_code == 200

    @pytest.mark.sampled(3)
    @pytest.mark.parametrize(
        "claim", [None, 1 << 30, 1 << 62], ids=["claims little", "claims it", "claims more"]
    )
    def test_a_compressed_bomb(self, lab: Lab, tmp_path: Path, claim: int | None) -> None:
        """A chunk that decompresses to a gibibyte, and says so or not: who sent it is refused, others are served."""
        path = tmp_path / "run.mcap"
        record_rollouts("CartPole-v1", path, steps=2000, seed=3)
        made = with_bomb(path.read_bytes(), claim)
        process = psutil.Process()
        before, most = process.memory_info().rss, 0
        begun = lab.eve.begin(made)
        sent = lab.eve.call("PATCH", begun.headers["Location"], headers={"Upload-Offset": "0"}, content=made)
        assert sent.status_code in (204, 400), sent.text
        if sent.status_code == 204:
            name = sent.headers["Recording"]
            wanted = {"type": "EQ", "key": "recording", "value": name}
            listed = lab.eve.call("POST", "/episodes/list", {**wanted, "include_tuples": True})
            assert listed.status_code == 400, listed.text[:200]
            with contextlib.suppress(httpx.RemoteProtocolError):  # the answer has begun, and is broken off
                cut = lab.eve.call("POST", "/v1/query", {"recordings": [name], "fields": ["actions"]})
                assert cut.status_code == 400, cut.text[:200]
            most = process.memory_info().rss
            lab.eve.ask("POST", "/v1/episodes/delete", {"filter": wanted})
        assert most - before < 300 << 20
        assert lab.ann.call("GET", f"/v1/artifacts/{lab.artifact}").content == b"wind"


def with_bomb(data: bytes, claim: int | None) -> bytes:
    """A recording whose first chunk is a bomb, with checksums and an index that are right."""
    model = Model.of(data)
    part = model.chunks()[0]
    part.size = claim
    part.packed = lambda _: zstandard.compress(b"\0" * (1 << 30))
    return model.encode()
