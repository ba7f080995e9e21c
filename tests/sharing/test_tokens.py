"""Where tokens are kept, and that they are nowhere else."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import web_server
from keyrings import Keyring, keyring_in_memory
from serving import PASSWORD, serving

from tupli_mcap.errors import NotFoundError, StorageError
from tupli_mcap.server.settings import Settings
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.api.tokens import user_tokens


@pytest.fixture
def kept() -> Iterator[Keyring]:
    with keyring_in_memory() as kept:
        yield kept


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with serving(Settings(tmp_path_factory.mktemp("served"))) as url:
        yield url


def signed_in(url: str) -> TupliAPIClient:
    client = TupliAPIClient(url)
    client.login("admin", PASSWORD)
    return client


def servers_file() -> Path:
    return Path(os.environ["TUPLI_MCAP_CONFIG_DIR"]) / "servers.json"


def servers() -> dict[str, dict[str, str]]:
    found: dict[str, dict[str, str]] = json.loads(servers_file().read_bytes())
    return found


def test_tokens_are_in_the_keyring(kept: Keyring, url: str) -> None:
    with signed_in(url), TupliAPIClient() as another:
        assert servers() == {url: {"username": "admin", "keyring": f"admin at {url}"}}
        assert list(kept.kept) == [("tupli-mcap", f"admin at {url}")]
        assert another.whoami().username == "admin"
        kept.locked = True
        assert another.whoami().username == "admin"  # what was read holds
        with (
            TupliAPIClient() as third,
            pytest.raises(StorageError, match="does not give the tokens.*unlock") as told,
        ):
            third.whoami()
        assert "secret words" not in str(told.value)
        kept.locked = False
        another.logout()
        assert (kept.kept, servers()) == ({}, {url: {}})


def test_the_keyring_keeps_nothing_of_who_was_signed_in_before(kept: Keyring) -> None:
    store, tokens = user_tokens(), {"access_token": "a", "refresh_token": "b"}
    for name in ("ann", "bob", "bob"):
        store.put("https://lab", name, tokens)
    assert list(kept.kept) == [("tupli-mcap", "bob at https://lab")] and store.tokens("https://lab") == tokens


def test_where_the_keyring_refuses_they_are_in_a_private_file(kept: Keyring, url: str) -> None:
    kept.locked = True
    with signed_in(url), TupliAPIClient(url) as another:
        assert another.whoami().username == "admin"
        assert set(servers()[url]) == {"username", "access_token", "refresh_token"}
        assert servers_file().stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("status", [401, 404, 501])
def test_only_the_server_ends_a_sign_in(status: int) -> None:
    """Not another one that answers at its address for a while."""
    with web_server.serving() as other:
        other.failures = [401, status]
        url, tokens = other.url(""), {"access_token": "expired", "refresh_token": "valid"}
        user_tokens().put(url, "ann", tokens)
        with (
            TupliAPIClient(url) as client,
            pytest.raises(StorageError, match=f"{status} to POST /v1/tokens/refresh"),
        ):
            client.whoami()
        assert user_tokens().tokens(url) == tokens


def test_a_sign_in_that_ends_does_not_choose_the_server() -> None:
    store = user_tokens()
    for url in ("https://first", "https://second"):
        store.put(url, "ann", {"access_token": "a", "refresh_token": "b"})
    store.end("https://first")
    assert store.last() == "https://second" and store.username("https://first") == "ann"
    store.forget("https://first")
    store.forget("https://never-used")
    assert store.last() == "https://second" and store.username("https://first") == ""
    store.use("https://first")
    assert store.last() == "https://first"


def test_a_token_in_the_environment_comes_first(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with signed_in(url) as client:
        client.signup("ann", "ann-password")
        client.login("ann", "ann-password")
        token = client.create_token("robot", "write", days=None)
        assert (token.name, token.expires, client.list_tokens()[0].token) == ("robot", None, "")
        assert token.token not in repr(token)
        client.login("admin", PASSWORD)
        monkeypatch.setenv("TUPLI_MCAP_TOKEN", token.token)
        assert client.username == "ann"
        with pytest.warns(UserWarning, match="still those of the token in TUPLI_MCAP_TOKEN"):
            client.login("admin", PASSWORD)
        with pytest.warns(UserWarning, match="still those of the token in TUPLI_MCAP_TOKEN"):
            client.logout()
        assert client.username == "ann"
        monkeypatch.delenv("TUPLI_MCAP_TOKEN")
        client.login("ann", "ann-password")
        client.delete_token(token.id)
        monkeypatch.setenv("TUPLI_MCAP_TOKEN", token.token)
        with pytest.raises(StorageError, match="not valid.*put another token into TUPLI_MCAP_TOKEN") as told:
            client.list_benchmarks()
        assert token.token not in str(told.value)


def test_nothing_secret_is_in_logs_and_errors(url: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with signed_in(url) as client:
        secrets = list(client._session.tokens.tokens(url).values())
        client._session.send("GET", "/health", params={"ticket": "a-ticket"})
        with pytest.raises(NotFoundError) as told:
            client.open_recording("recordings/x.mcap")
        with pytest.raises(StorageError) as wrong:
            client.login("admin", "a wrong password")
        said = "\n".join([caplog.text, repr(client), str(told.value), str(wrong.value)])
    assert "/health?ticket=" in caplog.text
    for secret in (*secrets, PASSWORD, "a wrong password", "a-ticket"):
        assert secret not in said
