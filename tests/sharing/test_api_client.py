"""A storage on a server keeps the contract of every storage."""

from __future__ import annotations

import contextlib
import gzip
import http.server
import json
import pickle
import re
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import buckets
import gymnasium as gym
import numpy as np
import pytest
import zstandard
from postgres import Cluster
from serving import PASSWORD, serving
from storage_contract import StorageContract
from typer.testing import CliRunner

from tupli_mcap import RecordEpisodes
from tupli_mcap.cli.app import app
from tupli_mcap.doctor import examine
from tupli_mcap.errors import FormatError, RecordingError, StorageError, TupliError
from tupli_mcap.schema import Group
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.api import TupliAPIClient, session
from tupli_mcap.storage.api.answers import UnreachableError
from tupli_mcap.storage.api.session import Session
from tupli_mcap.wrappers.rollout import record_rollouts

pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")  # of moto and boto3


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    with buckets.bucket() as made:
        yield made.url


@pytest.fixture(params=["sqlite and a directory", "postgresql and s3"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    settings = Settings(tmp_path / "served")
    with contextlib.ExitStack() as stack:
        if "postgresql" in request.param:
            postgres: Cluster = request.getfixturevalue("postgres")
            database = stack.enter_context(postgres.database())
            place = f"{request.getfixturevalue('bucket')}/{tmp_path.name}"
            settings = replace(settings, database=database, blobs=place)
        yield stack.enter_context(serving(settings))


@pytest.fixture
def admin(url: str) -> Iterator[TupliAPIClient]:
    with TupliAPIClient(url) as client:
        client.login("admin", PASSWORD)
        yield client


@pytest.mark.sampled(1)  # each on one of the two servers
class TestContract(StorageContract):
    @pytest.fixture
    def storage(self, admin: TupliAPIClient) -> TupliAPIClient:
        admin.create_group(Group(name="lab"))
        return admin


class _Odd(http.server.BaseHTTPRequestHandler):
    """Answers everything with `answer`: a status and a body."""

    protocol_version = "HTTP/1.1"
    answer = (200, b"")
    encoding = ""
    lacking = 0  # bytes of the body that never come
    asked: ClassVar[list[str]] = []

    def log_message(self, *_: Any) -> None:
        pass

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.asked.append(f"{self.command} {self.path}")
        status, body = self.answer
        self.send_response(status)
        self.send_header("Content-Length", str(len(body) + self.lacking))
        self.close_connection = bool(self.lacking)
        self.send_header("Upload-Offset", "!42")
        if self.encoding:
            self.send_header("Content-Encoding", self.encoding)
        self.end_headers()
        self.wfile.write(body)

    do_GET = do_DELETE = do_POST  # noqa: N815


@pytest.fixture(scope="module")
def odd() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Odd) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ((200, b"<html>"), "expected JSON"),
        ((200, b"null"), "expected"),
        ((200, b'{"items": [{"id": 5}], "access_token": 5, "next": 6}'), "expected"),
        ((404, b"<html>"), "404 to POST /v1/"),
        ((501, b"<html>"), "501 to POST /v1/"),
        ((404, b'{"detail": "there is no route /x", "error": "NotFoundError"}'), "404 to POST /v1/"),
        ((404, b'{"detail": "Not Found", "error": "NotFoundError"}'), "404 to POST /v1/"),
        ((405, b'{"detail": "Method Not Allowed"}'), "405 to POST /v1/"),
        (
            (400, b'{"detail": "expected another request: sort: there is no such field"}'),
            "sort: there is no such f",
        ),
    ],
)
def test_what_is_no_server_of_this_version_is_one_error(
    odd: str, answer: tuple[int, bytes], said: str, tmp_path: Path
) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=5)
    _Odd.answer = answer
    with TupliAPIClient(odd) as client:
        for ask in (lambda: client.login("ann", "password"), client.list_benchmarks, client.list_episodes):
            with pytest.raises(TupliError, match=f"{said}.*is it a tupli-mcap server") as err:
                ask()
            assert "it answers" not in str(err.value)  # as if it had been named
        with pytest.raises(TupliError, match="is it a tupli-mcap server"):
            client.push(tmp_path / "run.mcap")


