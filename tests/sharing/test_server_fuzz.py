"""Requests that are made up from the OpenAPI document: a sample of tools/server_fuzz.py, and that it can fail."""

from __future__ import annotations

import html
from pathlib import Path

import httpx
import pytest
from page_fuzz import MARK, Browser, wrong
from persons import Person
from serving import serving
from tool_modules import tool

from tupli_mcap import Recording
from tupli_mcap.server.people import accounts
from tupli_mcap.server.routes import items
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.wire import answer
from tupli_mcap.wrappers.rollout import record_rollouts


@pytest.mark.sampled(0, keep=["postgresql"])
@pytest.mark.timeout(1200)  # thousands of requests: a busy machine takes minutes for them
@pytest.mark.parametrize("engine", ["sqlite", "postgresql"])
def test_every_route_answers_as_the_document_says(
    engine: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if engine == "postgresql":
        request.getfixturevalue("postgres")  # skips where it is not installed
    with tool("server_fuzz").fuzzer(engine, tmp_path, seed=1) as fuzzer:
        for role in ("", "user", "admin"):
            fuzzer.run(2, roles=[role])
        fuzzer.run_pages(4)
    assert fuzzer.findings == {}
    assert fuzzer.statuses["200"] > 10 and fuzzer.statuses["page 200"] > 20


def test_a_failure_and_an_answer_of_another_shape_are_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> list[str]:
        raise RuntimeError("a defect")

    with tool("server_fuzz").fuzzer("sqlite", tmp_path, seed=1) as fuzzer:
        monkeypatch.setattr(accounts, "list_users", broken)
        fuzzer.run(5, only="GET /v1/users")
        monkeypatch.setattr(items, "paged", lambda *_: answer(["no page"]))
        fuzzer.run(5, only="POST /v1/benchmarks/list")
        fuzzer.run_pages(10, only="/users")
    assert "/users: 500" in fuzzer.findings
    found = {tuple(what.split(": ")[:3]) for what in fuzzer.findings}
    assert ("GET /v1/users", "500") in found
    assert ("POST /v1/benchmarks/list", "200", "Response violates schema") in found


def test_a_text_that_is_not_escaped_is_found() -> None:
    headers = {"Content-Type": "text/html", "Content-Security-Policy": "default-src 'self'"}
    for text, found in ((html.escape(MARK), []), (MARK, ["a text is on the page as it is"])):
        request = httpx.Request("GET", "http://127.0.0.1/")
        assert list(wrong(httpx.Response(200, headers=headers, text=text, request=request))) == found


# --- what it has found ---


def test_an_episode_without_pictures_has_no_film(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=20, seed=1)
    with serving(Settings(tmp_path / "served")) as url:
        Person(url, "admin").ask("POST", "/v1/users", {"username": "ann", "password": "ann's password"})
        ann = Person(url, "ann")
        ann.send((tmp_path / "run.mcap").read_bytes())
        uri = ann.ask("POST", "/v1/episodes/list", {})["items"][0]["id"]
        with Browser(url, "ann") as browser:
            told = browser.client.get(f"/episode/{uri}/film.mp4")
    assert told.status_code == 404


def test_a_recording_of_two_users_is_cut_once(tmp_path: Path) -> None:
    """Both have published it: a query that means both copies gives each episode once."""
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=100, seed=1)
    data = (tmp_path / "run.mcap").read_bytes()
    with serving(Settings(tmp_path / "served")) as url:
        people = [Person(url, "admin")]
        people[0].ask("POST", "/v1/users", {"username": "ann", "password": "ann's password"})
        people.append(Person(url, "ann"))
        for person in people:
            person.send(data)
            person.ask("POST", "/v1/episodes/publish", {"filter": None, "group": "global"})
        for person in people:
            cut = person.call("POST", "/v1/query", {})
            assert cut.status_code == 200, cut.text
            (tmp_path / "cut.mcap").write_bytes(cut.content)
            with Recording(tmp_path / "cut.mcap") as one, Recording(tmp_path / "run.mcap") as whole:
                assert (one.uuid, len(one)) == (whole.uuid, len(whole))


def test_what_cannot_be_one_recording_is_the_request_s_fault(tmp_path: Path) -> None:
    with serving(Settings(tmp_path / "served")) as url:
        admin = Person(url, "admin")
        for name in ("CartPole-v1", "MountainCar-v0"):
            record_rollouts(name, tmp_path / f"{name}.mcap", steps=100, seed=1)
            admin.send((tmp_path / f"{name}.mcap").read_bytes())
        refused = admin.call("POST", "/v1/query", {})
        assert (refused.status_code, refused.json()["error"]) == (400, "SpaceError")


def test_refusals_have_one_shape(tmp_path: Path) -> None:
    with serving(Settings(tmp_path / "served")) as url:
        for method, path, body in (("POST", "/v1/tokens", b"\xff"), ("GET", "/v1/nothing", b"")):
            told = httpx.request(
                method, url + path, content=body, headers={"Content-Type": "application/json"}
            )
            assert set(told.json()) == {"detail", "error"}, path
