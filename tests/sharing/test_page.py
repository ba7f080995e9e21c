"""The page: datasets, tables and episodes as HTML and JSON, and nothing of a file that acts."""

from __future__ import annotations

import html
import io
import math
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import gymnasium as gym
import httpx
import numpy as np
import pytest
from mcap.reader import make_reader
from pages import EVIL, browsing, carts, robot, serving_app
from typer.testing import CliRunner

import tupli_mcap
from tupli_mcap.cli import app
from tupli_mcap.errors import NotFoundError
from tupli_mcap.jsonvalue import dumps_plain
from tupli_mcap.page import copies, curves
from tupli_mcap.page.app import create_app
from tupli_mcap.page.curves import curves_of, values_at
from tupli_mcap.page.directory import DirectoryShelf, FileShelf
from tupli_mcap.page.routes import lists
from tupli_mcap.page.texts import duration, number as spelled
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.storage import FileStorage
from tupli_mcap.storage.catalog.entries import Entry
from tupli_mcap.storage.catalog.rows import EpisodeRow
from tupli_mcap.storage.listing import RecordingStamp
from tupli_mcap.wrappers.rollout import record_rollouts

ACTING = re.compile("<script>|<img src=x", re.IGNORECASE)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("lab")
    carts(root)
    robot(root / "robot.mcap")
    return root


@pytest.fixture(scope="module")
def web(lab: Path) -> Iterator[httpx.Client]:
    with browsing(lab) as address, httpx.Client(base_url=address, timeout=120) as client:
        yield client


def told(client: httpx.Client, address: str, **params: Any) -> Any:
    answer = client.get(address, params={**params, "format": "json"})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/json"
    return answer.json()


def addresses(client: httpx.Client) -> list[str]:
    """A page of each kind."""
    episodes = told(client, "/episodes")["episodes"]
    keys = [dataset["key"] for dataset in told(client, "/")["datasets"]]
    ids = list({episode["recording"]: episode["id"] for episode in episodes}.values())
    return [
        "/",
        "/?q=cart",
        "/episodes",
        "/episodes?filter=steps+%3E",
        *(f"/episodes?dataset={key}&sort=-return" for key in keys),
        *(f"/dataset/{key}" for key in keys),
        *(f"/episode/{uri}?step=3" for uri in ids),
        "/episode/nope",
        f"/compare?{'&'.join(f'episode={uri}' for uri in ids[:2])}",
        "/nowhere",
    ]


