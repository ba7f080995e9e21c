"""A server as those who run it have it: processes that are started, watched and stopped."""

from __future__ import annotations

import contextlib
import os
import signal
import ssl
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from postgres import Cluster
from served import COMMAND, begin, certificate, served, sign_in
from serving import PASSWORD
from sqlalchemy import select

from tupli_mcap import Recording
from tupli_mcap.errors import RecordingError, StorageError
from tupli_mcap.server import database
from tupli_mcap.server.backup import back_up, restore
from tupli_mcap.server.database import Database, UnavailableError, audit
from tupli_mcap.server.library import Library
from tupli_mcap.server.settings import Settings
from tupli_mcap.server.tables import AUDIT
from tupli_mcap.storage import TupliAPIClient
from tupli_mcap.wrappers.rollout import record_rollouts


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    record_rollouts("CartPole-v1", path, steps=1000, seed=1)
    return path.read_bytes()


def test_a_database_as_psql_names_it(postgres: Cluster) -> None:
    with postgres.database() as url:
        Database(url.replace("postgresql+psycopg://", "postgresql://")).close()
        Database(url.replace("postgresql+psycopg://", "postgres://")).close()
    with pytest.raises(
        StorageError, match="cannot be used: .*; give a URL such as postgresql://user@host/name"
    ):
        Database("no database")


def test_a_server_that_is_frozen_keeps_the_others_waiting_for_a_moment_only(
    postgres: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database, "_IDLE_MS", 500)
    with (
        postgres.database() as url,
        contextlib.closing(Database(url)) as frozen,
        contextlib.closing(Database(url)) as other,
    ):
        with pytest.raises(UnavailableError), frozen.writing() as writing:
            with other.writing() as connection:
                audit(connection, "ann", "store", "run")
            audit(writing, "bob", "store", "run")
        with other.reading() as connection:
            assert connection.execute(select(AUDIT.c.user)).scalars().all() == ["ann"]


