"""Episodes that a server cuts out of recordings while it sends them."""

from __future__ import annotations

import contextlib
import gc
import pickle
import socket
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np
import pytest
from gymnasium import spaces
from persons import Person
from schema_files import validator
from test_server import Things, Users, things, token_of, users
from waiting import wait_for

import tupli_mcap
from tupli_mcap import EpisodeData, Recording, TupliDataset, verify_recording, write_recording
from tupli_mcap.errors import FormatError, NotFoundError, StorageError
from tupli_mcap.recording.edit.merge import Excerpt
from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.remote import is_cut_cheaper
from tupli_mcap.schema import BaseFilter, F, FilterEQ, parse_filter
from tupli_mcap.server.app import create_app
from tupli_mcap.storage import TupliAPIClient

__all__ = ["things", "users"]  # fixtures


def short_episodes(path: Path, count: int, seed: int, space: Any = None) -> Path:
    """Episodes of about 22 steps."""
    random = np.random.default_rng(seed)
    space = space or spaces.Box(-1, 1, (4,))
    episodes = []
    for i in range(count):
        n = int(random.integers(10, 35))
        states = random.uniform(-1, 1, (n, *space.shape)).astype(np.float32)
        episodes.append(
            EpisodeData(
                states, random.integers(0, 2, n), np.ones(n), np.zeros(n, bool), np.arange(n) == n - 1, states[0],
                metadata={"score": i, "best": i % 100 == 7},
            )
        )  # fmt: skip
    write_recording(path, episodes, observation_space=space, action_space=spaces.Discrete(2))
    return path


def asked(user: TupliAPIClient, **told: Any) -> httpx.Response:
    return httpx.post(f"{user.url}/v1/query", headers=token_of(user), json=told, timeout=60)


def filtered(wanted: BaseFilter) -> Any:
    return wanted.model_dump(mode="json")


@pytest.fixture
def names(users: Users, tmp_path: Path) -> list[str]:
    """Two recordings of ann's, one after the other, and one of another space."""
    other = spaces.Box(-1, 1, (3,))
    paths = [short_episodes(tmp_path / f"{i}.mcap", 600 if i else 300, i) for i in range(2)]
    return [users.ann.push(path) for path in (*paths, short_episodes(tmp_path / "other.mcap", 3, 2, other))]


def kept(answer: httpx.Response, path: Path) -> Recording:
    """The recording that an answer is."""
    assert answer.status_code == 200, answer.text
    path.write_bytes(answer.content)
    assert verify_recording(path).problems == []
    return Recording(path)


def test_a_filter_may_be_the_text_of_one(users: Users, names: list[str], tmp_path: Path) -> None:
    text = "metadata.score >= 595 and not metadata.best"
    wanted = filtered(parse_filter(text))
    same = {"recordings": [names[1]]}
    with kept(asked(users.ann, filter=text, **same), tmp_path / "cut.mcap") as cut:
        assert list(cut.index["episode"]) == [595, 596, 597, 598, 599]
    for path, told in (("episodes/list", {}), ("episodes/count", {}), ("query/tickets", same)):
        by_text, by_json = (
            users.ann._session.ask("POST", f"/v1/{path}", {"filter": each, **told}) for each in (text, wanted)
        )
        if path != "query/tickets":  # whose addresses differ
            assert by_text == by_json
    assert by_text["path"].startswith("/v1/manifest?ticket=")
    with pytest.raises(
        StorageError, match="expected another request: filter: filter 'steps >' needs a value"
    ):
        users.ann._session.ask("POST", "/v1/episodes/count", {"filter": "steps >"})
    for path in ("benchmarks/list", "artifacts/list"):
        assert users.ann._session.ask("POST", f"/v1/{path}", {"filter": 'id = "x"'})["items"] == []
    for path in ("episodes/publish", "episodes/delete"):
        told = {"filter": text, "group": "global"} if path == "episodes/publish" else {"filter": text}
        assert users.ann._session.ask("POST", f"/v1/{path}", told) == {"episodes": 5}
    document = httpx.get(f"{users.url}/openapi.json", timeout=60).json()["components"]["schemas"]
    for model in ("Listing", "Chosen", "Shown", "EpisodeQuery"):
        kinds = document[model]["properties"]["filter"]["anyOf"]
        assert {"$ref": "#/components/schemas/BaseFilter"} in kinds and "string" in str(kinds), model


