"""Who may do what with an item of somebody else: every route that names one, each role, private or published; and what
lists and queries give to each.

The routes come from the OpenAPI document: an operation that is neither in this table nor in NO_ITEM fails it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import httpx
import pytest
from persons import Person, cart_benchmark
from serving import ENGINES, serving, settings_of

from tupli_mcap import Recording, merge_recordings
from tupli_mcap.wrappers.rollout import record_rollouts

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3

ROLES = ("user", "member", "contributor", "user_admin", "group_admin", "content_admin", "admin")
LAB = "lab"  # a group of ann and the colleague
AUDIENCES = (None, "global", LAB)  # where a thing may be published
MAY_DELETE = ("content_admin", "admin")
METADATA = {"Artifact-Metadata": "eyJuYW1lIjogIndpbmQifQ=="}  # {"name": "wind"}
GROUP = dict.fromkeys(("group", "publish_in", "unpublish_from"), "global")

# The other operations, by the reason: what they name is no item, is the caller's own, or is selected by a filter from
# what the caller may read.
NO_ITEM = {
    "the server": "GET /health, GET /ready, GET /metrics",
    "sign-ins": "POST /v1/tokens, POST /v1/tokens/refresh, POST /v1/tokens/end, GET /v1/api-tokens, "
    "POST /v1/api-tokens, DELETE /v1/api-tokens/{token}, POST /access/users/token, POST /access/users/refresh-token",
    "users": "GET /v1/me, GET /v1/users, POST /v1/users, DELETE /v1/users/{username}, "
    "PUT /v1/users/{username}/quota, PUT /v1/users/{username}/password, POST /access/users/create, "
    "GET /access/users/list, DELETE /access/users/delete, PUT /access/users/change-password",
    "groups": "GET /v1/groups, POST /v1/groups, GET /v1/groups/{name}, DELETE /v1/groups/{name}, "
    "PUT /v1/groups/{name}/members, DELETE /v1/groups/{name}/members/{user}, POST /access/groups/create, "
    "GET /access/groups/list, GET /access/groups/read, DELETE /access/groups/delete, "
    "POST /access/groups/add-members, POST /access/groups/remove-members",
    "roles": "GET /v1/roles, POST /v1/roles, DELETE /v1/roles/{role_name}, POST /access/roles/create, "
    "GET /access/roles/list, DELETE /access/roles/delete",
    "new items": "POST /v1/benchmarks, POST /v1/artifacts, POST /v1/uploads, OPTIONS /v1/uploads, "
    "POST /benchmarks/create, POST /artifacts/upload, POST /episodes/record",
    "the caller's uploads": "HEAD /v1/uploads/{upload_id}, PATCH /v1/uploads/{upload_id}, "
    "DELETE /v1/uploads/{upload_id}",
    "lists": "POST /v1/benchmarks/list, POST /v1/artifacts/list, POST /v1/episodes/list, POST /v1/episodes/count, "
    "GET /v1/episodes/deleted, POST /v1/episodes/keys, POST /benchmarks/list, POST /artifacts/list, "
    "POST /episodes/list",
    "queries": "POST /v1/episodes/delete, POST /v1/episodes/publish, POST /v1/share, POST /v1/query, "
    "POST /v1/query/tickets, GET /v1/manifest, GET /v1/data",
}


class Route(NamedTuple):
    """method, path. kind: of what it names one; name: the parameter of the query, or of a body, that does, if it is not
    the path."""

    method: str
    path: str
    kind: str
    name: str

    @property
    def is_ours(self) -> bool:
        return self.path.startswith("/v1/")

    @property
    def verb(self) -> str:
        if self.method in ("GET", "HEAD") or self.path == "/v1/tickets":
            return "read"
        if "publish" in self.path:
            return "unpublish" if "unpublish" in self.path or self.method == "DELETE" else "publish"
        assert self.method == "DELETE", self
        return "delete"

    def ask(self, person: Person, item: str) -> httpx.Response:
        """The answer to a person who asks for an item."""
        told = {self.name: item} if self.name else {}
        body = told if self.method == "POST" else None
        path = self.path.replace("{uri}", item).replace("{name}", item)
        return person.call(self.method, path, body, params={**GROUP, **told})

    def status(self, role: str, audience: str | None) -> int:
        """What who has a role, and owns nothing, is answered."""
        if role == "guest" and self.is_ours and self.verb != "read":
            return 401
        if audience is None or (audience == LAB and role != "colleague"):  # it does not exist for them
            if self.is_ours:
                return 404
            if role == "admin":  # PyTupli's: what is gone is deleted, for an admin
                return 200 if self.verb == "delete" else 404
            return 403
        allowed = self.verb == "read" or (self.verb in ("delete", "unpublish") and role in MAY_DELETE)
        return 200 if allowed else 403


def routes(url: str) -> list[Route]:
    """The routes that name an item; each other operation must be in NO_ITEM."""
    found = []
    others = set()
    document = httpx.get(f"{url}/openapi.json", timeout=120).json()
    for path, item in document["paths"].items():
        for method, told in item.items():
            names = [each["name"] for each in told.get("parameters", ()) if each["name"].endswith("_id")]
            if "{uri}" in path or path == "/v1/files/{name}":
                found.append(Route(method.upper(), path, path.split("/")[2], ""))
            elif path == "/v1/tickets":
                found.append(Route(method.upper(), path, "files", "recording"))
            elif names and "{" not in path:
                found.append(Route(method.upper(), path, f"{names[0].removesuffix('_id')}s", names[0]))
            else:
                others.add(f"{method.upper()} {path}")
    assert others == {each for listed in NO_ITEM.values() for each in listed.split(", ")}
    return found


class Lab:
    """A server, its people by role, and what ann has stored there."""

    def __init__(self, url: str, folder: Path) -> None:
        self.url = url
        record_rollouts("CartPole-v1", folder / "run.mcap", steps=20, seed=1)
        self._recording = (folder / "run.mcap").read_bytes()
        admin = Person(url, "admin")
        for name in ("ann", "colleague", *ROLES[:-1]):
            admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
            if name not in ("ann", "colleague", "user"):
                admin.ask("PUT", "/v1/groups/global/members", [{"user": name, "roles": [name]}])
        self.ann = Person(url, "ann")
        self.ann.ask("POST", "/v1/groups", {"name": LAB})
        self.ann.ask("PUT", f"/v1/groups/{LAB}/members", [{"user": "colleague", "roles": ["member"]}])
        self.people = {name: Person(url, name) for name in (*ROLES[:-1], "colleague")}
        self.people |= {"admin": admin, "guest": Person(url)}

    def stock(self, audience: str | None) -> dict[str, str]:
        """Ids of ann's things by kind; they are stored where they are not, and published for an audience alone."""
        recording = self.ann.send(self._recording)
        wanted = {"type": "EQ", "key": "recording", "value": recording}
        ids = {
            "benchmarks": self.ann.ask("POST", "/v1/benchmarks", cart_benchmark())["id"],
            "artifacts": self.ann.ask("POST", "/v1/artifacts", headers=METADATA, content=b"wind")["id"],
            "episodes": self.ann.ask("POST", "/v1/episodes/list", {"filter": wanted})["items"][0]["id"],
        }
        for kind, uri in ids.items():
            for group in AUDIENCES[1:]:
                method = "PUT" if group == audience else "DELETE"
                self.ann.ask(method, f"/v1/{kind}/{uri}/published", params={"group": group})
        return {**ids, "files": recording}


