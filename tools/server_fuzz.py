"""Sends a server requests that its OpenAPI document allows, and others, as users of each role.

    python tools/server_fuzz.py --examples 200 --seed 1 --engine postgresql [--role admin | --role each]

Schemathesis makes the requests from the document; tests/support/page_fuzz.py draws requests to pages and their forms.
Half of them use names and ids of existing items instead of made-up ones, so that they get further than "there is no
such thing". A part of these hold NaN, an infinity or a lone surrogate. A random user sends each request; with
`--role`, a user of that role sends all, or one of each role in turn. Findings are:

- a failure of the server: a status of 500 or more, except a full quota (507);
- an answer that the document does not describe: its status, its media type or its JSON;
- a page with unescaped text.

Exit code 1 at a finding.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import json
import logging
import math
import random
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import hypothesis
import requests
from hypothesis import HealthCheck, Phase
from schemathesis import GenerationMode
from schemathesis.core.failures import Failure, FailureGroup
from schemathesis.openapi import from_url
from schemathesis.specs.openapi import checks

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

import buckets
import postgres
from page_fuzz import MARK, Browser, page_routes, wrong
from pages import robot
from persons import Person, RefusedError, announced, cart_benchmark
from serving import serving

from tupli_mcap.server.settings import Settings
from tupli_mcap.wrappers.rollout import record_rollouts

ENGINES = ("sqlite", "postgresql")
ROLES = ("", "user", "content_admin", "user_admin", "group_admin", "admin", "reader")
"""Who asks: nobody; users with no role but everybody's, or one in `global`; a token that may only read."""
FULL = 507
_RENEWED_EVERY = 6  # routes
_CHECKS = [
    checks.status_code_conformance,
    checks.content_type_conformance,
    checks.response_schema_conformance,
]
_METADATA = {"Artifact-Metadata": base64.b64encode(b'{"name": "wind"}').decode()}
_STEP = {"state": [0.5, 1.0], "action": 1, "reward": 1.0}
_FILTERS = [
    {"type": "GEQ", "key": "steps", "value": 0},
    {"type": "EQ", "key": "metadata.score", "value": 1},
    {"type": "IN", "key": "created_by", "value": ["admin", "user7"]},
    {"type": "NOT", "filters": [{"type": "LT", "key": "return", "value": 2.5}]},
]
_ODD = (math.nan, math.inf, "\ud800 is my password", {"\ud800": math.nan})
_ODD_SHARE = 0.1  # of the bodies with existing names
_TEXTS = ["steps >= 0", "metadata.score == 1", 'created_by in ["admin"]']


class Stock:
    """Items of a user, published in `global`, and a user of each role.

    Requests may delete all of it: `renew` brings it back, and returns the values for each name in a request.
    """

    def __init__(self, url: str, folder: Path) -> None:
        self.url, self._admin = url, Person(url, "admin")
        self._users = 0
        record_rollouts("CartPole-v1", folder / "run.mcap", steps=30, seed=1)
        self._recording = (folder / "run.mcap").read_bytes()
        robot(folder / "robot.mcap", text=MARK)
        self._marked = (folder / "robot.mcap").read_bytes()
        self._benchmark = cart_benchmark()
        self.askers = {role: self._asker(role) for role in ROLES}
        self._owner = self._person()

    def _person(self, role: str = "") -> Person:
        """Creates a user; the admin gives them a role in `global`."""
        self._users += 1
        name = f"user{self._users}"
        self._admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
        if role:
            self._admin.ask("PUT", "/v1/groups/global/members", [{"user": name, "roles": [role]}])
        while True:
            try:
                return Person(self.url, name)
            except AssertionError as err:  # those who were made up have tried too many passwords
                if "wait a minute" not in str(err):
                    raise
            time.sleep(1)

    def _asker(self, role: str) -> Person:
        if not role:
            return Person(self.url)
        person = self._person("" if role in ("user", "reader") else role)
        if role == "reader":
            made = person.ask("POST", "/v1/api-tokens", {"name": "reader"})
            person.headers = {"Authorization": f"Bearer {made['token']}"}
        return person

    def renew(self) -> dict[str, list[Any]]:
        """Brings back deleted items and users; returns the values for each name in a request."""
        for role, person in self.askers.items():
            if role and person.call("GET", "/v1/me").status_code == 401:
                self.askers[role] = self._asker(role)
        try:
            return self._kept()
        except RefusedError:  # deleted, or given a quota
            self._owner = self._person()
            return self._kept()

    def _kept(self) -> dict[str, list[Any]]:
        owner = self._owner
        owner.call("POST", "/v1/groups", {"name": "robots"})
        benchmark = owner.ask("POST", "/v1/benchmarks", self._benchmark)["id"]
        artifact = owner.ask("POST", "/v1/artifacts", headers=_METADATA, content=b"wind")["id"]
        recording = owner.send(self._recording)
        owner.send(self._marked)
        told = {"filter": {"type": "EQ", "key": "recording", "value": recording}}
        episodes = [each["id"] for each in owner.ask("POST", "/v1/episodes/list", told)["items"]]
        for place in (f"benchmarks/{benchmark}", f"artifacts/{artifact}", f"episodes/{episodes[0]}"):
            owner.ask("PUT", f"/v1/{place}/published", params={"group": "global"})
        ticket = owner.ask("POST", "/v1/tickets", {"recording": recording})["path"].partition("ticket=")[2]
        users = [person.name for person in (owner, *self.askers.values()) if person.name]
        groups, roles = ["global", "robots", *users[:1]], ["member", "contributor", "admin"]
        return {
            **dict.fromkeys(("username", "user"), users),
            **dict.fromkeys(("group", "publish_in", "unpublish_from", "group_name"), groups),
            **dict.fromkeys(("role", "role_name"), roles),
            "roles": [[role] for role in roles],
            **{key: [benchmark] for key in ("benchmark_id", "/v1/benchmarks uri")},
            **{key: [artifact] for key in ("artifact_id", "/v1/artifacts uri")},
            **dict.fromkeys(("episode_id", "/v1/episodes uri"), episodes),
            **{key: [recording] for key in ("recording", "/v1/files name")},
            "recordings": [[recording]],
            "episodes": [[0], [0, 1]],
            "/v1/groups name": groups,
            "ticket": [ticket, self._query_ticket()],
            "upload_id": self._uploads(),
            "filter": [*_FILTERS, *_TEXTS],
            "benchmark_filter": [{"type": "EQ", "key": "hash", "value": self._benchmark["hash"]}],
            "text filter": _TEXTS,
            "text benchmark_filter": ['metadata.name == "cart"'],
            "key": ["metadata.score", "steps"],
            "serialized": [self._benchmark["serialized"]],
            "hash": [self._benchmark["hash"]],
            "tuples": [[_STEP] * 3, [{**_STEP, "terminal": True}]],
            "metadata": [{"name": "cart"}, {}, '{"name": "cart"}'],
        }

    def _query_ticket(self) -> str:
        path: str = self._owner.ask("POST", "/v1/query/tickets", {"filter": _FILTERS[0]})["path"]
        return path.partition("ticket=")[2]

    def _uploads(self) -> list[str]:
        """An unfinished upload of each user."""
        begun = [
            person.call("POST", "/v1/uploads", headers=announced(b"x" * 9)) for person in self.askers.values()
        ]
        return [each.headers["Location"].rpartition("/")[2] for each in begun if each.status_code == 201]


