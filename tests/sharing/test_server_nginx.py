"""A server behind a real nginx, set up by the file that is shipped."""

from __future__ import annotations

import hashlib
import os
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import httpx
import nginx
import pytest
from served import COMMAND, Process, begin, certificate, served, sign_in
from serving import PASSWORD
from waiting import free_port, wait_for

from tupli_mcap.storage import FileStorage
from tupli_mcap.wrappers.rollout import record_rollouts


class Behind(NamedTuple):
    """url: of nginx. plain: of its port without TLS. server: what it stands before. logs: its directory."""

    url: str
    plain: str
    server: Process
    logs: Path
    certificate: Path
    directory: Path

    def client(self, address: str = "127.0.0.1") -> httpx.Client:
        """A client at an address of this machine."""
        trusted = ssl.create_default_context(cafile=str(self.certificate))
        transport = httpx.HTTPTransport(verify=trusted, local_address=address)
        return httpx.Client(base_url=self.url, transport=transport, timeout=60)


@pytest.fixture(scope="module")
def behind(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Behind]:
    try:
        nginx.program()
    except nginx.NoNginxError as err:
        if os.environ.get("CI"):
            raise
        pytest.skip(str(err))
    folder = tmp_path_factory.mktemp("nginx")
    cert, key = certificate(folder)
    directory = folder / "served"
    port, plain = free_port(), free_port()
    with served(directory, "--trusted-proxy", "127.0.0.1", "--accel", "/files") as server:
        exchanged = {
            "listen 443 ssl": f"listen 127.0.0.1:{port} ssl",
            "listen 80": f"listen 127.0.0.1:{plain}",
            "/etc/nginx/tls/certificate.pem": str(cert),
            "/etc/nginx/tls/key.pem": str(key),
            "/srv/tupli-mcap/": f"{directory}/",
        }
        site = nginx.shipped(server.url.removeprefix("http://"), exchanged)
        with nginx.running(site, port) as logs:
            url = f"https://127.0.0.1:{port}"
            yield Behind(url, f"http://127.0.0.1:{plain}", server, logs, cert, directory)


def recorded(path: Path, seed: int) -> bytes:
    """A recording of more bytes than are written at once."""
    record_rollouts("CartPole-v1", path, steps=150_000, seed=seed)
    data = path.read_bytes()
    assert len(data) > 3 << 20
    return data


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return recorded(tmp_path_factory.mktemp("run") / "run.mcap", seed=1)


@pytest.fixture(scope="module")
def stored(behind: Behind, recording: bytes) -> str:
    """The name of the recording, which was sent through nginx."""
    with behind.client() as client:
        token = sign_in(client)
        place = begin(client, token, recording)
        sent = client.patch(place, headers={"Upload-Offset": "0", **token}, content=recording)
        return str(sent.headers["Recording"])


def addresses(server: Process) -> set[str | None]:
    """The clients' addresses in its log."""
    return {line.get("address") for line in server.log()}


def ticket_of(client: httpx.Client, token: dict[str, str], name: str) -> str:
    answer = client.post("/v1/tickets", json={"recording": name}, headers=token)
    return str(answer.json()["path"])


def test_who_reaches_the_server_itself_gets_the_same_bytes(
    behind: Behind, recording: bytes, stored: str
) -> None:
    with httpx.Client(base_url=behind.server.url) as client:
        assert client.get(ticket_of(client, sign_in(client), stored)).content == recording


