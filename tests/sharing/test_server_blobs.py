"""What a server keeps comes and goes whole, in a directory as in a bucket."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import functools
import hashlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import buckets
import gymnasium as gym
import httpx
import numpy as np
import pytest
from fastapi import Request, Response
from serving import PASSWORD, serving
from test_server import token_of

from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.schema import ArtifactMetadata, F
from tupli_mcap.server.blobs import LostError, blobs_of
from tupli_mcap.server.library import Library
from tupli_mcap.server.routes.bodies import body_of
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.stored.items import artifact_key
from tupli_mcap.storage import TupliAPIClient

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3


class RunningServer(NamedTuple):
    """A server, its admin, and how to list what is kept."""

    url: str
    admin: TupliAPIClient
    bucket: buckets.Bucket | None
    directory: Path
    settings: Settings

    def names(self) -> list[str]:
        if self.bucket:
            return [key.partition("/")[2] for key in self.bucket.names()]
        found = [*(self.directory / "artifacts").rglob("*"), *(self.directory / "recordings").rglob("*")]
        return [path.relative_to(self.directory).as_posix() for path in found if path.is_file()]


@contextlib.contextmanager
def place_of(kind: str, directory: Path, **changes: Any) -> Iterator[RunningServer]:
    settings = replace(Settings(directory), **changes)
    with contextlib.ExitStack() as stack:
        bucket = None if kind == "directory" else stack.enter_context(buckets.bucket())
        settings = replace(settings, blobs=f"{bucket.url}/below" if bucket else "")
        url = stack.enter_context(serving(settings))
        admin = stack.enter_context(TupliAPIClient(url))
        admin.login("admin", PASSWORD)
        yield RunningServer(url, admin, bucket, directory, settings)


@pytest.fixture(params=["directory", "bucket", "presigned"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RunningServer]:
    with place_of(request.param, tmp_path / request.param, presigned=request.param == "presigned") as place:
        yield place


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 20 MB, which goes to a bucket in several parts."""
    path = tmp_path_factory.mktemp("large") / "run.mcap"
    noise = np.random.default_rng(0)
    space = gym.spaces.Box(0, 255, (300_000,), np.uint8)

    class Noise(gym.Env[Any, Any]):
        observation_space, action_space = space, gym.spaces.Discrete(2)

        def reset(self, **_: Any) -> Any:
            return noise.integers(0, 256, space.shape, np.uint8), {}

        def step(self, _: Any) -> Any:
            return self.reset()[0], 0.0, False, False, {}

    with RecordEpisodes(Noise(), path) as env:
        env.reset()
        for _ in range(70):
            env.step(0)
    assert path.stat().st_size > 20_000_000
    return path


def test_a_disk_that_refuses_is_one_error(tmp_path: Path) -> None:
    blobs = blobs_of(Settings(tmp_path))
    blobs.write("artifacts/x", b"1")
    assert (blobs.size("artifacts/x"), blobs.size("artifacts/y")) == (1, None)
    with pytest.raises(StorageError, match=r"cannot read '.*/artifacts/x/y': Not a directory"):
        blobs.size("artifacts/x/y")


def test_a_recording_comes_back_bit_for_bit_in_any_part(place: RunningServer, large: Path) -> None:
    name, data = place.admin.push(large), large.read_bytes()
    told = place.admin._session.ask("POST", "/v1/tickets", {"recording": name})
    url, size = place.url + told["path"], len(data)
    get = functools.partial(httpx.get, follow_redirects=True)
    whole = get(url)
    assert hashlib.sha256(whole.content).hexdigest() == told["digest"] == hashlib.sha256(data).hexdigest()
    tag = whole.headers["ETag"]
    for text, start, stop in (
        ("bytes=0-0", 0, 1), ("bytes=-7", size - 7, size), (f"bytes=-{size + 9}", 0, size),
        ("bytes=8388600-8388699", 8388600, 8388700), (f"bytes={size - 3}-{size + 9}", size - 3, size),
        ("bytes=12-", 12, size),
    ):  # fmt: skip
        part = get(url, headers={"Range": text, "If-Match": tag})
        assert (part.status_code, part.content == data[start:stop]) == (206, True), text
        assert part.headers["Content-Range"] == f"bytes {start}-{stop - 1}/{size}"
    assert get(url, headers={"Range": f"bytes={size}-"}).status_code == 416
    assert get(url, headers={"If-Match": '"another"'}).status_code == 412
    with place.admin.open_recording(name) as sent, Recording(large) as original:
        assert np.array_equal(sent.read().states, original.read().states)
        with place.admin.downloaded(name, len(original)) as fetched:
            assert fetched is not None
            assert fetched.read_bytes() == data
    if not place.bucket:
        head = httpx.head(url)
        assert (head.status_code, head.headers["Content-Length"], head.headers["ETag"]) == (
            200,
            str(size),
            tag,
        )


def test_an_address_in_a_bucket_is_valid_only_for_a_request_that_follows(tmp_path: Path) -> None:
    """Whoever has it reads the file with it, also after nobody may any more."""
    with place_of("presigned", tmp_path, presigned=True) as place:
        item = place.admin.store_artifact(b"gusts", ArtifactMetadata(name="wind"))
        answer = httpx.get(f"{place.url}/v1/artifacts/{item.id}", headers=token_of(place.admin))
        address = answer.headers["Location"]
        assert httpx.get(address).content == b"gusts"
        (seconds,) = parse_qs(urlsplit(address).query)["X-Amz-Expires"]
        assert int(seconds) <= 15 * 60


own_bytes = pytest.mark.parametrize("place", ["directory", "bucket"], indirect=True)
"""Where the server sends them itself."""


