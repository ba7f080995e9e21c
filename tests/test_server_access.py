"""Who may do what with an item of somebody else: every route that names one, each role, private or published.

The routes come from the OpenAPI document: one that names an item, and that this table does not know, fails it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import httpx
import pytest
from persons import Person, cart_benchmark
from serving import ENGINES, serving, settings_of

from tupli_mcap.wrappers.rollout import record_rollouts

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3

ROLES = ("user", "member", "contributor", "user_admin", "group_admin", "content_admin", "admin")
MAY_DELETE = ("content_admin", "admin")
METADATA = {"Artifact-Metadata": "eyJuYW1lIjogIndpbmQifQ=="}  # {"name": "wind"}
GROUP = dict.fromkeys(("group", "publish_in", "unpublish_from"), "global")


class Route(NamedTuple):
    """method, path. kind: of what it names one; name: the parameter of the query that does, if it is not the path."""

    method: str
    path: str
    kind: str
    name: str

    @property
    def is_ours(self) -> bool:
        return self.path.startswith("/v1/")

    @property
    def verb(self) -> str:
        if self.method == "GET":
            return "read"
        if "publish" in self.path:
            return "unpublish" if "unpublish" in self.path or self.method == "DELETE" else "publish"
        assert self.method == "DELETE", self
        return "delete"

    def status(self, role: str, published: bool) -> int:
        """What who has a role, and owns nothing, is answered."""
        if not published:  # it does not exist for them
            if self.is_ours:
                return 404
            if role == "admin":  # PyTupli's: what is gone is deleted, for an admin
                return 200 if self.verb == "delete" else 404
            return 403
        allowed = self.verb == "read" or (self.verb in ("delete", "unpublish") and role in MAY_DELETE)
        return 200 if allowed else 403


def routes(url: str) -> list[Route]:
    """The routes that name an item."""
    found = []
    document = httpx.get(f"{url}/openapi.json", timeout=120).json()
    for path, item in document["paths"].items():
        for method, told in item.items():
            names = [each["name"] for each in told.get("parameters", ()) if each["name"].endswith("_id")]
            if "{uri}" in path:
                found.append(Route(method.upper(), path, path.split("/")[2], ""))
            elif names and "{" not in path:
                found.append(Route(method.upper(), path, f"{names[0].removesuffix('_id')}s", names[0]))
    assert len(found) == 13 + 11
    return found


class Lab:
    """A server, its people by role, and what ann has stored there."""

    def __init__(self, url: str, folder: Path) -> None:
        self.url = url
        record_rollouts("CartPole-v1", folder / "run.mcap", steps=20, seed=1)
        self._recording = (folder / "run.mcap").read_bytes()
        admin = Person(url, "admin")
        for name in ("ann", *ROLES[:-1]):
            admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
            if name not in ("ann", "user"):
                admin.ask("PUT", "/v1/groups/global/members", [{"user": name, "roles": [name]}])
        self.ann = Person(url, "ann")
        self.people = {role: Person(url, role) for role in ROLES[:-1]} | {"admin": admin}

    def stock(self, published: bool) -> dict[str, str]:
        """Ids of ann's things by kind; they are stored where they are not, and all published or none."""
        recording = self.ann.send(self._recording)
        wanted = {"type": "EQ", "key": "recording", "value": recording}
        ids = {
            "benchmarks": self.ann.ask("POST", "/v1/benchmarks", cart_benchmark())["id"],
            "artifacts": self.ann.ask("POST", "/v1/artifacts", headers=METADATA, content=b"wind")["id"],
            "episodes": self.ann.ask("POST", "/v1/episodes/list", {"filter": wanted})["items"][0]["id"],
        }
        for kind, uri in ids.items():
            method = "PUT" if published else "DELETE"
            self.ann.ask(method, f"/v1/{kind}/{uri}/published", params={"group": "global"})
        return ids


@pytest.fixture(scope="module", params=ENGINES)
def lab(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    root = tmp_path_factory.mktemp("lab")
    with settings_of(request.param, request, root / "served") as settings, serving(settings) as url:
        yield Lab(url, root)


@pytest.mark.sampled(0, keep=["sqlite and a directory-published", "postgresql and s3-private"])
@pytest.mark.parametrize("published", [False, True], ids=["private", "published"])
def test_every_route_for_each_role(lab: Lab, published: bool) -> None:
    wrong = []
    for role, person in lab.people.items():
        ids = lab.stock(published)
        for route in routes(lab.url):
            uri = ids[route.kind]
            told = {**GROUP, route.name: uri} if route.name else GROUP
            status = person.call(route.method, route.path.format(uri=uri), params=told).status_code
            if status != route.status(role, published):
                wrong.append((role, route, status))
            if status == 200 and route.verb != "read":
                ids = lab.stock(published)
    assert wrong == []


def test_every_route_for_the_owner(lab: Lab) -> None:
    for route in routes(lab.url):
        uri = lab.stock(published=False)[route.kind]
        told = {**GROUP, route.name: uri} if route.name else GROUP
        answer = lab.ann.call(route.method, route.path.format(uri=uri), params=told)
        assert answer.status_code == 200, (route, answer.text)