def test_exactly_the_episodes_that_match(users: Users, names: list[str], tmp_path: Path) -> None:
    wanted = filtered(F("metadata.best") == True)  # noqa: E712 - an expression
    answer = asked(users.ann, filter=wanted, recordings=[names[1]])
    assert (answer.headers["Recording-Count"], answer.headers["Episode-Count"]) == ("1", "6")
    with kept(answer, tmp_path / "cut.mcap") as cut, Recording(tmp_path / "1.mcap") as whole:
        assert len(answer.content) < 0.03 * whole.size
        assert cut.uuid == whole.uuid
        assert [episode.number for episode in cut.episodes] == [7, 107, 207, 307, 407, 507]
        for episode in cut.episodes:
            assert np.array_equal(episode.states, whole.episodes[episode.number].states)
            assert np.array_equal(episode.final_state, whole.episodes[episode.number].final_state)
        everything = kept(asked(users.ann, recordings=[names[1]]), tmp_path / "all.mcap")
        stores = [recording.file.store for recording in (everything, whole)]
        tables = [store.table[store.chunks(whole.file.steps[0])] for store in stores]
        assert np.array_equal(*(table[["length", "crc"]] for table in tables))  # copied as they are


def test_episodes_of_several_recordings_are_merged(users: Users, names: list[str], tmp_path: Path) -> None:
    wanted = filtered(F("metadata.best") == True)  # noqa: E712
    answer = asked(users.ann, filter=wanted)
    assert (answer.headers["Recording-Count"], answer.headers["Episode-Count"]) == ("2", "9")
    with kept(answer, tmp_path / "merged.mcap") as merged:
        scores = [episode.metadata["score"] for episode in merged.episodes]
        assert scores == [7, 107, 207, 7, 107, 207, 307, 407, 507]
        sources = [Recording(tmp_path / f"{i}.mcap") for i in (0, 1)]
        for episode, source in zip(merged.episodes, [0] * 3 + [1] * 6, strict=True):
            expected = sources[source].episodes[episode.metadata["score"]]
            assert np.array_equal(episode.states, expected.states)
    refused = asked(users.ann)
    assert (refused.status_code, refused.json()["error"]) == (400, "SpaceError")
    assert names[2] in refused.json()["detail"] and str(tmp_path) not in refused.text


def test_fields_that_are_not_asked_for_are_left_out(users: Users, names: list[str], tmp_path: Path) -> None:
    whole = asked(users.ann, recordings=names[:2])
    answer = asked(users.ann, recordings=names[:2], fields=["actions", "rewards"])
    assert len(answer.content) < 0.7 * len(whole.content)
    with kept(answer, tmp_path / "few.mcap") as few, kept(whole, tmp_path / "whole.mcap") as merged:
        assert (few.observation_space, few.action_space) == (spaces.Dict({}), merged.action_space)
        assert np.array_equal(few.read().actions, merged.read().actions)
        assert [e.metadata for e in few.episodes] == [e.metadata for e in merged.episodes]
        told = few.made_of
        assert told is not None and told["without"] == ["frames", "infos", "states"]
        validator("made_of.schema.json").validate(told)
    unlike = asked(users.ann, fields=["actions"])  # their states differ, their actions do not
    assert kept(unlike, tmp_path / "unlike.mcap").n_steps > 0
    refused = asked(users.ann, fields=["velocity"])
    assert refused.status_code == 400 and "expected fields from states" in refused.json()["detail"]