def test_files_are_sent_by_nginx(behind: Behind, recording: bytes, stored: str) -> None:
    with behind.client() as client:
        token = sign_in(client)
        path = ticket_of(client, token, stored)
        whole = client.get(path)
        assert (whole.status_code, whole.content) == (200, recording)
        tag = whole.headers["ETag"]
        digest = hashlib.sha256(recording).hexdigest()
        assert digest not in tag  # nginx's own
        for asked, part in (
            ("bytes=0-9", recording[:10]),
            ("bytes=-10", recording[-10:]),
            (f"bytes=1000000-{len(recording)}", recording[1_000_000:]),
        ):
            answer = client.get(path, headers={"Range": asked, "If-Match": tag})
            assert (answer.status_code, answer.content) == (206, part)
            for name, value in {
                "Access-Control-Allow-Origin": "*",
                "X-Content-Type-Options": "nosniff",
                "Content-Type": "application/octet-stream",
                "ETag": tag,
            }.items():
                assert answer.headers[name] == value
            assert "Content-Range" in answer.headers["Access-Control-Expose-Headers"]
            assert ".mcap" in answer.headers["Content-Disposition"]
        pinned = client.get(path, headers={"Range": "bytes=0-9", "If-Match": f'"{digest}"'})
        assert (pinned.status_code, pinned.content) == (206, recording[:10])
        # nginx closes the connection after a 412 though it says keep-alive: the next request might be lost on it.
        other = {"If-Match": '"another"', "Connection": "close"}
        assert client.get(path, headers=other).status_code == 412
        assert client.get(path, headers={"Range": "bytes=99999999-"}).status_code == 416
        head = client.head(path)
        assert (head.headers["Content-Length"], head.content) == (str(len(recording)), b"")
        asked = whole.headers["X-Request-Id"]
    (line,) = [line for line in behind.server.log() if line.get("id") == asked]
    assert (line["status"], line["sent"]) == (200, 0)
    wait_for(lambda: asked in (behind.logs / "access.log").read_text())
    (line,) = [line for line in (behind.logs / "access.log").read_text().splitlines() if line.endswith(asked)]
    assert int(line.split()[5]) > len(recording)


def test_uploads_arrive_while_they_are_sent(behind: Behind, tmp_path: Path) -> None:
    data = recorded(tmp_path / "run.mcap", seed=2)  # what is stored already would not be sent again
    half = 2 << 20
    with behind.client() as client:
        token = sign_in(client)
        place = begin(client, token, data)
        file = behind.directory / "server" / "uploads" / place.rpartition("/")[2]
        context = ssl.create_default_context(cafile=str(behind.certificate))
        port = int(behind.url.rpartition(":")[2])
        with (
            socket.create_connection(("127.0.0.1", port), timeout=60) as plain,
            context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
        ):
            told = {"Host": f"127.0.0.1:{port}", "Content-Length": len(data), "Upload-Offset": 0, **token}
            head = "".join(f"{name}: {value}\r\n" for name, value in told.items())
            connection.sendall(f"PATCH {place} HTTP/1.1\r\n{head}\r\n".encode() + data[:half])
            wait_for(lambda: file.exists() and file.stat().st_size >= half - (1 << 20))
            assert not list((behind.logs / "bodies").iterdir())
        # Here it is broken off, and gone on with from what has come, once the server has noticed.

        def go_on() -> httpx.Response:
            come = int(client.head(place, headers=token).headers["Upload-Offset"])
            assert half - (1 << 20) <= come <= half
            return client.patch(place, headers={"Upload-Offset": str(come), **token}, content=data[come:])

        # 502: the server has refused before nginx had passed on the body
        while (rest := go_on()).status_code in (409, 423, 502):
            time.sleep(0.05)
        assert rest.status_code == 204, rest.text
        assert client.get(ticket_of(client, token, rest.headers["Recording"])).content == data


def test_who_asks_is_known_by_what_nginx_says(behind: Behind) -> None:
    told = {"username": "nobody", "password": "wrong"}
    lie = {"X-Forwarded-For": "9.9.9.9", "X-Real-IP": "9.9.9.9", "Forwarded": "for=9.9.9.9"}
    with behind.client("127.0.0.2") as one, behind.client("127.0.0.3") as other:
        assert [one.post("/v1/tokens", json=told, headers=lie).status_code for _ in range(11)] == [
            401
        ] * 10 + [429]
        assert other.post("/v1/tokens", json=told).status_code == 401
    direct = httpx.HTTPTransport(local_address="127.0.0.4")
    with httpx.Client(base_url=behind.server.url, transport=direct) as client:
        client.post("/v1/tokens", json=told, headers=lie)
    expected = {"127.0.0.2", "127.0.0.3", "127.0.0.4"}
    wait_for(lambda: expected <= addresses(behind.server))  # a line follows its answer
    assert "9.9.9.9" not in addresses(behind.server)