def test_who_waits_too_long_to_write_is_told_to_try_again(
    postgres: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And not that a query takes too long, which is the caller's mistake."""
    monkeypatch.setattr(database, "BUSY_MS", 1000)
    with postgres.database() as url, contextlib.closing(Database(url, 0.5)) as made, made.writing():
        with pytest.raises(UnavailableError, match="lock timeout"), made.writing():
            pass


@pytest.mark.parametrize("workers", ["1", "2"])
def test_ctrl_c_is_how_a_server_ends(tmp_path: Path, workers: str) -> None:
    with served(tmp_path / "served", "--workers", workers) as server:
        os.kill(server.pid, signal.SIGINT)
        assert server.wait() == 0
        assert "interrupted" not in server.log_file.read_text()


def test_several_processes_with_a_certificate(tmp_path: Path, recording: bytes) -> None:
    cert, key = certificate(tmp_path)
    options = ("--workers", "2", "--certificate", str(cert), "--key", str(key))
    with served(tmp_path / "served", *options) as server:
        assert server.url.startswith("https://")
        unknown = "certificate of .* is not trusted here.*SSL_CERT_FILE"
        with pytest.raises(StorageError, match=unknown), TupliAPIClient(server.url) as stranger:
            stranger.login("admin", PASSWORD)
        with pytest.raises(RecordingError, match=unknown):
            Recording(f"{server.url}/run.mcap")
        context = ssl.create_default_context(cafile=str(cert))
        secrets = [PASSWORD]
        for _ in range(4):  # each connection may reach another process
            with httpx.Client(base_url=server.url, verify=context, timeout=60) as client:
                token = sign_in(client)
                secrets.append(token["Authorization"].partition(" ")[2])
                place = begin(client, token, recording)
                offset = int(client.head(place, headers=token).headers["Upload-Offset"])
                part = recording[offset : offset + len(recording) // 4 + 1]
                client.patch(place, headers={"Upload-Offset": str(offset), **token}, content=part)
        with httpx.Client(base_url=server.url, verify=context, timeout=60) as client:
            listed = client.post("/v1/episodes/list", json={"limit": 1}, headers=token).json()["items"]
            ticket = client.post(
                "/v1/tickets", json={"recording": listed[0]["recording"]}, headers=token
            ).json()
            secrets.append(ticket["path"].partition("ticket=")[2])
            assert client.get(ticket["path"]).content == recording
            client.get("/v1/me", headers={"Authorization": "Bearer forged-token-of-somebody"})
            metrics = client.get("/metrics", headers=token).text
            assert 'tupli_mcap_requests_total{method="POST",route="/v1/tokens",status="200"} 4.0' in metrics
            assert f"tupli_mcap_recording_bytes {float(len(recording))}" in metrics
            assert client.get("/metrics").status_code == 401
        server.stop()
        assert server.wait() == 0
        log, text = server.log(), server.log_file.read_text()
    assert not [secret for secret in (*secrets, "forged-token") if secret in text]
    requests = [line for line in log if line["event"] == "request"]
    patched = [line for line in requests if line["method"] == "PATCH"]
    assert {line["user"] for line in patched} == {"admin"}
    assert sum(line["received"] for line in patched) == len(recording)
    assert {line["route"] for line in patched} == {"/v1/uploads/{upload_id}"}
    assert len({line["id"] for line in requests}) == len(requests)
    (fetched,) = [line for line in requests if line["route"] == "/v1/files/{name:file_name}"]
    assert (fetched["status"], fetched["sent"], fetched["user"]) == (200, len(recording), "admin")


def test_a_certificate_that_openssl_makes_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cert, key = certificate(tmp_path, of_authority=True)
    monkeypatch.setenv("SSL_CERT_FILE", str(cert))
    with served(tmp_path / "served", "--certificate", str(cert), "--key", str(key)) as server:
        with pytest.raises(RecordingError, match=r"of an authority; .*CA:FALSE"):
            Recording(f"{server.url}/run.mcap")


def test_who_is_sending_may_finish_when_the_server_stops(tmp_path: Path, recording: bytes) -> None:
    with served(tmp_path / "served") as server:
        with httpx.Client(base_url=server.url, timeout=120) as client:
            token = sign_in(client)
            place = begin(client, token, recording)
            stopping = threading.Event()

            def slowly() -> Iterator[bytes]:
                yield recording[:1000]
                server.stop()
                stopping.set()
                while True:  # until nobody new is let in
                    try:
                        httpx.get(f"{server.url}/health", timeout=60)
                    except httpx.TransportError:
                        break
                    time.sleep(0.05)
                yield recording[1000:]

            headers = {"Upload-Offset": "0", "Content-Length": str(len(recording)), **token}
            sent = client.patch(place, headers=headers, content=slowly())
            assert stopping.is_set() and sent.status_code == 204, sent.text
            name = sent.headers["Recording"]
        assert server.wait() == -signal.SIGTERM
        server.start()
        with TupliAPIClient(server.url) as admin:
            admin.login("admin", PASSWORD)
            assert {header.recording for header in admin.list_episodes()} == {name}


def test_a_certificate_that_is_none(tmp_path: Path) -> None:
    _, key = certificate(tmp_path)
    for workers in ("1", "2"):
        command = [COMMAND, "serve", str(tmp_path / "b"), "--port", "0", "--workers", workers]
        command += ["--certificate", str(key), "--key", str(key)]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr.startswith(
            f"error: expected a certificate in {key} and its key in {key}, both in PEM: "
        )
        assert done.stderr.count("\n") == 1


def test_an_address_of_a_loader_that_is_none(tmp_path: Path) -> None:
    command = [COMMAND, "serve", str(tmp_path / "b"), "--foxglove-loader", "loader.example.org"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2 and not (tmp_path / "b").exists()
    assert "expected an address such as https://" in done.stderr and "'loader.example.org'" in done.stderr


def test_a_directory_that_is_none(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        StorageError, match=r"cannot use the directory '.*/file/server': Not a directory; choose"
    ):
        Library(Settings(tmp_path / "file"))


@pytest.mark.parametrize("name", ["a?b", "a%41b", "a?mode=memory", "a #&b", os.fsdecode(b"\xff")])
def test_a_directory_has_its_database_in_it_whatever_its_name(name: str, tmp_path: Path) -> None:
    """Else servers of `a?1` and `a?2` would share one."""
    settings, backup = Settings(tmp_path / "served" / name), tmp_path / "backups" / name
    with contextlib.closing(Library(settings)) as library:
        library.first_password()
    assert [path.name for path in (tmp_path / "served").iterdir()] == [name]
    assert back_up(settings, backup).users == 1
    assert [path.name for path in backup.parent.iterdir()] == [name]
    assert restore(backup, Settings(tmp_path / "restored" / name)).users == 1


def test_an_address_that_is_taken(tmp_path: Path) -> None:
    with served(tmp_path / "served") as server:
        command = [COMMAND, "serve", str(tmp_path / "b"), "--port", str(server.port)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert f"error: cannot listen at 127.0.0.1, port {server.port}: Address already in use" in done.stderr
    assert done.stderr.endswith("; choose another address or port\n") and done.stderr.count("choose") == 1