class Known:
    """Puts existing names and ids into requests."""

    def __init__(self, names: dict[str, list[Any]], rng: random.Random) -> None:
        self._names, self._rng = names, rng

    def put(self, case: Any) -> None:
        if self._rng.random() < 0.5:
            return
        start = "/".join(case.path.split("/")[:3])
        for name in case.path_parameters or ():
            case.path_parameters[name] = self._known(name, case.path_parameters[name], start)
        for name in case.query or ():
            case.query[name] = self._known(name, case.query[name], "text")
        if case.path == "/v1/uploads":
            case.headers.update(announced(self._rng.randbytes(9)))
        if case.path == "/v1/artifacts":
            case.headers.update(_METADATA)
        if case.path == "/v1/uploads/{upload_id}":
            case.headers["Upload-Offset"] = "0"
        case.body = self._within(case.body)
        if case.media_type == "application/json" and self._rng.random() < _ODD_SHARE:
            case.body = json.dumps(self._odd(case.body), default=str).encode()

    def _odd(self, value: Any) -> Any:
        """A body with a value that JSON lacks, or that UTF-8 cannot hold, in a random place."""
        if not isinstance(value, dict | list) or not value or self._rng.random() < 0.2:
            return self._rng.choice(_ODD)
        chosen = self._rng.choice(list(value) if isinstance(value, dict) else range(len(value)))
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        made = {key: self._odd(each) if key == chosen else each for key, each in pairs}
        return made if isinstance(value, dict) else list(made.values())

    def _known(self, name: str, value: Any, place: str) -> Any:
        known = self._names.get(f"{place} {name}", self._names.get(name))
        return value if known is None or self._rng.random() < 0.2 else self._rng.choice(known)

    def _within(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: self._known(key, self._within(each), "") for key, each in value.items()}
        return [self._within(each) for each in value] if isinstance(value, list) else value


