"""Whose episode an id shows, if several users have stored a recording of one UUID."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from crafted import Model
from fuzzing.crafted import checksum
from fuzzing.model import METADATA, strings
from gymnasium import spaces
from page_fuzz import Browser
from persons import Person, cart_benchmark
from serving import ENGINES, serving, settings_of

from tupli_mcap import EpisodeWriter, Recording
from tupli_mcap.errors import NotFoundError
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.exchange import copy_episodes

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3


class Lab(NamedTuple):
    """A server, on which ann has published a recording for all, and eve has a forgery of it that sorts before it."""

    url: str
    ann: Person
    bob: Person
    eve: Person
    admin: Person
    whole: bytes
    forged: bytes
    names: dict[str, str]
    ids: list[str]

    def publish(self, who: Person, group: str = "global") -> None:
        own = {"type": "EQ", "key": "created_by", "value": who.name}
        who.ask("POST", "/v1/episodes/publish", {"filter": own, "group": group})

    def delete(self, who: Person) -> None:
        own = {"type": "EQ", "key": "created_by", "value": who.name}
        who.ask("POST", "/v1/episodes/delete", {"filter": own})


def recorded(path: Path, value: float, episodes: int = 3, benchmark_id: str = "") -> bytes:
    """A recording whose steps all have this value."""
    space = spaces.Box(-np.inf, np.inf, (1,))
    with EpisodeWriter(path, space, spaces.Discrete(2), benchmark_id=benchmark_id) as writer:
        for _ in range(episodes):
            writer.begin(metadata={"score": value})
            writer.step(np.full(1, value, np.float32), 0, reward=value, terminal=True)
            writer.end(np.full(1, value, np.float32))
    return path.read_bytes()


def uuid_of(path: Path) -> str:
    with Recording(path) as recording:
        return recording.uuid


def forged(path: Path, uuid: str) -> bytes:
    """A recording with the UUID of another one, and checksums that are right."""
    old, model = uuid_of(path).encode(), Model.of(path.read_bytes())
    for part in model.parts:
        if part.opcode == METADATA and old in part.body:
            size = 4 + int.from_bytes(part.body[:4], "little")
            texts = texts_of(part.body[size + 4 :])
            pairs = dict(zip(texts[::2], texts[1::2], strict=True)) | {b"uuid": uuid.encode()}
            pairs[b"crc"] = b"%08x" % checksum(pairs)
            data = strings(*[text for pair in pairs.items() for text in pair])
            part.body = part.body[:size] + len(data).to_bytes(4, "little") + data
    return model.encode()


def texts_of(data: bytes) -> list[bytes]:
    """The texts of a record, each after its length."""
    found, at = [], 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "little")
        found.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return found


@pytest.fixture(params=ENGINES)
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Lab]:
    with settings_of(request.param, request, tmp_path / "served") as settings, serving(settings) as url:
        admin = Person(url, "admin")
        for name in ("ann", "bob", "eve"):
            admin.ask("POST", "/v1/users", {"username": name, "password": f"{name}'s password"})
        ann, bob, eve = (Person(url, name) for name in ("ann", "bob", "eve"))
        benchmark = eve.ask("POST", "/v1/benchmarks", cart_benchmark())["id"]
        whole = recorded(tmp_path / "ann.mcap", 1.0)
        recorded(tmp_path / "eve.mcap", 666.0, benchmark_id=benchmark)
        uuid = uuid_of(tmp_path / "ann.mcap")
        copy = forged(tmp_path / "eve.mcap", uuid)
        names = {"ann": ann.send(whole), "eve": eve.send(copy)}
        assert names["eve"] < names["ann"]
        found = Lab(url, ann, bob, eve, admin, whole, copy, names, [f"{uuid}-{i}" for i in range(3)])
        found.publish(ann)
        found.publish(eve)
        yield found


def of(key: str, value: Any) -> dict[str, Any]:
    return {"filter": {"type": "EQ", "key": key, "value": value}}


def owners(person: Person, **told: Any) -> list[str]:
    return [each["created_by"] for each in person.ask("POST", "/v1/episodes/list", told)["items"]]


def test_an_id_shows_what_was_stored_first(lab: Lab, tmp_path: Path) -> None:
    uri = lab.ids[0]
    assert owners(lab.bob, **of("id", uri)) == ["ann"]
    assert owners(lab.bob) == ["ann"] * 3
    assert lab.bob.ask("POST", "/v1/episodes/count", {}) == 3
    assert lab.bob.ask("POST", "/v1/episodes/count", of("metadata.score", 666.0)) == 0
    assert owners(lab.bob, **of("created_by", "eve")) == []
    for told in (of("id", uri), {"recordings": [lab.names["ann"]]}, {}):
        answer = lab.bob.call("POST", "/v1/query", told)
        (tmp_path / "got.mcap").write_bytes(answer.content)
        with Recording(tmp_path / "got.mcap") as got:
            assert set(got.read().rewards.tolist()) == {1.0}
    assert lab.bob.call("POST", "/v1/query", of("metadata.score", 666.0)).status_code == 404
    assert lab.bob.call("POST", "/v1/tickets", {"recording": lab.names["eve"]}).status_code == 404
    listed = lab.bob.ask("POST", "/episodes/list", {})  # PyTupli's
    assert [each["created_by"] for each in listed] == ["ann"] * 3


def test_everybody_sees_their_own(lab: Lab) -> None:
    assert owners(lab.eve) == ["eve"] * 3 and owners(lab.ann) == ["ann"] * 3
    assert lab.eve.ask("POST", "/v1/tickets", {"recording": lab.names["eve"]})["whole"]


def test_pages_show_what_was_stored_first(lab: Lab) -> None:
    with Browser(lab.url, "bob") as browser:
        as_json = {"format": "json"}
        shown = browser.client.get(f"/episode/{lab.ids[0]}", params=as_json).json()
        assert shown["created_by"] == "ann"
        table = browser.client.get("/episodes", params=as_json).json()["episodes"]
        assert [each["created_by"] for each in table] == ["ann"] * 3


def test_a_dataset_with_the_same_recording_of_two_users_shows_an_episode(lab: Lab) -> None:
    lab.eve.send(lab.whole)  # instead of the forgery, so that it sorts before that of ann, which is shown
    with Browser(lab.url, "bob") as browser:
        for show in ("newest", "best", "worst"):
            told = browser.client.get("/dataset/-", params={"format": "json", "show": show}).json()
            assert told["episode"] in lab.ids
        assert browser.client.get("/cover/-").status_code == 200


def test_a_pull_brings_what_was_stored_first(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "bob"))
    with TupliAPIClient(lab.url) as bob, FileStorage(tmp_path / "mine") as mine:
        bob.login("bob", "bob's password")
        copy_episodes(bob, mine)
        assert {each.metadata["score"] for each in mine.list_episodes()} == {1.0}


def test_episodes_without_their_benchmark_keep_nobody_from_a_pull_of_others(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CONFIG_DIR", str(tmp_path / "bob"))
    benchmark = lab.eve.ask("POST", "/v1/benchmarks/list", {})["items"][0]["id"]
    other = recorded(tmp_path / "other.mcap", 2.0, benchmark_id=benchmark)
    lab.eve.send(other)
    lab.publish(lab.eve)
    with TupliAPIClient(lab.url) as bob, FileStorage(tmp_path / "mine") as mine:
        bob.login("bob", "bob's password")
        with pytest.warns(UserWarning, match=f"not copied: 3 episodes: there is no benchmark .*{benchmark}"):
            assert list(copy_episodes(bob, mine)) == [""]
        assert {each.metadata["score"] for each in mine.list_episodes()} == {1.0}
        with pytest.raises(NotFoundError, match=f"there is no benchmark .*{benchmark}"):
            copy_episodes(bob, mine, benchmark_id=benchmark)


def test_a_forgery_shows_only_to_those_who_may_not_read_the_original(lab: Lab) -> None:
    everything = {"filter": {"type": "GEQ", "key": "steps", "value": 0}, "group": "global"}
    lab.ann.ask("POST", "/v1/episodes/publish", {**everything, "published": False})
    assert owners(lab.bob) == ["eve"] * 3  # nothing says that there is an original
    assert lab.bob.call("POST", "/v1/tickets", {"recording": lab.names["ann"]}).status_code == 404
    lab.publish(lab.ann)
    assert owners(lab.bob) == ["ann"] * 3


def test_of_episodes_those_that_may_be_read_are_shown(lab: Lab, tmp_path: Path) -> None:
    first = {**of("id", lab.ids[0]), "group": "global", "published": False}
    lab.ann.ask("POST", "/v1/episodes/publish", first)
    assert sorted(owners(lab.bob)) == ["ann", "ann", "eve"]
    ticket = lab.bob.ask("POST", "/v1/tickets", {"recording": lab.names["eve"]})
    assert not ticket["whole"]
    (tmp_path / "got.mcap").write_bytes(lab.bob.call("GET", ticket["path"]).content)
    with Recording(tmp_path / "got.mcap") as got:
        assert [episode.number for episode in got.episodes] == [0]


def test_who_lies_in_wait_for_a_deletion_gains_nothing(lab: Lab) -> None:
    lab.delete(lab.ann)
    assert owners(lab.bob) == ["eve"] * 3
    lab.ann.send(lab.whole)
    lab.publish(lab.ann)
    assert owners(lab.bob) == ["ann"] * 3


def test_a_forger_who_stores_again_is_still_later(lab: Lab) -> None:
    lab.delete(lab.eve)
    lab.eve.send(lab.forged)
    lab.publish(lab.eve)
    assert owners(lab.bob) == ["ann"] * 3


def test_who_may_delete_what_others_have_stored_deletes_all_copies(lab: Lab) -> None:
    assert lab.bob.call("DELETE", f"/v1/episodes/{lab.ids[0]}").status_code == 403
    lab.admin.ask("DELETE", f"/v1/episodes/{lab.ids[0]}")
    assert owners(lab.bob, **of("id", lab.ids[0])) == []
    lab.ann.ask("DELETE", f"/v1/episodes/{lab.ids[1]}")
    assert owners(lab.bob, **of("id", lab.ids[1])) == ["eve"]
    lab.admin.ask("DELETE", f"/v1/episodes/{lab.ids[1]}/published", params={"group": "global"})
    assert owners(lab.bob, **of("id", lab.ids[1])) == []