class Shared(NamedTuple):
    """What ann has stored: the ids of three benchmarks and three artifacts, each for another audience, and a recording,
    whose episodes are for one audience after another."""

    benchmarks: list[str]
    artifacts: list[str]
    recording: str
    episodes: list[str]


def shared(ann: Person, folder: Path) -> Shared:
    record_rollouts("CartPole-v1", folder / "shared.mcap", steps=150, seed=2)
    recording = ann.send((folder / "shared.mcap").read_bytes())
    benchmarks = [ann.ask("POST", "/v1/benchmarks", cart_benchmark(str(to)))["id"] for to in AUDIENCES]
    artifacts = [
        ann.ask("POST", "/v1/artifacts", headers=METADATA, content=str(to).encode())["id"] for to in AUDIENCES
    ]
    listed = ann.ask("POST", "/v1/episodes/list", {"filter": f'recording = "{recording}"'})["items"]
    episodes = [each["id"] for each in sorted(listed, key=lambda each: each["episode"])]
    assert len(episodes) > len(AUDIENCES)
    for kind, ids in (("benchmarks", benchmarks), ("artifacts", artifacts), ("episodes", episodes)):
        for number, uri in enumerate(ids):
            if (group := AUDIENCES[number % len(AUDIENCES)]) is not None:
                ann.ask("PUT", f"/v1/{kind}/{uri}/published", params={"group": group})
    return Shared(benchmarks, artifacts, recording, episodes)


READERS = {
    "stranger": (False, True, False),
    "guest": (False, True, False),
    "colleague": (False, True, True),
    "owner": (True, True, True),
    "admin": (False, True, False),
}
"""Who reads what is private, published in `global`, and in the lab, as AUDIENCES has them."""


def numbers_in(answer: httpx.Response, path: Path) -> list[int]:
    """The numbers of the episodes in a recording that an answer holds."""
    assert answer.status_code == 200, answer.text
    path.write_bytes(answer.content)
    with Recording(path) as recording:
        numbers: list[int] = recording.index["episode"].tolist()
    return numbers


@pytest.fixture(params=ENGINES)  # for each test, since PyTupli's client may delete again what it has deleted
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Lab]:
    with settings_of(request.param, request, tmp_path / "served") as settings:
        with serving(dataclasses.replace(settings, guests=True)) as url:
            yield Lab(url, tmp_path)