class Fuzzer:
    """Sends requests, and counts findings by kind, with the first request that shows each."""

    def __init__(self, url: str, folder: Path, seed: int) -> None:
        self.schema = from_url(f"{url}/openapi.json", timeout=120)
        self._url, self._stock = url, Stock(url, folder)
        self.session, self._seed = requests.Session(), seed
        self.statuses: Counter[str] = Counter()
        self.findings: dict[str, str] = {}

    def run(self, examples: int, only: str = "", roles: Sequence[str] = ROLES) -> None:
        """Sends requests to each route, or only to one, such as `GET /v1/me`. roles: of the users who send them."""
        names: dict[str, list[Any]] = {}
        for number, found in enumerate(self.schema.get_all_operations()):
            if number % _RENEWED_EVERY == 0:
                names = self._stock.renew()
            if only in ("", found.ok().label):
                self._ask(found.ok(), names, examples, roles)

    def run_pages(self, examples: int, only: str = "", roles: Sequence[str] = ROLES) -> None:
        """Gets each page and sends each form, or only those of one path. roles: see `run`."""
        for number, route in enumerate(page_routes()):
            if number % _RENEWED_EVERY == 0:
                names = self._stock.renew()
                keys, episodes = names["benchmark_id"], names["episode_id"]
                known = {**names, "key": keys, "dataset": keys, "uri": episodes, "uris": episodes}
                known |= {"filter": _TEXTS, "name": names["group"]}
            if only in ("", route.path):
                self._ask_page(route, known, examples, roles)

    def _ask_page(self, route: Any, known: dict[str, list[Any]], examples: int, roles: Sequence[str]) -> None:
        rng = random.Random(f"{self._seed} {route.methods} {route.path}")
        with contextlib.ExitStack() as stack:
            browsers = {
                role: stack.enter_context(Browser(self._url, person.name))
                for role, person in self._stock.askers.items()
                if role in roles and role != "reader"  # a token, which no page takes
            }
            for _ in range(examples if browsers else 0):
                role = rng.choice(list(browsers))
                answer = browsers[role].ask(route, known, rng)
                self.statuses[f"page {answer.status_code}"] += 1
                for what in wrong(answer):
                    sent = f"{answer.request.method} {answer.request.url} {answer.request.content[:500]!r}"
                    told = f"as {role or 'nobody'}: {sent[:1500]}\n    {answer.content[:500]!r}"
                    self.findings.setdefault(f"{route.path}: {what}", told)

    def _ask(self, operation: Any, names: dict[str, list[Any]], examples: int, roles: Sequence[str]) -> None:
        rng = random.Random(f"{self._seed} {operation.label}")
        known = Known(names, rng)
        modes = [operation.as_strategy(generation_mode=mode) for mode in GenerationMode]
        cases = hypothesis.strategies.one_of(*modes)

        @hypothesis.seed(rng.randrange(1 << 32))
        @hypothesis.settings(
            max_examples=examples, database=None, deadline=None, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @hypothesis.given(case=cases)
        def ask(case: Any) -> None:
            known.put(case)
            role = rng.choice(roles)
            headers = self._stock.askers[role].headers
            answer = case.call(self._url, self.session, headers=headers, timeout=120, allow_redirects=False)
            self._judge(case, role, answer)

        ask()

    def _judge(self, case: Any, role: str, answer: Any) -> None:
        label, status = case.operation.label, answer.status_code
        self.statuses[f"{status}"] += 1
        if status >= 500 and status != FULL:
            self._note(f"{label}: {status}", case, role, answer)
        try:
            case.validate_response(answer, checks=_CHECKS)
        except (FailureGroup, Failure) as err:
            for each in getattr(err, "exceptions", [err]):
                told = " ".join(f"{each.title}: {each.message}".split())
                self._note(f"{label}: {status}: {told[:160]}", case, role, answer)

    def _note(self, what: str, case: Any, role: str, answer: Any) -> None:
        sent = case.as_curl_command()
        self.findings.setdefault(what, f"as {role or 'nobody'}: {sent[:1500]}\n    {answer.content[:500]!r}")


@contextlib.contextmanager
def fuzzer(engine: str, folder: Path, seed: int, *, guests: bool = True) -> Iterator[Fuzzer]:
    """A fuzzer of a new server: SQLite and a directory, or PostgreSQL and a bucket."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # the bucket's log
    with contextlib.ExitStack() as stack:
        database = blobs = ""
        if engine == "postgresql":
            database = stack.enter_context(stack.enter_context(postgres.cluster()).database())
            blobs = stack.enter_context(buckets.bucket()).url
        settings = Settings(folder / "served", database=database, blobs=blobs, guests=guests)
        made = Fuzzer(stack.enter_context(serving(settings)), folder, seed)
        with made.session:
            yield made


def _turns(role: str | None) -> list[Sequence[str]]:
    """The roles of those who send requests at the same time, one group after another."""
    if role is None:
        return [ROLES]
    return [[name] for name in ROLES] if role == "each" else [["" if role == "nobody" else role]]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--engine", choices=ENGINES, default="sqlite")
    parser.add_argument("--examples", type=int, default=100, help="requests to each route")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--role", choices=("each", "nobody", *ROLES[1:]), help="who sends all requests")
    parser.add_argument("--no-guests", action="store_true", help="who is not signed in is shown nothing")
    chosen = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        fuzzer(chosen.engine, Path(folder), chosen.seed, guests=not chosen.no_guests) as made,
    ):
        for roles in _turns(chosen.role):
            made.run(chosen.examples, roles=roles)
            made.run_pages(chosen.examples, roles=roles)
    for what, first in made.findings.items():
        print(f"{what}\n    {first}\n")
    print(f"{made.statuses.total()} requests, {json.dumps(dict(made.statuses.most_common()))}")
    print(f"{len(made.findings)} findings")
    sys.exit(bool(made.findings))


if __name__ == "__main__":
    main()