def test_the_page_is_behind_tls(behind: Behind) -> None:
    moved = httpx.get(f"{behind.plain}/sign-in?next=/x")
    assert moved.status_code == 301 and moved.headers["Location"] == "https://127.0.0.1/sign-in?next=/x"
    with behind.client() as client:
        client.get("/sign-in")
        form = {"username": "admin", "password": PASSWORD, "next": "/"}
        headers = {"Origin": behind.url}
        foreign = client.post("/sign-in", data=form, headers={"Origin": "https://evil.example"})
        assert foreign.status_code == 403
        entered = client.post("/sign-in", data=form, headers=headers)
        assert entered.status_code == 303, entered.text
        assert "; Secure" in entered.headers["Set-Cookie"]
        assert "admin" in client.get("/", headers={"Accept": "text/html"}).text


def test_nothing_else_of_the_directory_is_to_be_had(behind: Behind) -> None:
    with behind.client() as client:
        token = sign_in(client)
        for path in (
            "/files/server/server.sqlite",
            "/files/recordings/",
            "/files/",
            "/files../server/secret",
        ):
            assert client.get(path, headers=token).status_code == 404, path


def test_no_log_of_nginx_holds_a_ticket(behind: Behind, stored: str) -> None:
    with behind.client() as client:
        token = sign_in(client)
        path = ticket_of(client, token, stored)
        place = behind.directory / "recordings"
        behind.server.kill()
        try:
            away = client.get(path)
        finally:
            behind.server.start()
        assert away.status_code == 502
        assert client.get(path).status_code == 200
        for file in place.rglob("*.mcap"):
            file.rename(file.with_suffix(".away"))
        lost = client.get(path)
        for file in place.rglob("*.away"):
            file.rename(file.with_suffix(".mcap"))
    assert lost.status_code == 500 and "a backup may have it" in lost.text
    logs = "".join(path.read_text() for path in behind.logs.glob("*.log"))
    assert " 502 " in logs
    assert "ticket" not in logs and token["Authorization"].partition(" ")[2] not in logs


def test_the_commands_go_through_it(behind: Behind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(behind.certificate))
    monkeypatch.setenv("TUPLI_MCAP_PASSWORD", PASSWORD)
    record_rollouts("CartPole-v1", tmp_path / "run.mcap", steps=500, seed=2)

    def run(*arguments: str) -> None:
        done = subprocess.run([COMMAND, *arguments], capture_output=True, text=True, check=False, timeout=120)
        assert done.returncode == 0, done.stderr

    run("login", "admin", "--url", behind.url)
    run("push", str(tmp_path / "run.mcap"))
    run("pull", "--url", behind.url, "--filter", "steps > 0", "--storage", str(tmp_path / "mine"))
    with FileStorage(tmp_path / "mine") as storage:
        assert len(storage.list_episodes())


def test_a_command_tells_that_the_server_behind_it_does_not_run(
    behind: Behind, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(behind.certificate))
    monkeypatch.setenv("TUPLI_MCAP_TOKEN", "any")
    behind.server.kill()
    try:
        done = subprocess.run(
            [COMMAND, "whoami", "--url", behind.url], capture_output=True, text=True, check=False, timeout=120
        )
    finally:
        behind.server.start()
    assert "answers 502, as a proxy does while the server behind it does not run" in done.stderr


def test_an_address_holds_the_ids_of_many_episodes(behind: Behind) -> None:
    ids = [f"{'0' * 32}-{number}" for number in range(1_000)]
    with behind.client() as client:
        moved = client.get("/episodes", params={"episode": ids})
        assert moved.status_code == 303 and moved.headers["Location"].startswith("/sign-in?next=")
        assert client.get(moved.headers["Location"]).status_code == 200