@pytest.mark.sampled(0, keep=[f"{ENGINES[0]}-global", f"{ENGINES[0]}-{LAB}", f"{ENGINES[1]}-private"])
@pytest.mark.parametrize("audience", AUDIENCES, ids=["private", *AUDIENCES[1:]])
def test_every_route_for_each_role(lab: Lab, audience: str | None) -> None:
    wrong = []
    named = routes(lab.url)
    ids = lab.stock(audience)
    for role, person in lab.people.items():
        for route in named:
            status = route.ask(person, ids[route.kind]).status_code
            if status != route.status(role, audience):
                wrong.append((role, route, status))
            if status == 200 and route.verb != "read":
                ids = lab.stock(audience)
    assert wrong == []


@pytest.mark.sampled(0, keep=[f"{ENGINES[0]}-private", f"{ENGINES[1]}-{LAB}"])
@pytest.mark.parametrize("audience", AUDIENCES, ids=["private", *AUDIENCES[1:]])
def test_every_route_for_the_owner(lab: Lab, audience: str | None) -> None:
    ids = lab.stock(audience)
    for route in routes(lab.url):
        answer = route.ask(lab.ann, ids[route.kind])
        assert answer.status_code == 200, (route, answer.text)
        if route.verb != "read":
            ids = lab.stock(audience)


def test_lists_and_queries_give_what_may_be_read(lab: Lab, tmp_path: Path) -> None:
    """Exactly that, to each reader: every operation on lists and queries of NO_ITEM that changes nothing."""
    stored = shared(lab.ann, tmp_path)
    people = {**lab.people, "stranger": lab.people["user"], "owner": lab.ann}
    for reader, may in READERS.items():
        person, file = people[reader], tmp_path / "answer.mcap"
        numbers = [number for number in range(len(stored.episodes)) if may[number % len(may)]]
        readable = {
            "benchmarks": {uri for uri, seen in zip(stored.benchmarks, may, strict=True) if seen},
            "artifacts": {uri for uri, seen in zip(stored.artifacts, may, strict=True) if seen},
            "episodes": {stored.episodes[number] for number in numbers},
        }
        for kind, expected in readable.items():
            listed = person.ask("POST", f"/v1/{kind}/list", {})["items"]
            listed_by_pytupli = person.ask("POST", f"/{kind}/list", {})
            for found in (listed, listed_by_pytupli):
                assert sorted(each["id"] for each in found) == sorted(expected), (reader, kind)
        assert person.ask("POST", "/v1/episodes/count", {}) == len(numbers), reader
        assert numbers_in(person.call("POST", "/v1/query", {}), file) == numbers, reader
        ticket = person.ask("POST", "/v1/tickets", {"recording": stored.recording})
        assert ticket["whole"] == (reader == "owner")
        assert numbers_in(httpx.get(lab.url + ticket["path"]), file) == numbers, reader
        for guest_of_ticket in (False, True):
            path = "/v1/manifest"
            if guest_of_ticket:
                path = person.ask("POST", "/v1/query/tickets", {})["path"]
            asker = Person(lab.url) if guest_of_ticket else person
            (source,) = asker.ask("GET", path)["sources"]
            assert numbers_in(asker.call("GET", f"/v1/{source['url']}"), file) == numbers, (reader, path)


def test_runs_of_which_nothing_may_be_read_are_not_named(lab: Lab, tmp_path: Path) -> None:
    """Of a merged recording, of which one run is published, and the other is deleted later."""
    for name in ("untold", "told"):
        record_rollouts(
            "CartPole-v1", tmp_path / f"{name}.mcap", steps=40, seed=3, name=name, tags=[f"tag-{name}"]
        )
    merge_recordings([tmp_path / "untold.mcap", tmp_path / "told.mcap"], tmp_path / "both.mcap")
    lab.ann.send((tmp_path / "both.mcap").read_bytes())
    wanted = {"filter": 'run.name = "told"', "group": "global"}
    assert lab.ann.ask("POST", "/v1/episodes/publish", wanted)["episodes"] > 0
    for reader, runs in (("guest", ["told"]), ("user", ["told"]), ("ann", ["untold", "told"])):
        person = lab.ann if reader == "ann" else lab.people[reader]
        (file,) = person.ask("GET", "/dataset/CartPole-v1?format=json")["files"]
        assert [run["name"] for run in file["runs"]] == runs
        assert ("tag-untold" in person.call("GET", "/dataset/CartPole-v1").text) == (reader == "ann")
        found = person.ask("GET", "/?format=json&q=tag-untold")["count"]
        assert found == (reader == "ann")
    assert lab.ann.ask("POST", "/v1/episodes/delete", {"filter": 'run.name = "untold"'})["episodes"] > 0
    for person in (lab.people["guest"], lab.people["user"], lab.ann):
        (file,) = person.ask("GET", "/dataset/CartPole-v1?format=json")["files"]
        assert [run["name"] for run in file["runs"]] == ["told"]
        assert file["bytes"] is None  # the file still has those that were deleted
        assert person.ask("GET", "/?format=json&q=tag-untold")["count"] == 0
