"""What viewers open on a server: an episode for Rerun, a query for Foxglove."""

from __future__ import annotations

import datetime
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urljoin

import httpx
import numpy as np
import pytest
from rrd import Rrd
from stored_items import episode
from test_server import Things, Users, things, token_of, users
from test_server_query import filtered, short_episodes
from viewed import Courier, rollout

from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.errors import NotFoundError
from tupli_mcap.schema import F

DECODERS = Path(__file__).parents[1] / "foxglove"
__all__ = ["things", "users"]  # fixtures


def test_an_episode_for_rerun(
    users: Users, things: Things, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    header = things.episodes[1]
    url = f"{users.url}/v1/episodes/{header.id}.rrd"
    answer = httpx.get(url, headers=token_of(users.ann))
    (tmp_path / "e.rrd").write_bytes(answer.content)
    shown = Rrd(tmp_path / "e.rrd")
    assert (len(shown.recordings), len(shown.blueprints)) == (1, 1)
    with users.ann.open_recording(header.recording) as recording:
        assert shown.recordings[0].recording_id.startswith(recording.uuid)
        assert np.array_equal(shown.scalars("/reward").ravel(), recording.episodes[1].rewards)
    ticket = users.ann._session.ask("POST", "/v1/tickets", {"recording": header.recording})["path"].partition(
        "="
    )[2]
    assert httpx.get(url, params={"ticket": ticket}).content[:4] == answer.content[:4]
    other = users.ann.record_episodes([episode(things.benchmark, 7)])[0]
    refused = httpx.get(f"{users.url}/v1/episodes/{other.id}.rrd", params={"ticket": ticket})
    assert (refused.status_code, refused.json()["detail"]) == (
        401,
        "the ticket is for another recording; open it again",
    )
    monkeypatch.setitem(sys.modules, "rerun", None)
    missing = httpx.get(url, headers=token_of(users.ann))
    assert (missing.status_code, missing.json()["error"]) == (501, "MissingExtraError")
    assert "looking at recordings needs rerun-sdk: pip install" in missing.json()["detail"]


@pytest.fixture
def recorded(users: Users, tmp_path: Path) -> tuple[str, Recording]:
    """A recording of ann's with pictures, frames and text: its name, and the file."""
    path = tmp_path / "courier.mcap"
    with RecordEpisodes(Courier(), path) as env:
        rollout(env, lambda state: env.action_space.sample(), 4)
    return users.ann.push(path), Recording(path)


def decoded(source: dict[str, Any], stream: bytes, tmp_path: Path) -> dict[str, list[Any]]:
    """How many messages of each topic Foxglove's packages decode of a source, and the times of first and last."""
    node = shutil.which("node")
    if node is None or not (DECODERS / "node_modules").is_dir():
        pytest.skip("Foxglove's decoders are not installed: node or tests/foxglove/node_modules is missing")
    (tmp_path / "source.json").write_text(json.dumps(source))
    command = [node, str(DECODERS / "stream.mjs"), str(tmp_path / "source.json")]
    done = subprocess.run(command, input=stream, capture_output=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return {topic: rest for topic, *rest in map(json.loads, done.stdout.splitlines())}


def time_ns(text: str) -> int:
    moment = datetime.datetime.fromisoformat(text)
    return round(moment.replace(microsecond=0).timestamp()) * 10**9 + moment.microsecond * 1000


def test_foxglove_loads_what_a_query_means(
    users: Users, recorded: tuple[str, Recording], tmp_path: Path
) -> None:
    name, recording = recorded
    wanted = {"filter": "episode >= 1 and episode < 3", "recording": name}
    manifest = httpx.get(f"{users.url}/v1/manifest", params=wanted, headers=token_of(users.ann)).json()
    (source,) = manifest["sources"]
    assert manifest["name"] == name.rpartition("/")[2] and source["url"].startswith("data?")
    address = urljoin(f"{users.url}/v1/manifest", source["url"])
    assert httpx.get(address).status_code == 401
    stream = httpx.get(address, headers=token_of(users.ann))
    found = decoded(source, stream.content, tmp_path)
    steps = int(recording.index["length"][1:3].sum())
    assert set(found) == {topic["name"] for topic in source["topics"]}
    assert (found["/step"][0], found["/episode_start"][0], found["/episode_end"][0]) == (steps, 2, 2)
    images = [topic for topic in found if topic.startswith("/image/")]
    assert images and all(found[topic][0] == steps for topic in images)
    begin, end = time_ns(source["startTime"]), time_ns(source["endTime"])
    assert all(begin <= int(first) <= int(last) <= end for _, first, last in found.values())
    users.ann.delete_episode(f"{recording.uuid}-2")
    gone = httpx.get(address, headers=token_of(users.ann))
    assert (gone.status_code, gone.json()["detail"]) == (
        409,
        "these are other episodes by now; open them again",
    )
    again = httpx.get(f"{users.url}/v1/manifest", params=wanted, headers=token_of(users.ann)).json()
    assert again["sources"][0]["id"] != source["id"]


def test_foxglove_loads_by_a_ticket(users: Users, recorded: tuple[str, Recording], tmp_path: Path) -> None:
    """A whole recording is a file that can be read in ranges; a ticket shows what its query means, and no more."""
    name, _ = recorded
    few = short_episodes(tmp_path / "few.mcap", 5, 0)
    other = users.ann.push(few)
    told = users.ann._session.ask("POST", "/v1/query/tickets", {"filter": filtered(F("episode") < 4)})
    address = users.url + told["path"]
    sources = {("data?" in s["url"]): s for s in httpx.get(address).json()["sources"]}
    file = urljoin(address, sources[False]["url"])
    assert sources[False]["supportsRangeRequests"] is True and name in file
    part = httpx.get(file, headers={"Range": "bytes=0-7", "Origin": "https://app.foxglove.dev"})
    assert (part.status_code, part.headers["Access-Control-Allow-Origin"]) == (206, "*")
    made = urljoin(address, sources[True]["url"])
    assert other in unquote(made)
    assert decoded(sources[True], httpx.get(made).content, tmp_path)["/episode_start"][0] == 4
    for wrong in (file.replace(name, other), made.replace("/v1/data", f"/v1/files/{other}")):
        assert httpx.get(wrong).status_code == 401
    assert httpx.get(f"{address}&recording=another").status_code == 404
    users.ann.delete_episodes(F("recording") == name)
    assert len(httpx.get(address).json()["sources"]) == 1
    refused = users.bob._session
    with pytest.raises(NotFoundError, match="no such episode"):
        refused.ask("POST", "/v1/query/tickets", {"filter": filtered(F("episode") < 4)})