def test_benchmarks_and_rights(users: Users, things: Things, names: list[str], tmp_path: Path) -> None:
    of_benchmark = {"benchmark_filter": filtered(FilterEQ(key="id", value=things.benchmark))}
    assert len(kept(asked(users.ann, **of_benchmark), tmp_path / "of.mcap")) == 2
    for told in ({}, of_benchmark, {"recordings": [names[1]]}):
        assert asked(users.bob, **told).status_code == 404
    users.ann.publish_episodes(F("metadata.score") < 5)
    seen = kept(asked(users.bob, recordings=[names[1]]), tmp_path / "seen.mcap")
    assert [episode.number for episode in seen.episodes] == [0, 1, 2, 3, 4]
    assert asked(users.bob, filter=filtered(F("metadata.score") == 5)).status_code == 404
    assert asked(users.ann, filter={"type": "EQ", "key": "nonsense", "value": 1}).status_code == 400
    users.ann.delete_episodes(F("metadata.score") == 3)
    left = kept(asked(users.bob, recordings=[names[1]]), tmp_path / "left.mcap")
    assert [episode.number for episode in left.episodes] == [0, 1, 2, 4]


def test_what_others_may_not_read_they_cannot_count(users: Users, names: list[str], tmp_path: Path) -> None:
    users.ann.publish_episodes(F("metadata.score") < 5)
    with kept(asked(users.bob, recordings=[names[1]]), tmp_path / "cut.mcap") as cut:
        assert cut.metadata["next_episode"] == "5"
        assert len(Recording(tmp_path / "1.mcap")) > 5
    fewer = {"recordings": [names[1]], "fields": ["actions"]}
    with kept(asked(users.bob, **fewer), tmp_path / "fewer.mcap") as merged:
        assert merged.made_of is not None
        assert [source["episodes"] for source in merged.made_of["sources"]] == [5]
        assert merged.metadata["next_episode"] == "5"
    with kept(asked(users.ann, **fewer), tmp_path / "own.mcap") as own:
        assert own.made_of is not None and own.made_of["sources"][0]["episodes"] > 5


def test_who_goes_away_is_not_sent_to(users: Users, tmp_path: Path) -> None:
    random, n = np.random.default_rng(0), 200_000  # more than the system keeps for a connection
    noise = random.normal(size=(n, 40)).astype(np.float32)
    data = [EpisodeData(noise, np.zeros(n, int), np.ones(n), np.zeros(n, bool), np.arange(n) == n - 1)]
    write_recording(
        tmp_path / "large.mcap",
        data,
        observation_space=spaces.Box(-np.inf, np.inf, (40,)),
        action_space=spaces.Discrete(2),
    )
    name = users.ann.push(tmp_path / "large.mcap")
    url, headers = f"{users.url}/v1/query", token_of(users.ann)
    small = httpx.HTTPTransport(socket_options=[(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)])
    with (
        httpx.Client(transport=small) as client,
        client.stream("POST", url, json={"recordings": [name]}, headers=headers) as answer,
    ):
        assert len(next(answer.iter_raw(1 << 16))) == 1 << 16
        assert any(thread.name == "tupli-stream" for thread in threading.enumerate())
    wait_for(lambda: not any(thread.name == "tupli-stream" for thread in threading.enumerate()))


def test_a_stream_tells_what_goes_wrong(tmp_path: Path) -> None:
    path = short_episodes(tmp_path / "a.mcap", 200, 0)
    data = bytearray(path.read_bytes())
    with Recording(path) as recording:
        row = recording.file.contents.table[-1]
        data[int(row["offset"]) + 80] ^= 1
        path.write_bytes(data)
    opening = contextlib.ExitStack()
    recording = opening.enter_context(Recording(path))

    @contextlib.contextmanager
    def opened() -> Iterator[list[Excerpt]]:
        with opening:
            yield [Excerpt(recording, recording.index)]

    with pytest.raises(FormatError, match="CRC|decompress"):
        list(stream_excerpts(opened()))