def damage(path: Path, topic: str) -> None:
    """Changes a byte of the only chunk with messages of a topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    (channel,) = (one.id for one in summary.channels.values() if one.topic == topic)
    (chunk,) = (one for one in summary.chunk_indexes if channel in one.message_index_offsets)
    data = bytearray(path.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 255
    path.write_bytes(data)


class TestDatasets:
    def test_they_are_put_together_by_environment(self, web: httpx.Client, lab: Path) -> None:
        found = {dataset["name"]: dataset for dataset in told(web, "/")["datasets"]}
        assert set(found) == {"CartPole-v1", "open the drawer"}
        carts = tupli_mcap.open(str(lab / "ppo*.mcap"))
        told_of = found["CartPole-v1"]
        assert (told_of["recordings"], told_of["episodes"], told_of["steps"]) == (2, 24, carts.n_steps)
        assert told_of["return"]["mean"] == pytest.approx(carts.returns.mean())
        assert told_of["return"]["max"] == carts.returns.max()
        assert found["open the drawer"]["success"] == 0.5

    def test_search(self, web: httpx.Client) -> None:
        assert [d["name"] for d in told(web, "/", q="CART baseline")["datasets"]] == ["CartPole-v1"]
        assert told(web, "/", q="hopper")["datasets"] == []
        assert "No dataset matches" in web.get("/?q=hopper").text

    def test_there_is_no_page_after_the_last(self, web: httpx.Client) -> None:
        answer = web.get("/", params={"page": 2})
        assert answer.status_code == 404 and "there is no page 2 of datasets" in answer.text

    def test_recordings_of_a_dataset_are_paged(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        carts(tmp_path, seeds=3, episodes=1)
        monkeypatch.setattr("tupli_mcap.page.routes.dataset._RECORDINGS", 2)
        with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
            first, second = (client.get(f"/dataset/CartPole-v1?page={page}").text for page in (1, 2))
            beyond = client.get("/dataset/CartPole-v1?page=3")
        files = [re.findall(r'path" title="([^"]*)"', page) for page in (first, second)]
        assert [len(names) for names in files] == [2, 1] and len({*files[0], *files[1]}) == 3
        assert ('rel="next"' in first, 'rel="prev"' in first) == (True, False)
        assert ('rel="next"' in second, 'rel="prev"' in second) == (False, True)
        assert beyond.status_code == 404 and "no page 3 of the recordings" in beyond.text

    def test_a_dataset_opens_with_an_episode(self, web: httpx.Client) -> None:
        facts = told(web, "/dataset/CartPole-v1", show="best")
        best = told(web, "/episodes", dataset="CartPole-v1", sort="-return")["episodes"][0]
        assert facts["episode"] == best["id"]
        text = web.get("/dataset/CartPole-v1?show=best").text
        assert f"[[&#34;{best['id']}&#34;, {best['n_tuples']}]]" in text
        for said in ("Cart Position", "Pole Angle", "ppo-seed1", "Return of episodes over time", "gymnasium"):
            assert said in text

    def test_a_recording_has_the_names_and_tags_of_all_its_runs(self, tmp_path: Path) -> None:
        for name in ("ppo", "dqn", "sac"):
            with tupli_mcap.RecordEpisodes(
                gym.make("CartPole-v1"), tmp_path / f"{name}.mcap", name=name, tags=[f"tag-{name}"]
            ) as env:
                for steps in range(10):
                    env.reset()
                    for _ in range(1 + steps % 3):
                        env.step(0)
        both = [tmp_path / "ppo.mcap", tmp_path / "dqn.mcap"]
        tupli_mcap.merge_recordings(both, tmp_path / "both.mcap")
        for path in both:
            path.unlink()
        with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
            text = client.get("/dataset/CartPole-v1").text
        assert set(re.findall(r'<li class="s\d"><bdi>(.*?)</bdi>', text)) == {"ppo, dqn", "sac"}
        assert "<bdi>tag-ppo, tag-dqn</bdi>" in text

    def test_benchmarks_are_datasets(self, tmp_path: Path) -> None:
        storage = FileStorage(tmp_path)
        env = tupli_mcap.TupliEnvWrapper(gym.make("CartPole-v1"), storage=storage)
        uri = env.store(name="balance", description="a pole on a cart")
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            (empty,) = told(client, "/")["datasets"]
            assert (empty["key"], empty["name"], empty["episodes"]) == (uri, "balance", 0)
            assert "a pole on a cart" in client.get(f"/dataset/{uri}").text
            env.reset(seed=1)
            env.step(0)
            env.close()
            (dataset,) = told(client, "/")["datasets"]  # what is new is there when the page is reloaded
            assert (dataset["episodes"], dataset["environment"]) == (1, "CartPole-v1")

    def test_a_storage_within_a_directory_keeps_the_names_of_its_benchmarks(self, tmp_path: Path) -> None:
        env = tupli_mcap.TupliEnvWrapper(gym.make("CartPole-v1"), storage=tmp_path / "runs" / "lab")
        uri = env.store(name="balance", description="a pole on a cart")
        env.reset(seed=1)
        env.step(0)
        env.close()
        before = sorted(tmp_path.rglob("*"))
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            (dataset,) = told(client, "/")["datasets"]
            assert (dataset["key"], dataset["name"], dataset["episodes"]) == (uri, "balance", 1)
            assert "a pole on a cart" in client.get(f"/dataset/{uri}").text
        assert [path for path in sorted(tmp_path.rglob("*")) if "runs" in path.parts] == before

    @pytest.mark.sampled(11)
    @pytest.mark.parametrize("benchmark_id", ["", "no hash"])
    @pytest.mark.parametrize(
        "name",
        [
            "ALE/Breakout-v5",
            "..",
            "a b",
            "x/../../y",
            "über",
            "\ud800\x00",
            "",
            "f" * 64,
            "~",
            "~eAA",
            "a" * 999,
        ],
    )
    def test_any_name_has_an_address(self, name: str, benchmark_id: str) -> None:
        shelf = FileShelf(Path("gone.mcap"))
        shelf._follow = lambda: None  # type: ignore[method-assign]
        runs = dumps_plain([{"environment": name}])
        row = EpisodeRow(0, 0, 1, "terminal", 1.0, 7, 1, "me", '["me"]', "{}")
        stamp = RecordingStamp(1, 2, 3)
        shelf._catalog.put_recording("gone.mcap", Entry(stamp, "u", benchmark_id, [row], runs))
        with serving_app(create_app(shelf)) as address, httpx.Client(base_url=address) as client:
            (link,) = set(re.findall(r'href="(/dataset/[^"]*)"', client.get("/").text))
            answer = client.get(html.unescape(link))
            assert answer.status_code == 200
            assert "This episode cannot be read" in answer.text


class TestTables:
    def test_pages_and_order(self, web: httpx.Client) -> None:
        first = told(web, "/episodes", sort="-return")
        returns = [episode["episode_return"] for episode in first["episodes"]]
        assert returns == sorted(returns, reverse=True)
        assert first["count"] == 26
        assert (first["before"], first["after"]) == (None, None)

    def test_paging_forth_and_back(self, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=120)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            pages, page = [], told(client, "/episodes", sort="steps")
            pages.append(page)
            while page["after"]:
                page = told(client, "/episodes", sort="steps", after=page["after"])
                pages.append(page)
            assert [len(page["episodes"]) for page in pages] == [50, 50, 20]
            back = [pages[-1]]
            while back[-1]["before"]:
                back.append(told(client, "/episodes", sort="steps", before=back[-1]["before"]))
            ids = [[episode["id"] for episode in page["episodes"]] for page in pages]
            assert [[episode["id"] for episode in page["episodes"]] for page in back] == ids[::-1]

    def test_what_no_index_leads_to(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        carts(tmp_path, seeds=1, episodes=3)
        asked = {"filter": "metadata.score > 1 and steps > 0", "sort": "-metadata.score"}
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            assert "No index" not in client.get("/episodes", params=asked).text
            monkeypatch.setattr(lists, "_MANY", 2)
            monkeypatch.setattr(lists, "_ASKED", 2)
            (code,) = re.findall(
                "This makes one: <code>(.*?)</code>", client.get("/episodes", params=asked).text
            )
            program, *words = shlex.split(html.unescape(code))
            assert program == "tupli-mcap"
            assert CliRunner().invoke(app, words).stdout == "metadata.score has an index\n"
            assert "No index" not in client.get("/episodes", params=asked).text

    def test_filters(self, web: httpx.Client) -> None:
        found = told(web, "/episodes", filter='run.name == "ppo-seed1" and steps > 20')["episodes"]
        assert found
        assert all(e["run"]["name"] == "ppo-seed1" and e["n_tuples"] > 20 for e in found)

    @pytest.mark.parametrize(
        ("text", "position", "said"),
        [
            ("steps >", 7, "needs a value"),
            ("steps > 3 and retrun < 4", 14, "did you mean &#39;return&#39;"),
            ("end == 'lost'", 0, "terminal, timeout or interrupted"),
            ("a b", 2, "needs one of"),
            ("steps > 3 and metadata.socre > 4", None, "no episode has metadata.socre"),
        ],
    )
    def test_an_error_is_shown_where_it_is(
        self, web: httpx.Client, text: str, position: int | None, said: str
    ) -> None:
        answer = web.get("/episodes", params={"filter": text, "format": "json"})
        assert (answer.status_code, answer.json()["position"]) == (400, position)
        shown = web.get("/episodes", params={"filter": text}).text
        if position is not None:
            marked = re.search(r"<pre>(.*)<mark>(.*)</mark></pre>", shown)
            assert marked and html.unescape(marked[1]) == text[:position]
        assert said in shown
        assert 'aria-invalid="true"' in shown

    def test_a_key_that_has_no_order(self, web: httpx.Client) -> None:
        assert "cannot sort by" in web.get("/episodes?sort=run.name").text


class TestEpisodes:
    def test_every_column_that_is_a_link_has_an_order(self, tmp_path: Path) -> None:
        FileStorage(tmp_path).declare_key('metadata."日本"')
        box, zero = gym.spaces.Box(-1, 1, (1,), np.float32), np.zeros(1, np.float32)
        with tupli_mcap.EpisodeWriter(tmp_path / "run.mcap", box, box) as writer:
            for i in range(3):
                writer.begin(metadata={"a b": i, 'x"y': i, "é": i, "日本": i})
                writer.step(zero, zero, reward=1.0, terminal=True)
                writer.end(zero)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            heads = re.findall(r'<th scope="col".*?</th>', client.get("/episodes").text)
            links = [html.unescape(link) for head in heads for link in re.findall(r'href="([^"]*)"', head)]
            for link in links:
                assert client.get(link).status_code == 200, link
            sorted_by = {parse_qs(urlsplit(link).query)["sort"][0] for link in links}
            assert {"-metadata.a b", "-metadata.日本"} <= sorted_by and len(heads) == len(links) + 5

    def test_what_is_known_of_it(self, web: httpx.Client, lab: Path) -> None:
        with tupli_mcap.Recording(lab / "robot.mcap") as recording:
            episode = recording.episodes[1]
            facts = told(web, f"/episode/{episode.id}", step=7)
            assert facts["reset"]["seed"] == 1
            assert facts["cameras"] == [{"name": "state.wrist", "steps": list(range(20))}]
            assert facts["step"]["state"]["state.joints[0]"] == f"{episode.states['joints'][7, 0]:.5g}"
            assert facts["step"]["state"]["state.open the drawer"] == "open the drawer"
            assert facts["step"]["action"]["action"] == "open the drawer (1)"
            assert facts["step"]["info"] == {"info.force": "3.5", "info.said": "open the drawer"}
            assert facts["step"]["reward"] == {"reward": "0.7", "return so far": "2.8"}

    def test_values_of_a_step(self, web: httpx.Client) -> None:
        uri = told(web, "/episodes", filter='recording == "robot.mcap"')["episodes"][0]["id"]
        last = web.get(f"/episode/{uri}/step/19").json()
        assert last["end"] == {"end": "terminal"}
        assert web.get(f"/episode/{uri}/step/20").status_code == 404

    def test_returns_that_overflow(self, tmp_path: Path) -> None:
        space, n = gym.spaces.Discrete(2), 4
        flags = [False] * n
        episode = tupli_mcap.EpisodeData([0] * n, [0] * n, [1e308] * n, flags, flags)
        tupli_mcap.write_recording(
            tmp_path / "r.mcap", [episode], observation_space=space, action_space=space
        )
        with tupli_mcap.Recording(tmp_path / "r.mcap") as recording:
            assert curves_of(recording.episodes[0]).tracks
            told = values_at(recording.episodes[0], 3)
        assert told["reward"] == {"reward": "1e+308", "return so far": "inf"}

    def test_labels_that_are_equal(self, tmp_path: Path) -> None:
        box = gym.spaces.Box(-9, 9, (3,), np.float64)
        for path in (tmp_path / "a.mcap", tmp_path / "b.mcap"):
            with tupli_mcap.EpisodeWriter(path, box, box, labels={"observations": ["x", "y", "x"]}) as writer:
                writer.begin()
                writer.step(np.array([1.0, 2.0, 3.0]), np.zeros(3), reward=1.0, terminal=True)
                writer.end(np.zeros(3))
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            ids = [episode["id"] for episode in told(client, "/episodes")["episodes"]]
            shown = client.get(f"/episode/{ids[0]}").text
            values = dict(re.findall(r'<output data-name="(.*?)".*?>(.*?)</output>', shown))
            assert [values[name] for name in ("x", "y", "x (2)")] == ["1", "2", "3"]
            compared = client.get("/compare", params={"episode": ids}).text
            assert re.findall(r'class="name" title="(x.*?|y)"', compared) == ["x", "y", "x (2)"]

    def test_numbers_within_infos(self, tmp_path: Path) -> None:
        info = {"contact": {"left": np.array([1.5, -2])}, "force": 123456789, "note": [1, 2]}
        with tupli_mcap.RecordEpisodes(
            gym.make("CartPole-v1"), tmp_path / "r.mcap", step_callback=lambda step: info
        ) as env:
            env.reset(seed=1)
            env.step(0)
        with tupli_mcap.Recording(tmp_path / "r.mcap") as recording:
            tracks = curves_of(recording.episodes[0]).of("info")
            told = values_at(recording.episodes[0], 0)["info"]
        names = ["info.force", "info.contact.left[0]", "info.contact.left[1]"]
        assert [track.name for track in tracks] == names
        assert [told[name] for name in names] == ["123456789", "1.5", "-2"] and told["info.note"] == "[1, 2]"

    def test_values_between_gaps_are_seen(self, tmp_path: Path) -> None:
        """Of an info that few steps have, and of one whose last value is alone."""
        given = [{"loss": 1.0, "both": 0.0}, {"both": 2.0}, {}, {"loss": 3.0}, {}, {"both": 1.0}]
        space = gym.spaces.Box(0, 9, (1,))
        with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", space, gym.spaces.Discrete(2)) as writer:
            writer.begin()
            for i, info in enumerate(given):
                writer.step(space.sample(), 1, 1.0, i == 5, info=info)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            (uri,) = (one["id"] for one in told(client, "/episodes")["episodes"])
            text = client.get(f"/episode/{uri}").text
        lines = re.findall(
            r'class="name" title="(info.*?)">.*?<path class="line s0" d="([^"]*)"', text, re.DOTALL
        )
        assert [(name, re.sub(r"[\d.]+ [\d.]+", "", line)) for name, line in lines] == [
            ("info.loss", "Mh1Mh1"),
            ("info.both", "MLMh1"),
        ]

    def test_a_depth_is_a_picture_without_curves(self, tmp_path: Path) -> None:
        space = gym.spaces.Dict({"depth": gym.spaces.Box(0, 9, (16, 16)), "q": gym.spaces.Box(-1, 1, (2,))})
        with tupli_mcap.EpisodeWriter(tmp_path / "r.mcap", space, gym.spaces.Discrete(2)) as writer:
            writer.begin()
            writer.step(space.sample(), 1, 1.0, True)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            (uri,) = (one["id"] for one in told(client, "/episodes")["episodes"])
            text = client.get(f"/episode/{uri}").text
            assert "state.depth is a picture (16 x 16) and has no curves." in text
            assert "state.q[1]" in text and "state.depth[" not in text

    def test_a_curve_ends_where_reading_ended(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        carts(tmp_path, seeds=1, episodes=12)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            episode = told(client, "/episodes", sort="-steps")["episodes"][0]
            with tupli_mcap.Recording(tmp_path / "ppo0.mcap") as recording:
                monkeypatch.setattr(curves, "_READ_BYTES", 10 * step_bytes(recording.layout, images=False))
            shown = client.get(f"/episode/{episode['id']}").text
            assert "the first 10 are shown" in shown
            (line,) = re.findall(r'title="Pole Angle".*?<path class="line s0" d="([^"]*)"', shown, re.DOTALL)[
                :1
            ]
            last = float(re.findall(r"L([\d.]+) ", line)[-1])
            assert last == pytest.approx(1000 * 9 / (episode["n_tuples"] - 1), abs=0.1)

    def test_pictures(self, web: httpx.Client) -> None:
        uri = told(web, "/episodes", filter='recording == "robot.mcap"')["episodes"][0]["id"]
        picture = web.get(f"/episode/{uri}/picture/0/3")
        assert picture.headers["content-type"] == "image/png"
        assert picture.content.startswith(b"\x89PNG")
        assert web.get(f"/episode/{uri}/picture/0/20").status_code == 404
        assert web.get(f"/episode/{uri}/picture/1/0").status_code == 404

    def test_neighbours(self, web: httpx.Client) -> None:
        listed = told(web, "/episodes", dataset="CartPole-v1", sort="-return")["episodes"]
        context = {"dataset": "CartPole-v1", "sort": "-return"}
        for at in (0, 5, len(listed) - 1):
            facts = told(web, f"/episode/{listed[at]['id']}", **context)
            assert facts["before"] == (listed[at - 1]["id"] if at else None)
            assert facts["after"] == (listed[at + 1]["id"] if at + 1 < len(listed) else None)
        own = told(web, f"/episode/{listed[0]['id']}")
        for uri in filter(None, (own["before"], own["after"])):
            assert uri.startswith(listed[0]["id"].partition("-")[0])

    def test_covers(self, web: httpx.Client) -> None:
        assert web.get("/cover/-").headers["content-type"] == "image/png"
        drawn = web.get("/cover/CartPole-v1")
        assert drawn.headers["content-type"] == "image/svg+xml"
        assert "default-src 'none'" in drawn.headers["content-security-policy"]


class TestChosen:
    @pytest.fixture(scope="class")
    def best(self, web: httpx.Client) -> list[dict[str, Any]]:
        listed: list[dict[str, Any]] = told(web, "/episodes", dataset="CartPole-v1", sort="-return")[
            "episodes"
        ]
        return listed[:3]

    def test_a_page_beside_an_episode_that_is_gone(self, web: httpx.Client) -> None:
        for way in ("after", "before"):
            answer = web.get("/episodes", params={way: "0" * 32 + "-1", "format": "json"})
            assert answer.status_code == 404
            assert "is gone" in answer.json()["error"] and "first page again" in answer.json()["error"]

    def test_durations(self) -> None:
        given = (0.0, 0.0025, 0.9999, 4.24, 45.0, 720.0, 12_600.0, 200_000.0)
        shown = ["0 ms", "2.5 ms", "999.9 ms", "4.2 s", "45 s", "12 min", "3.5 h", "2 days"]
        assert [duration(seconds) for seconds in given] == shown

    def test_numbers(self) -> None:
        given = (1234, 1234.5, -1296.4, 999.94, 999.96, 12_345.6, 0.0123, None)
        shown = ["1,234", "1,234", "\N{MINUS SIGN}1,296", "999.9", "1,000", "12,346", "0.0123", "–"]
        assert [spelled(value) for value in given] == shown

    def test_they_are_compared(self, web: httpx.Client, best: list[dict[str, Any]]) -> None:
        ids = [episode["id"] for episode in best]
        assert {e["id"] for e in told(web, "/compare", episode=ids)["episodes"]} == set(ids)
        text = web.get("/compare", params={"episode": ids}).text
        (as_json,) = re.findall(r'href="([^"]*)">This page as JSON<', text)
        assert {e["id"] for e in web.get(f"/compare{html.unescape(as_json)}").json()["episodes"]} == set(ids)
        assert text.count('class="line s2"') == len(["reward", "so far", "action", "4 states"]) + 3
        assert web.get("/compare", params={"episode": ids[:1]}).status_code == 400
        assert web.get("/compare", params={"episode": [*ids, "0" * 32 + "-1"]}).status_code == 404

    def test_an_episode_leads_back_to_the_list_it_is_of(self, web: httpx.Client) -> None:
        asked = {"filter": "steps > 10", "sort": "-return"}
        rows = web.get("/episodes", params=asked).text
        (first, *_) = re.findall(r'<th scope="row"><a href="([^"]*)"', rows)
        (back, _) = re.findall(r'href="([^"]*)">Episodes</a>', web.get(html.unescape(first)).text)
        assert html.unescape(back) == f"/episodes?{urlencode(asked)}"
        alone = web.get(html.unescape(first).partition("?")[0]).text
        assert 'href="/episodes?dataset=CartPole-v1">Episodes</a>' in alone

    def test_settings_of_their_runs_are_compared(self, tmp_path: Path) -> None:
        for number, rate in enumerate((3e-4, 1e-3)):
            run: dict[str, Any] = {"name": f"run{number}", "metadata": {"lr": rate}}
            with tupli_mcap.RecordEpisodes(
                gym.make("CartPole-v1"), tmp_path / f"{number}.mcap", **run
            ) as env:
                env.reset(seed=number)
                env.step(0)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            ids = [episode["id"] for episode in told(client, "/episodes")["episodes"]]
            shown = client.get("/compare", params={"episode": ids}).text
        (row,) = re.findall(r'<tr><th scope="row"><bdi>lr</bdi>.*?</tr>', shown)
        assert re.findall(r"<td[^>]*><bdi>(.*?)</bdi>", row) == ["0.0003", "0.001"]
        (line,) = re.findall(r'data-copy="(tupli_mcap[^"]*)"', shown)
        assert [e.id for e in eval(html.unescape(line), {"tupli_mcap": tupli_mcap})] == ids
        assert 'href="/episodes?dataset=CartPole-v1">Episodes</a>' in shown

    def test_a_film_has_the_colour_of_its_episode(self, tmp_path: Path) -> None:
        for name, frames in (("a", False), ("b", True)):
            env = gym.make("CartPole-v1", render_mode="rgb_array")
            with tupli_mcap.RecordEpisodes(env, tmp_path / f"{name}.mcap", frames=frames) as recorder:
                recorder.reset(seed=5)
                recorder.step(0)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            a, b = told(client, "/episodes")["episodes"]
            shown = client.get("/compare", params={"episode": [a["id"], b["id"]]}).text
            colours = dict(re.findall(r'class="key (s\d)" href="/episode/([^"]*)"', shown))
            (film,) = re.findall(r'<img src="/episode/([^/"]*)/.*?class="key (s\d)"', shown, re.DOTALL)
            assert film[0] == b["id"] == colours[film[1]]

    def test_they_are_downloaded(self, web: httpx.Client, best: list[dict[str, Any]], tmp_path: Path) -> None:
        path = tmp_path / "got.mcap"
        for chosen in (
            {"episode": [e["id"] for e in best]},
            {"dataset": "CartPole-v1", "filter": "steps > 100"},
        ):
            answer = web.get("/download", params=chosen)  # type: ignore[arg-type]
            assert "attachment" in answer.headers["content-disposition"]
            path.write_bytes(answer.content)
            wanted = best if "episode" in chosen else told(web, "/episodes", **chosen)["episodes"]
            with tupli_mcap.Recording(path) as recording:
                assert sorted(e.return_ for e in recording) == sorted(e["episode_return"] for e in wanted)
        one = web.get("/download", params={"episode": best[0]["id"]})
        path.write_bytes(one.content)
        with tupli_mcap.Recording(path) as recording:
            assert [episode.id for episode in recording] == [best[0]["id"]]
        assert web.get("/download", params={"filter": "steps > 100000"}).status_code == 404
        assert web.get("/download", params={"filter": "steps >"}).status_code == 400

    def test_downloads_have_names_that_tell(self, tmp_path: Path) -> None:
        for seed, name in enumerate(("Grüße", "b")):
            record_rollouts("CartPole-v1", tmp_path / f"{seed}.mcap", steps=40, seed=seed, name=name)
        with browsing(tmp_path) as url, httpx.Client(base_url=url, timeout=60) as client:
            listed = told(client, "/episodes", filter="run.name == 'Grüße'")["episodes"]
            number = told(client, "/episodes")["count"]
            for asked, name in (
                ({"episode": listed[0]["id"]}, f"Gr%C3%BC%C3%9Fe-episode-{listed[0]['episode']}.mcap"),
                ({"filter": "run.name == 'Grüße'"}, f"Gr%C3%BC%C3%9Fe-{len(listed)}-episodes.mcap"),
                ({"dataset": "CartPole-v1"}, f"CartPole-v1-{number}-episodes.mcap"),
                ({}, f"CartPole-v1-{number}-episodes.mcap"),
            ):
                answer = client.get("/download", params=asked)
                assert answer.headers["content-disposition"] == f"attachment; filename*=utf-8''{name}"

    def test_those_of_too_many_recordings_are_not_downloaded(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """All would be open at the same time, and a process may open so many files."""
        monkeypatch.setattr(copies, "MOST_MERGED", 6)
        box = gym.spaces.Box(-1, 1, (1,))
        for number in range(7):
            path = tmp_path / f"{number}.mcap"
            with tupli_mcap.EpisodeWriter(path, box, gym.spaces.Discrete(2)) as writer:
                writer.begin()
                writer.step(np.zeros(1, np.float32), 0, reward=1.0, terminal=True)
                writer.end(np.zeros(1, np.float32))
        with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
            refused = client.get("/download")
            assert refused.status_code == 400
            assert "at most 6 recordings, found 7; choose fewer" in refused.text
            few = client.get("/download", params={"filter": "recording != '6.mcap'"})
            with tupli_mcap.Recording(io.BytesIO(few.content)) as recording:
                assert len(recording) == 6

    def test_python_loads_them(self, web: httpx.Client, best: list[dict[str, Any]]) -> None:
        for address in (
            f"/episode/{best[0]['id']}",
            "/episodes?dataset=CartPole-v1&filter=steps+%3E+30+or+steps+%3C+20&sort=-return",
            "/dataset/CartPole-v1",
        ):
            line = html.unescape(re.findall(r'data-copy="(tupli_mcap[^"]*)"', web.get(address).text)[-1])
            found = eval(line, {"tupli_mcap": tupli_mcap})
            if "/episode/" in address:
                assert found.id == best[0]["id"]
            else:
                listed = "/episodes?dataset=CartPole-v1" if "/dataset/" in address else address
                expected = web.get(f"{listed}&format=json").json()["episodes"]
                assert [e.id for e in found] == [e["id"] for e in expected]

    def test_python_loads_the_episodes_of_each_dataset_and_no_others(self, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=2)
        with tupli_mcap.TupliEnvWrapper(gym.make("CartPole-v1"), storage=FileStorage(tmp_path)) as env:
            env.store(name="balance")
            env.reset(seed=1)
            env.step(0)
        box, zero = gym.spaces.Box(-1, 1, (1,), np.float32), np.zeros(1, np.float32)
        for number, environment in enumerate(("", '環境 ("v1")', "~e")):
            path = tmp_path / f"{number}.mcap"
            with tupli_mcap.EpisodeWriter(path, box, box, environment=environment) as writer:
                writer.begin()
                writer.step(zero, zero, reward=1.0, terminal=True)
                writer.end(zero)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            keys = [dataset["key"] for dataset in told(client, "/")["datasets"]]
            assert len(keys) == 5 and "-" in keys
            for key in keys:
                (line,) = re.findall(r'data-copy="(tupli_mcap[^"]*)"', client.get(f"/dataset/{key}").text)
                found = eval(html.unescape(line), {"tupli_mcap": tupli_mcap})
                assert [e.id for e in found] == [
                    e["id"] for e in told(client, "/episodes", dataset=key)["episodes"]
                ]

    def test_lines_beside_rows(self, web: httpx.Client, best: list[dict[str, Any]]) -> None:
        sparks = web.get("/sparks", params={"episode": [e["id"] for e in best]}).json()
        assert sparks["name"] == "Cart Position"  # the rewards are always the same
        assert set(sparks["lines"]) == {e["id"] for e in best}
        assert all(re.fullmatch(r"[ML0-9. -]+", line) for line in sparks["lines"].values())

    def test_lines_of_different_values_have_no_name(self, tmp_path: Path) -> None:
        box, zero = gym.spaces.Box(-1, 1, (1,), np.float32), np.zeros(1, np.float32)
        spaces = {"b": box, "a": gym.spaces.Dict({"x": box}), "c": gym.spaces.Text(5)}
        for name, space in spaces.items():
            state = {"b": zero, "a": {"x": zero}, "c": "text"}[name]
            with tupli_mcap.EpisodeWriter(tmp_path / f"{name}.mcap", space, box) as writer:
                writer.begin()
                for _ in range(3):
                    writer.step(state, zero, reward=1.0)
                writer.end(state)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            a, b, c = (episode["id"] for episode in told(client, "/episodes")["episodes"])
            for ids, name in (((a, b, c), "Curve"), ((a, c), "state.x[0]"), ((b, c), "state[0]"), ((c,), "")):
                assert client.get("/sparks", params={"episode": ids}).json()["name"] == name, ids

    def test_a_long_episode_leaves_the_lines_of_others(self, tmp_path: Path) -> None:
        box, ends = gym.spaces.Box(-1, 1, (1,), np.float32), (500_000, 5, 7)
        episodes = []
        for steps in ends:
            states, last = np.zeros((steps, 1), np.float32), np.arange(steps) == steps - 1
            rewards = np.arange(steps, dtype=float)
            actions = np.zeros(steps, int)
            episodes.append(tupli_mcap.EpisodeData(states, actions, rewards, last, ~last & last, states[0]))
        spaces = {"observation_space": box, "action_space": gym.spaces.Discrete(2)}
        tupli_mcap.write_recording(tmp_path / "a.mcap", episodes[:2], **spaces)
        tupli_mcap.write_recording(tmp_path / "b.mcap", episodes[2:], **spaces)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            ids = [episode["id"] for episode in told(client, "/episodes")["episodes"]]
            assert set(client.get("/sparks", params={"episode": ids}).json()["lines"]) == set(ids[1:])

    def test_a_film(self, web: httpx.Client) -> None:
        uri = told(web, "/episodes", filter='recording == "robot.mcap"')["episodes"][0]["id"]
        film = web.get(f"/episode/{uri}/film.mp4")
        assert b"ftyp" in film.content[:16]
        assert re.search(r'filename="\w+-episode-\d+.mp4"', film.headers["content-disposition"])

    def test_rerun_compares_episodes_of_the_same_spaces(self, web: httpx.Client) -> None:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
        cart, other = (told(web, "/episodes", dataset=key)["episodes"] for key in ("CartPole-v1", "-"))
        for chosen, alike in (((cart[0], cart[1]), True), ((cart[0], other[0]), False)):
            asked = {"episode": [episode["id"] for episode in chosen]}
            assert ("Compare in Rerun" in web.get("/compare", params=asked).text) == alike
            assert web.get("/replay.rrd", params=asked).status_code == (200 if alike else 400)

    def test_rerun(self, web: httpx.Client, best: list[dict[str, Any]]) -> None:
        pytest.importorskip("rerun", reason="rerun-sdk is not installed")
        ids = [episode["id"] for episode in best]
        for chosen in (ids[:1], ids):
            assert web.get("/replay.rrd", params={"episode": chosen}).content.startswith(b"RRF")
        page = web.get("/viewer", params={"episode": ids})
        assert "'wasm-unsafe-eval'" in page.headers["content-security-policy"]
        assert "frame-ancestors 'self'" in page.headers["content-security-policy"]
        script = re.search(r'src="(/viewer/[^"]*re_viewer.js)"', page.text)
        assert script and "wasm_bindgen" in web.get(script[1]).text
        assert web.get("/viewer/0.0.1/re_viewer.js").status_code == 404

    def test_foxglove_is_given_an_address_that_others_do_not_know(
        self, web: httpx.Client, best: list[dict[str, Any]], lab: Path
    ) -> None:
        text = html.unescape(web.get(f"/episode/{best[0]['id']}").text)
        link = re.search(r'href="(https://app.foxglove.dev/[^"]*)"', text)
        assert link
        url = parse_qs(urlsplit(link[1]).query)["ds.url"][0]
        answer = httpx.get(url, headers={"Range": "bytes=0-7"})
        assert (answer.status_code, answer.headers["access-control-allow-origin"]) == (206, "*")
        assert answer.content == (lab / best[0]["recording"]).read_bytes()[:8]
        assert httpx.get(re.sub("/file/[^/]*/", "/file/guessed/", url)).status_code == 404
        broken = lab / "line\nbreak.mcap"
        broken.write_bytes(b"no recording, but a file of this directory")
        found = httpx.get(re.sub("(/file/[^/]*/).*", r"\1line%0Abreak.mcap", url))
        broken.unlink()
        assert found.content == b"no recording, but a file of this directory"

    def test_foxglove_is_not_given_what_is_not_finished(self, lab: Path, tmp_path: Path) -> None:
        whole = (lab / "ppo0.mcap").read_bytes()
        (tmp_path / "broken.mcap").write_bytes(whole[: len(whole) * 2 // 3])
        with pytest.warns(UserWarning, match="was not finished"), browsing(tmp_path) as address:
            with httpx.Client(base_url=address, timeout=60) as client:
                first = told(client, "/episodes")["episodes"][0]["id"]
                text = client.get(f"/episode/{first}").text
                assert "as it is not finished. Download the episode" in text
                assert "app.foxglove.dev" not in text
                got = client.get("/download", params={"episode": first})
        (tmp_path / "one.mcap").write_bytes(got.content)
        assert tupli_mcap.Recording(tmp_path / "one.mcap").complete


class TestDocumentation:
    def test_it_lists_the_fields_of_every_page(self, web: httpx.Client) -> None:
        text = (Path(__file__).parents[2] / "docs" / "reference" / "page.md").read_text()
        sections = dict(re.findall(r"## `(/[^`]*)`\n(.*?)(?=\n## |\Z)", text, re.DOTALL))
        uri = told(web, "/episodes")["episodes"][0]["id"]
        dataset = set(told(web, "/")["datasets"][0])
        pages: dict[str, set[str]] = {
            "/": {*told(web, "/"), *dataset},
            "/dataset/KEY": set(told(web, "/dataset/CartPole-v1")) - dataset,
            "/episodes": set(told(web, "/episodes")),
            "/episode/ID": set(told(web, f"/episode/{uri}")) - set(EpisodeHeader.model_fields),
        }
        assert set(sections) == set(pages)
        for address, fields in pages.items():
            rows = re.findall(r"^\| (.*) \|$", sections[address], re.MULTILINE)
            named = set(re.findall(r"`([a-z_]+)(?:\[\])?`", " ".join(rows)))
            assert fields <= named, address


class TestOneFile:
    def test_it_is_shown_alone(self, lab: Path) -> None:
        with browsing(lab / "ppo1.mcap") as address, httpx.Client(base_url=address) as client:
            assert told(client, "/")["datasets"][0]["recordings"] == 1
            assert told(client, "/episodes")["count"] == 12
            assert "ppo1.mcap" in client.get("/").text

    def test_what_is_being_recorded(self, tmp_path: Path) -> None:
        path = tmp_path / "live.mcap"
        box = gym.spaces.Box(-1, 1, (1,), np.float32)
        zero = np.zeros(1, np.float32)
        with tupli_mcap.EpisodeWriter(path, box, box) as writer, browsing(tmp_path) as below:
            with (
                browsing(path) as alone,
                httpx.Client(base_url=below) as a,
                httpx.Client(base_url=alone) as b,
            ):
                for ended in range(3):
                    for client in (a, b):
                        datasets = told(client, "/")["datasets"]
                        assert [d["episodes"] for d in datasets] == ([ended] if ended else [])
                        empty = "appears when its first episode has ended" in client.get("/").text
                        assert empty == (not ended)
                    writer.begin()
                    writer.step(zero, zero, reward=1.0)
                    assert len(told(a, "/")["datasets"]) == bool(ended)
                    writer.step(zero, zero, reward=1.0, terminal=True)
                    writer.end(zero)
                assert '<span class="live">recording</span>' in a.get("/").text
                writer.begin()
                writer.step(zero, zero, reward=1.0)
        assert not (tmp_path / "catalog.sqlite").exists()

    def test_looking_writes_nothing(self, lab: Path) -> None:
        assert sorted(path.name for path in lab.iterdir()) == ["ppo0.mcap", "ppo1.mcap", "robot.mcap"]

    def test_the_filter_in_the_empty_box_works_everywhere(self, tmp_path: Path) -> None:
        record_rollouts("CartPole-v1", tmp_path / "no-success.mcap", episodes=2)
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            (shown,) = re.findall('placeholder="(return[^"]*)"', client.get("/episodes").text)
            assert told(client, "/episodes", filter=html.unescape(shown))["count"] == 0

    def test_a_damaged_file_is_said(self, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=1)
        (tmp_path / "bad.mcap").write_bytes(b"no recording <b>at all</b>")
        with browsing(tmp_path) as address, pytest.warns(UserWarning, match="skipped a recording"):
            with httpx.Client(base_url=address) as client:
                text = client.get("/").text
                assert '<details class="notice">\n<summary>1 file cannot be shown</summary>' in text
                assert "bad.mcap" in told(client, "/")["skipped"]
                (tmp_path / "ppo0.mcap").unlink()
                assert '<details class="notice" open>' in client.get("/").text  # of what is there instead
                (tmp_path / "bad.mcap").unlink()
                assert told(client, "/")["skipped"] == {}

    @pytest.mark.parametrize("known", [1, 3])
    def test_of_how_many_episodes_the_success_is_known(self, known: int, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=3)
        path = tmp_path / "ppo0.mcap"
        for episode in tupli_mcap.open(path)[:known]:
            episode.annotate(success=True)
        with browsing(path) as address, httpx.Client(base_url=address) as client:
            key = told(client, "/")["datasets"][0]["key"]
            whole, said = (
                client.get(f"/dataset/{key}").text,
                "1 in every episode" if known == 3 else "1 in 1 episode",
            )
            assert f"<b>Success</b> {said}<" in whole
            assert ("100% of 1" in whole, "100% of 1" in client.get("/").text) == (known == 1,) * 2

    @pytest.mark.parametrize("topic", ["/step", "/info", "/episode_start"])
    def test_an_episode_is_shown_as_far_as_it_can_be_read(self, topic: str, tmp_path: Path) -> None:
        path = tmp_path / "run.mcap"
        env = gym.make("CartPole-v1")
        with tupli_mcap.RecordEpisodes(env, path, step_callback=lambda step: {"speed": 3.0}) as recorder:
            recorder.reset(seed=5, options={"low": -0.01})
            recorder.step(0)
        damage(path, topic)
        with browsing(path) as address, httpx.Client(base_url=address) as client:
            (uri,) = (one["id"] for one in told(client, "/episodes")["episodes"])
            text, facts = client.get(f"/episode/{uri}").text, told(client, f"/episode/{uri}")
            assert told(client, f"/episode/{uri}/step/0") == {
                key: value for key, value in facts["step"].items() if key != "number"
            }
            assert ("Its steps cannot be read: the recording is damaged" in text) == (topic == "/step")
            assert ("Its infos cannot be read: the recording is damaged" in text) == (topic == "/info")
            assert ("Pole Angle" in text, "state" in facts["step"]) == (topic != "/step",) * 2
            assert facts["step"]["info"] == ({} if topic == "/info" else {"info.speed": "3"})
            assert facts["reset"]["seed"] == 5
            assert facts["reset"]["options"] == (None if topic == "/episode_start" else {"low": -0.01})
            key = told(client, "/")["datasets"][0]["key"]
            assert ("Its steps cannot be read" in client.get(f"/dataset/{key}").text) == (topic == "/step")

    def test_a_damaged_episode_among_others(self, tmp_path: Path) -> None:
        for steps, name in enumerate(("a", "b"), start=2):
            with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), tmp_path / f"{name}.mcap") as recorder:
                recorder.reset(seed=5)
                for _ in range(steps):
                    recorder.step(0)
        damage(tmp_path / "b.mcap", "/step")
        with browsing(tmp_path) as address, httpx.Client(base_url=address) as client:
            a, b = (one["id"] for one in told(client, "/episodes", sort="steps")["episodes"])
            text = client.get("/compare", params={"episode": [a, b]}).text
            assert text.count("Its steps cannot be read: the recording is damaged") == 1
            assert "Pole Angle" in text and "return so far" in text
            key = told(client, "/")["datasets"][0]["key"]
            assert "<path" in client.get(f"/cover/{key}").text  # of the episode that can be read


class TestNothingActs:
    @pytest.fixture(scope="class")
    def evil(self, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
        root = tmp_path_factory.mktemp("evil")
        robot(root / "<b>evil<b>.mcap", text=EVIL)
        carts(root, seeds=1, episodes=1)
        with browsing(root) as address, httpx.Client(base_url=address) as client:
            yield client

    def test_texts_of_files_are_texts(self, evil: httpx.Client) -> None:
        seen = 0
        for address in addresses(evil):
            answer = evil.get(address)
            assert answer.headers["content-type"].startswith("text/html"), address
            assert not ACTING.search(answer.text), address
            seen += EVIL in html.unescape(answer.text)
        assert seen >= 4

    def test_headers_of_every_page(self, evil: httpx.Client) -> None:
        for address in addresses(evil):
            headers = evil.get(address).headers
            policy = headers["content-security-policy"]
            assert "default-src 'self'" in policy and "unsafe" not in policy
            assert "frame-ancestors 'none'" in policy
            assert headers["x-content-type-options"] == "nosniff"

    def test_addresses_of_other_hosts_are_refused(self, evil: httpx.Client) -> None:
        for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example"):
            assert evil.get("/", headers={"Host": host}).status_code == 400
        assert evil.get("/", headers={"Host": "localhost:1234"}).status_code == 200

    def test_nothing_can_be_changed(self, evil: httpx.Client) -> None:
        for method in ("POST", "PUT", "DELETE", "PATCH"):
            assert evil.request(method, "/episodes").status_code == 405


def test_sizes_are_rounded_as_commands_round_them(tmp_path: Path) -> None:
    notes = {"notes": ("application/octet-stream", bytes(999_960))}
    with tupli_mcap.RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "r.mcap", attachments=notes) as env:
        env.reset()
        env.step(0)
    command = CliRunner().invoke(app, ["info", str(tmp_path / "r.mcap")])
    with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
        (dataset,) = told(client, "/")["datasets"]
        page = client.get(f"/dataset/{dataset['key']}").text
    assert "1.0 MB" in command.output
    assert "<td>1.0 MB" in page and "1000 kB" not in page


def test_a_file_that_is_gone_has_a_page_that_says_so(tmp_path: Path) -> None:
    carts(tmp_path, seeds=1, episodes=2)
    (path,) = tmp_path.rglob("*.mcap")
    with browsing(path) as address, httpx.Client(base_url=address, timeout=120) as client:
        uri = told(client, "/episodes")["episodes"][0]["id"]
        path.unlink()
        for page in ("/", f"/episode/{uri}"):
            answer = client.get(page, params={"format": "json"})
            assert answer.status_code == 500
            assert f"{path.name} does not exist" in answer.json()["error"]


def test_an_episode_that_was_compacted_meanwhile_is_not_another_one(tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    carts(tmp_path, seeds=1, episodes=3)
    storage, shelf = FileStorage(tmp_path), DirectoryShelf(tmp_path)
    first, _, last = storage.list_episodes()
    for header in (first, last):
        storage.delete_episode(header.id)
    storage.compact()
    for header in (first, last):
        with pytest.raises(NotFoundError, match=f"episode {header.id} is gone"):
            copies.replay_file(shelf, [header])


@pytest.mark.parametrize(
    ("returns", "mean"),
    [
        ((1.7e308, -1.7e308, 0.0), "–"),
        ((math.inf, -math.inf, 2.0), "–"),
        ((math.inf, 1.0, 2.0), "∞"),
        ((5e-324, 0.0, 0.0), "0"),
        ((9999.6, 9999.6, 9999.7), "10,000"),
    ],
)
def test_returns_of_all_sizes(tmp_path: Path, returns: tuple[float, ...], mean: str) -> None:
    episodes = [tupli_mcap.EpisodeData([0], [0], [value], [True], [False]) for value in returns]
    space = gym.spaces.Discrete(2)
    tupli_mcap.write_recording(tmp_path / "r.mcap", episodes, observation_space=space, action_space=space)
    with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
        (dataset,) = told(client, "/")["datasets"]
        page = client.get(f"/dataset/{dataset['key']}")
        table = client.get("/episodes")
    assert page.status_code == 200
    assert f"<dt>Mean return</dt><dd>{mean}</dd>" in page.text
    assert "nan%" not in table.text


def test_the_ends_of_a_histogram_are_those_of_its_bars(tmp_path: Path) -> None:
    """Returns from 0 to 9 in bars, and two far from them."""
    returns = [*(float(i % 10) for i in range(2000)), -1e6, 1e6]
    episodes = [tupli_mcap.EpisodeData([0], [0], [value], [True], [False]) for value in returns]
    space = gym.spaces.Discrete(2)
    tupli_mcap.write_recording(tmp_path / "r.mcap", episodes, observation_space=space, action_space=space)
    with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=120) as client:
        (dataset,) = told(client, "/")["datasets"]
        page = client.get(f"/dataset/{dataset['key']}").text
    (ends,) = re.findall(r"Distribution of return,.*?<p class=.ends.>(.*?)</p>", page, re.DOTALL)
    assert ends == "<span>0; 1 below</span><span>9; 1 above</span>"


@pytest.mark.filterwarnings("ignore:.*")  # of copies, and of files without their journals
def test_every_kind_of_recording(tmp_path: Path) -> None:
    """The golden files hold every space, dtype, image and info that there is."""
    golden = Path(__file__).parents[1] / "golden"
    for file in golden.glob("*.mcap"):
        shutil.copy(file, tmp_path)
    with browsing(tmp_path) as address, httpx.Client(base_url=address, timeout=60) as client:
        datasets = told(client, "/")["datasets"]
        assert len(datasets) >= 4
        for dataset in datasets:
            assert client.get(f"/dataset/{dataset['key']}").status_code == 200
            client.get(f"/cover/{dataset['key']}").raise_for_status()
        seen: dict[str, list[str]] = {}
        for episode in told(client, "/episodes")["episodes"]:
            seen.setdefault(episode["recording"], []).append(episode["id"])
        assert len(seen) > 15
        for name, (uri, *_) in seen.items():
            facts = told(client, f"/episode/{uri}", step=2)
            assert client.get(f"/episode/{uri}").status_code == 200, name
            for camera, _ in enumerate(facts["cameras"]):
                assert client.get(f"/episode/{uri}/picture/{camera}/0").status_code == 200, name
        client.get("/sparks", params={"episode": [uris[0] for uris in seen.values()]}).raise_for_status()


class TestCommand:
    @pytest.mark.parametrize(
        ("argument", "said"),
        [
            ("nope", "nope does not exist; give a recording"),
            ("bad.mcap", "expected an MCAP file"),
            ("https://lab.example/x.mcap", "expected a path, found https://lab.example/x.mcap"),
        ],
    )
    def test_what_it_cannot_show(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, argument: str, said: str
    ) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "bad.mcap").write_bytes(b"no recording")
        done = CliRunner().invoke(app, ["browse", argument, "--no-open"])
        assert done.exit_code in (1, 2)
        assert said in done.stderr

    def test_it_shows_the_directory_it_is_in_until_it_is_interrupted(self, tmp_path: Path) -> None:
        carts(tmp_path, seeds=1, episodes=1)
        process = subprocess.Popen(
            [*COMMAND, "--no-open"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        line = process.stdout.readline()
        address = re.search(r"http://127\.0\.0\.1:\d+", line)
        assert address and f"{address[0]}/dataset/CartPole-v1 (Ctrl-C" in line  # there is one dataset
        assert told_at(address[0])["datasets"][0]["key"] == "CartPole-v1"
        port = address[0].rpartition(":")[2]
        second = [*COMMAND, "--no-open", "--port", port]
        other = subprocess.run(second, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
        assert (other.returncode, f"port {port} cannot be used" in other.stderr) == (1, True)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
        assert (process.returncode, errors) == (0, "")


COMMAND = [sys.executable, "-c", "from tupli_mcap.cli import main; main()", "browse"]


def told_at(address: str) -> Any:
    with httpx.Client(base_url=address, timeout=60) as client:
        return told(client, "/")


def test_the_line_of_a_mean_has_no_gaps(tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", episodes=45, seed=0)
    with browsing(tmp_path) as url:
        answer = httpx.get(f"{url}/dataset/CartPole-v1")
    assert answer.status_code == 200
    chart = answer.text.partition("Return of episodes over time")[2].partition("</svg>")[0]
    (line,) = re.findall(r'<path class="line[^"]*" d="([^"]+)"', chart)
    assert line.count("M") == 1