@own_bytes
@pytest.mark.parametrize("asked", ["items=0-1", "bytes=3-1", "bytes=0-1,3-4", "bytes=a-b", "bytes=-", ""])
def test_what_is_no_single_range_counts_as_none(place: RunningServer, asked: str) -> None:
    item = place.admin.store_artifact(b"gusts", ArtifactMetadata(name="wind"))
    token = token_of(place.admin)
    answer = httpx.get(f"{place.url}/v1/artifacts/{item.id}", headers={"Range": asked, **token})
    assert (answer.status_code, answer.content) == (200, b"gusts")


@own_bytes
def test_a_range_beyond_the_end_is_refused_as_every_request_is(place: RunningServer) -> None:
    item = place.admin.store_artifact(b"gusts", ArtifactMetadata(name="wind"))
    headers = {"Range": "bytes=5-", **token_of(place.admin)}
    answer = httpx.get(f"{place.url}/v1/artifacts/{item.id}", headers=headers)
    assert (answer.status_code, answer.headers["Content-Range"]) == (416, "bytes */5")
    assert answer.json() == {"detail": "expected a range of 5 bytes", "error": "StorageError"}


@own_bytes
@pytest.mark.parametrize("form", ["{}", "W/{}", '"another", {}', "*"])
def test_a_version_that_the_caller_has_is_not_sent(place: RunningServer, form: str) -> None:
    item = place.admin.store_artifact(b"gusts", ArtifactMetadata(name="wind"))
    headers = {"If-None-Match": form.format(f'"{item.id}"'), **token_of(place.admin)}
    answer = httpx.get(f"{place.url}/v1/artifacts/{item.id}", headers=headers)
    assert (answer.status_code, answer.content) == (304, b"")


def test_nothing_is_left_of_what_is_deleted(place: RunningServer, large: Path) -> None:
    item = place.admin.store_artifact(b"wind", ArtifactMetadata(name="wind"))
    name = place.admin.push(large)
    assert sorted(place.names()) == [f"artifacts/{item.id}", name]
    assert place.admin.load_artifact(item.id) == b"wind"
    place.admin.delete_artifact(item.id)
    place.admin.delete_episodes(F("steps") > 0)
    assert place.names() == []
    with pytest.raises(
        LostError, match=f"the server has lost {name}"
    ):  # a backup that had listed it begins again
        blobs_of(place.settings).pieces(name, 0, 1)
    assert list((place.directory / "server" / "uploads").iterdir()) == []


async def body(answer: Response) -> bytes:
    transport = httpx.ASGITransport(answer)
    async with httpx.AsyncClient(transport=transport, base_url="http://here") as asking:
        return (await asking.get("/")).content


@pytest.mark.parametrize("kind", ["directory", "bucket"])
def test_what_is_deleted_at_the_moment_it_is_fetched(kind: str, tmp_path: Path) -> None:
    """Before its first byte it does not exist, which is no loss; after that a directory sends all of it."""
    with place_of(kind, tmp_path / kind) as place:
        library, asked = Library(place.settings), Request({"type": "http", "method": "GET", "headers": []})
        uri = place.admin.store_artifact(b"wind", ArtifactMetadata(name="wind")).id
        fetch = functools.partial(body_of, library, asked, artifact_key(uri), digest=uri)
        begun = fetch()
        place.admin.delete_artifact(uri)
        assert asyncio.run(body(begun)) == b"wind"
        with pytest.raises(NotFoundError, match="deleted, or replaced, at this moment"):
            fetch()
        place.admin.store_artifact(b"wind", ArtifactMetadata(name="wind"))
        library.blobs.delete(artifact_key(uri))
        with pytest.raises(LostError, match="a backup may have it"):
            fetch()
        library.close()


def test_a_bucket_that_is_away_loses_nothing(tmp_path: Path, large: Path) -> None:
    with place_of("bucket", tmp_path / "away") as place:
        kept = place.admin.store_artifact(b"wind", ArtifactMetadata(name="wind"))
        token = {"Authorization": f"Bearer {place.admin._session._token()}"}
        assert place.bucket is not None
        place.bucket.stop()
        digest = base64.b64encode(hashlib.sha256(large.read_bytes()).hexdigest().encode()).decode()
        size = str(large.stat().st_size)
        begun = httpx.post(
            f"{place.url}/v1/uploads",
            headers={"Upload-Length": size, "Upload-Metadata": f"sha256 {digest}", **token},
        )
        upload = place.url + begun.headers["Location"]
        data = large.read_bytes()
        sent = httpx.patch(upload, headers={"Upload-Offset": "0", **token}, content=data, timeout=120)
        assert (sent.status_code, sent.json()["error"]) == (503, "StorageError")
        assert "127.0.0.1" not in sent.text
        assert httpx.get(f"{place.url}/v1/artifacts/{kept.id}", headers=token, timeout=120).status_code == 503
        with pytest.raises(StorageError, match="the server cannot reach"):
            place.admin.store_artifact(b"rain", ArtifactMetadata(name="rain"))
        place.admin.delete_artifact(kept.id)  # whose bytes are deleted later
        assert place.admin.list_artifacts() == place.admin.list_episodes() == []

        place.bucket.start()
        sent = httpx.patch(upload, headers={"Upload-Offset": size, **token}, content=b"", timeout=120)
        assert sent.status_code == 204, sent.text
        assert place.admin.count_episodes() == 1
        assert sorted(place.names()) == [f"artifacts/{kept.id}", sent.headers["Recording"]]
        library = Library(replace(place.settings, pending_seconds=0))  # as it is started again
        library.close()
        assert place.names() == [sent.headers["Recording"]]