@pytest.fixture
def sent(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The bytes of all bodies that the server sends."""
    found: list[int] = []

    def counted(library: Any) -> Any:
        app = create_app(library)

        async def counting(scope: Any, receive: Any, send: Any) -> None:
            async def count(message: Any) -> None:
                found.append(len(message.get("body", b"")))
                await send(message)

            await app(scope, receive, count)

        return counting

    monkeypatch.setattr("serving.create_app", counted)
    return found


def test_few_short_episodes_of_a_server_move_few_bytes(
    sent: list[int], users: Users, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    path = short_episodes(tmp_path / "a.mcap", 4000, 0)
    users.ann.push(path)
    best = list(range(7, 4000, 100))
    expected = Recording(path).read(episodes=best)
    sent.clear()
    dataset = TupliDataset(users.ann).with_episode_filter(F("metadata.best") == True)  # noqa: E712
    dataset.load()
    assert sum(sent) < 0.02 * path.stat().st_size
    assert np.array_equal(dataset.convert_to_numpy()[0], expected.states)
    sent.clear()
    some = tupli_mcap.open(users.ann).filter("metadata.best")
    assert np.array_equal(some.read(["actions"]).actions, expected.actions)
    assert sum(sent) < 0.02 * path.stat().st_size
    sent.clear()
    with Recording(some.save(tmp_path / "saved.mcap")) as saved:
        assert saved.index["episode"].tolist() == best
        assert np.array_equal(saved.read().rewards, expected.rewards)
    assert sum(sent) < 0.02 * path.stat().st_size
    windows = some.windows(8)
    copy = pickle.loads(pickle.dumps(windows))
    assert np.array_equal(copy[100].states, windows[100].states)
    assert [episode.number for episode in some] == best and len(list(temporary.iterdir())) == 1
    del some, windows, copy, dataset
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_an_episode_that_was_not_cut_out_is_fetched_all_the_same(users: Users, tmp_path: Path) -> None:
    """A dataset that was narrowed shares what is open with the one that it was narrowed from."""
    users.ann.push(short_episodes(tmp_path / "a.mcap", 1000, 0))
    everything = tupli_mcap.open(users.ann)
    assert len(everything[:3][0].states) == everything.lengths[0]
    assert len(everything[500].states) == everything.lengths[500]
    local = tupli_mcap.open(tmp_path / "a.mcap")
    assert np.array_equal(everything[999].states, local[999].states)
    numbers = [1, 2, 3]
    few, many = (users.ann.open_recording(everything.headers[0].recording, n) for n in (numbers, range(900)))
    assert few.index["episode"].tolist() == numbers and len(many) == 1000
    with pytest.raises(NotFoundError, match="there is no such episode"):
        users.ann.open_recording(everything.headers[0].recording, [5000])


@pytest.mark.parametrize(
    ("wanted", "episodes", "size", "cut"),
    [
        (90, 9000, 10 << 20, True),  # short ones, which lie in nearly all chunks
        (9000, 9000, 10 << 20, False),
        (4500, 9000, 10 << 20, False),
        (4, 380, 49 << 20, False),  # of a thousand steps
        (1, 1, 1 << 30, False),
        (1, 100, 100 << 10, True),  # the tail alone is more
    ],
)
def test_the_server_cuts_where_ranges_bring_much_more(
    wanted: int, episodes: int, size: int, cut: bool
) -> None:
    assert is_cut_cheaper(range(wanted), episodes, size) == cut
    assert not is_cut_cheaper(None, episodes, size)


def test_a_part_is_cut_without_the_episodes_of_other_parts(users: Users, tmp_path: Path) -> None:
    """As the server keeps them of a recording that goes on."""
    whole = short_episodes(tmp_path / "whole.mcap", 6, 0)
    with Recording(whole) as recording:
        halves = [
            b"".join(stream_excerpts(contextlib.nullcontext([Excerpt(recording, recording.index[some])])))
            for some in (slice(0, 3), slice(3, 6))
        ]
    ann = Person(users.url, "ann", "ann-password")
    names = [ann.send(half) for half in halves]
    gone = ann.ask("POST", "/v1/episodes/list", {"filter": "episode = 4"})["items"][0]
    assert gone["recording"] == names[1]
    ann.ask("DELETE", f"/v1/episodes/{gone['id']}")
    (source,) = ann.ask("GET", "/v1/manifest", params={"recording": names[1]})["sources"]
    for answer in (
        ann.call("GET", f"/v1/files/{quote(names[1])}"),
        ann.call("POST", "/v1/query", {"recordings": [names[1]]}),
        ann.call("GET", f"/v1/{source['url']}"),
    ):
        with kept(answer, tmp_path / "cut.mcap") as cut:
            assert cut.index["episode"].tolist() == [3, 5]
