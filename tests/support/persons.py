"""A user who sends plain requests to a server, without our client."""

from __future__ import annotations

import base64
import hashlib
from typing import Any
from urllib.parse import unquote

import gymnasium as gym
import httpx
from serving import PASSWORD

from tupli_mcap.environment import capture
from tupli_mcap.schema import BenchmarkMetadata
from tupli_mcap.storage.benchmark_json import BenchmarkContent, benchmark_hash, pack

__all__ = ["Person", "RefusedError", "announced", "cart_benchmark"]


class RefusedError(Exception):
    """A request did not succeed."""


def announced(data: bytes, length: int | None = None) -> dict[str, str]:
    """The headers that announce an upload of these bytes."""
    digest = base64.b64encode(hashlib.sha256(data).hexdigest().encode()).decode()
    return {
        "Upload-Length": str(len(data) if length is None else length),
        "Upload-Metadata": f"sha256 {digest}",
    }


def cart_benchmark(name: str = "cart") -> dict[str, Any]:
    """CartPole as the JSON of a benchmark."""
    record, metadata = capture(gym.make("CartPole-v1")), BenchmarkMetadata(name=name)
    digest = benchmark_hash(BenchmarkContent(record, ()), metadata)
    return {"hash": digest, "serialized": pack(record, ()), "metadata": {"name": name}}


class Person:
    """A user who is signed in, by default with the password `NAME's password`; nobody without a name."""

    def __init__(self, url: str, name: str = "", password: str = "") -> None:
        self.url, self.name = url, name
        self._password = password or (PASSWORD if name == "admin" else f"{name}'s password")
        self.headers: dict[str, str] = {}
        if name:
            self.sign_in()

    def sign_in(self) -> None:
        told = {"username": self.name, "password": self._password}
        pair = self.call("POST", "/v1/tokens", told)
        assert pair.status_code == 200, pair.text
        self.headers = {"Authorization": f"Bearer {pair.json()['access_token']}"}

    def call(self, method: str, path: str, told: Any = None, **more: Any) -> httpx.Response:
        """The answer to a request with a JSON body."""
        headers = {**self.headers, **more.pop("headers", {})}
        body = {} if told is None else {"json": told}
        # A client that does not look at certificates is made fast; none is kept, which nobody would close.
        return httpx.request(
            method, self.url + path, headers=headers, verify=False, **body, **{"timeout": 120, **more}
        )

    def ask(self, method: str, path: str, told: Any = None, **more: Any) -> Any:
        """The JSON of the answer; RefusedError unless the request succeeds."""
        answer = self.call(method, path, told, **more)
        if answer.status_code >= 300:
            raise RefusedError(f"{method} {path}: {answer.status_code}: {answer.text}")
        return answer.json() if answer.content else None

    def begin(self, data: bytes) -> httpx.Response:
        """Announces a recording."""
        return self.call("POST", "/v1/uploads", headers=announced(data))

    def send(self, data: bytes) -> str:
        """Stores a recording; returns its name."""
        begun = self.begin(data)
        assert begun.status_code in (200, 201), begun.text
        if begun.status_code == 201:
            begun = self.call(
                "PATCH", begun.headers["Location"], headers={"Upload-Offset": "0"}, content=data
            )
            assert begun.status_code == 204, begun.text
        return unquote(begun.headers["Recording"])