def test_who_one_is_at_a_server_that_tells_no_bytes(odd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TUPLI_MCAP_TOKEN", "token")
    _Odd.answer = (200, b'{"username": "ann", "memberships": []}')
    done = CliRunner().invoke(app, ["whoami", "--url", odd])
    assert (done.exit_code, done.stdout.split()) == (0, ["server", odd, "user", "ann"])


def test_a_file_at_which_the_server_fails_does_not_stop_the_others(
    odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_TOKEN", "token")
    _Odd.answer = (500, b'{"detail": "the server has failed", "error": "StorageError"}')
    paths = [record_rollouts("CartPole-v1", tmp_path / f"{name}.mcap", steps=5).path for name in "ab"]
    refused = CliRunner().invoke(app, ["push", *map(str, paths), "--url", odd])
    said = "".join(f"error: {path}: the server has failed (says {odd})\n" for path in paths)
    assert (refused.exit_code, refused.stderr) == (1, said)


@pytest.mark.parametrize("status", [200, 403])
def test_an_answer_that_unpacks_without_an_end_is_one_error(
    odd: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "_MOST_BYTES", 1 << 20)
    monkeypatch.setattr(_Odd, "answer", (status, gzip.compress(bytes(100 << 20))))
    monkeypatch.setattr(_Odd, "encoding", "gzip")
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=5)
    with TupliAPIClient(odd) as client:
        for ask in (lambda: client.login("ann", "password"), client.list_episodes):
            with pytest.raises(StorageError, match="at most 1048576 bytes .*, found more"):
                ask()
        with pytest.raises(StorageError, match="at most 1048576 bytes .*, found more"):
            client.push(tmp_path / "run.mcap")


@pytest.mark.parametrize("encoding", ["zstd", "br", "gzip, gzip"])
def test_no_piece_of_an_answer_unpacks_to_any_size(
    odd: str, encoding: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One piece, packed twice or by zstd, may fill the memory before anybody counts."""
    packed = {
        "zstd": zstandard.compress,
        "br": bytes,
        "gzip, gzip": lambda data: gzip.compress(gzip.compress(data)),
    }
    monkeypatch.setattr(_Odd, "answer", (200, packed[encoding](b"null")))
    monkeypatch.setattr(_Odd, "encoding", encoding)
    with TupliAPIClient(odd) as client, (tmp_path / "cut").open("wb") as file:
        for ask in (client.list_benchmarks, lambda: client._session.fetch("/v1/query", {}, file)):
            with pytest.raises(StorageError, match=f"packed by gzip or not at all, found '{encoding}'"):
                ask()


def test_a_download_whose_size_is_told_as_zero_is_one_error(
    odd: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TUPLI_MCAP_CACHE_DIR", str(tmp_path / "cache"))
    told = {"path": "/v1/files/a", "whole": True, "digest": "0" * 64, "size": 0, "episodes": 1}
    monkeypatch.setattr(_Odd, "answer", (200, json.dumps(told).encode()))
    with (
        TupliAPIClient(odd) as client,
        pytest.raises(TupliError, match="expected"),
        client.downloaded("a", 1),
    ):
        pass


def test_a_download_ends_at_the_size_that_was_told(odd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else it could fill the disk."""
    told = {"path": "/v1/files/a", "whole": True, "digest": "0" * 64, "size": 1000, "episodes": 1}
    monkeypatch.setattr(_Odd, "answer", (200, json.dumps(told).encode() + b" " * (64 << 20)))
    come = list[float]()
    with (
        TupliAPIClient(odd) as client,
        pytest.raises(FormatError, match="expected bytes with the SHA-256 0000"),
        client.downloaded("a", 1, come.append),
    ):
        pass
    assert sum(come) * 1000 < 8 << 20


def test_a_token_that_nobody_would_see_is_deleted(odd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Odd, "answer", (200, b'{"id": "t/1", "secret": "of another version"}'))
    _Odd.asked.clear()
    with TupliAPIClient(odd) as client, pytest.raises(StorageError, match="expected ApiToken"):
        client.create_token("robot")
    assert _Odd.asked == ["POST /v1/api-tokens", "DELETE /v1/api-tokens/t%2F1"]


def test_a_download_that_always_breaks_before_what_is_new_ends(
    odd: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server knows no ranges: all comes again."""
    monkeypatch.setattr(session, "_ATTEMPTS", 2)
    monkeypatch.setattr(_Odd, "answer", (200, bytes(500)))
    monkeypatch.setattr(_Odd, "lacking", 500)
    with pytest.raises(UnreachableError):
        list(Session(odd).stream("/v1/files/a", 800))


def test_an_answer_that_cannot_be_unpacked_is_one_error(odd: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Odd, "answer", (200, b"no gzip"))
    monkeypatch.setattr(_Odd, "encoding", "gzip")
    with TupliAPIClient(odd) as client, pytest.raises(StorageError, match="does not answer"):
        client.list_benchmarks()


@pytest.mark.parametrize(
    ("variable", "value", "why"),
    [
        ("http_proxy", "ftp://u:secret@127.0.0.1:9", "proxies of the environment .* Unknown scheme"),
        ("no_proxy", "[::1],127.0.0.0/8", "proxies of the environment .* Invalid port"),
        ("SSL_CERT_FILE", "/nowhere.pem", "authorities .PEM. in /nowhere.pem .SSL_CERT_FILE.: No such file"),
    ],
)
def test_an_environment_without_a_way_to_a_server(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, why: str
) -> None:
    monkeypatch.setenv(variable, value)
    done = CliRunner().invoke(app, ["whoami", "--url", "http://127.0.0.1:9"])
    assert done.exit_code == 1
    assert re.match(f"error: (the|expected certificates of) {why}", done.stderr)
    assert "secret" not in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("address", ["http://lab:x", "http://lab:99999", "http://:secret@lab", "http://[lab"])
def test_what_is_no_address_of_a_server(address: str) -> None:
    with pytest.raises(StorageError, match="expected the address of a server, such as http://") as refused:
        TupliAPIClient(address)
    assert "secret" not in str(refused.value)


def test_a_copy_of_a_client_leaves_what_it_leaves() -> None:
    for sends_left in (False, True):
        client = TupliAPIClient("http://127.0.0.1:9", sends_left=sends_left)
        copied = pickle.loads(pickle.dumps(client))
        client.set_url("http://127.0.0.1:8")
        assert (copied.url, client.url) == ("http://127.0.0.1:9", "http://127.0.0.1:8")
        assert copied._sends_left is client._sends_left is sends_left


@pytest.mark.parametrize("scheme", ["http://", ""])
@pytest.mark.parametrize(
    ("bypassed", "said"), [("", "through the proxy http://127.0.0.1:9: "), ("lab.invalid", ": ")]
)
def test_a_proxy_that_does_not_answer_is_named(
    monkeypatch: pytest.MonkeyPatch, scheme: str, bypassed: str, said: str
) -> None:
    for name, value in {"http_proxy": f"{scheme}u:secret@127.0.0.1:9", "no_proxy": bypassed}.items():
        monkeypatch.setenv(name, value)
    done = CliRunner().invoke(app, ["list-users", "--url", "http://lab.invalid:8080"])
    assert re.search(rf"http://lab\.invalid:8080 does not answer ?{said}", done.stderr), done.stderr
    assert "secret" not in done.stderr


def test_commands_read_a_server(admin: TupliAPIClient, url: str, tmp_path: Path) -> None:
    empty = CliRunner().invoke(app, ["doctor", url])
    assert empty.exit_code == 1 and "there is nothing to examine; give recordings" in empty.output
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap", name="ppo") as env:
        for seed in range(5):
            env.reset(seed=seed)
            while not env.step(0)[2]:
                pass
    admin.push(tmp_path / "run.mcap")

    def told(*words: str) -> Any:
        done = CliRunner().invoke(app, [words[0], url, *words[1:], "--json"])
        assert done.exit_code == 0, done.output
        return json.loads(done.output)["result"]

    assert examine(admin).episodes == 5

    made = str(tmp_path / "made.mcap")
    assert [episode["seed"] for episode in told("episodes", "--filter", 'run.name ~ "PPO" and seed < 2')] == [
        0,
        1,
    ]
    assert told("info", "--episodes", "0,3-4")["episodes"] == 3
    assert told("info", "--filter", "seed = 1")["episodes"] == 1
    assert told("filter", "--filter", "seed > 2", "-o", made)["episodes"] == 2
    assert told("trim", "--steps", "1:", "--episodes", "best", "-o", made, "--force")["left_out"] == 1
    assert told("doctor")["episodes"] == 5
    (listed,) = told("ls", "--filter", "seed > 1")
    assert (listed["run"], listed["episodes"], listed["size"], listed["error"]) == ("ppo", 3, None, None)
    assert listed["steps"] == sum(e["steps"] for e in told("episodes", "--filter", "seed > 1"))
    for which in ("0,3-4", "best"):
        (listed,) = told("ls", "--episodes", which)
        steps = [e["steps"] for e in told("episodes", "--episodes", which)]
        assert (listed["run"], listed["episodes"], listed["steps"]) == ("ppo", len(steps), sum(steps))
    (listed,) = told("ls", "--episodes", "first", "--filter", "seed > 1")
    assert (listed["episodes"], listed["files"]) == (1, 1)
    assert told("render", "--episodes", "0", "-o", str(tmp_path / "film.gif"))["ok"]
    for words in (["merge"], ["split", "--episodes", "1"]):
        done = CliRunner().invoke(app, [words[0], url, *words[1:], "-o", made])
        assert f"tupli-mcap filter {url} --filter FILTER -o FILE" in " ".join(done.output.split()), (
            done.output
        )
    done = CliRunner().invoke(app, ["verify", url])
    assert "is a server, not a recording → fetch its recordings with tupli-mcap pull" in " ".join(
        done.output.split()
    )
    failed = CliRunner().invoke(app, ["info", url, "--episodes", "9"])
    assert f"{url} has no episode 9; choose from 0 to 4" in failed.output


def test_a_token_that_expires_during_a_push_is_renewed(admin: TupliAPIClient, tmp_path: Path) -> None:
    with RecordEpisodes(gym.make("CartPole-v1"), tmp_path / "run.mcap") as env:
        env.reset(seed=0)
        while not env.step(0)[2]:
            pass
    tokens, expired = admin._session.tokens, []

    def tell(_: int) -> None:  # the upload has begun, and its bytes were not sent yet
        if not expired:
            expired.append(True)
            tokens.put(admin.url, "admin", {**tokens.tokens(admin.url), "access_token": "of yesterday"})

    with admin.open_recording(admin.push(tmp_path / "run.mcap", tell)) as recording:
        assert len(recording) == 1 and expired
    assert tokens.tokens(admin.url)["access_token"] != "of yesterday"


def test_a_file_that_goes_while_it_is_sent_is_one_error(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordEpisodes(gym.make("CartPole-v1"), path) as env:
        env.reset(seed=0)
        env.step(0)
    with pytest.raises(StorageError, match=r"cannot read '.*run\.mcap': No such file"):
        admin.send(path, lambda _: path.unlink(missing_ok=True))


def test_numbers_of_numpy_open_a_part_of_a_recording(admin: TupliAPIClient, tmp_path: Path) -> None:
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", episodes=60)
    name = admin.push(tmp_path / "run.mcap")
    for wanted in (np.array([3]), np.array([3, 5]), [np.int64(3)]):
        with admin.open_recording(name, wanted) as recording:
            assert set(wanted) <= set(recording.index["episode"])
    with pytest.raises(
        RecordingError, match="expected a local path, found https://lab/x.mcap; tupli-mcap push"
    ):
        admin.push("https://me:secret@lab/x.mcap")


def test_a_recording_that_has_grown_keeps_its_name(admin: TupliAPIClient, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    names = []
    for episodes in (1, 2):
        with RecordEpisodes(gym.make("CartPole-v1"), path, mode="a") as env:
            env.reset(seed=episodes)
            while not env.step(env.action_space.sample())[2]:
                pass
        names.append(admin.push(path))
        with admin.open_recording(names[-1]) as recording:
            assert len(recording) == episodes
    assert names[0] == names[1]
    headers = admin.list_episodes()
    assert [header.recording for header in headers] == names
    assert {header.run["name"] for header in headers} == {"run"}  # it was given none
