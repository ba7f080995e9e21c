"""Requests to a server, signed in: tokens are kept for this user alone, and renewed when they have expired."""

from __future__ import annotations

import contextlib
import json
import os
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from tupli_mcap import errors, files, jsonvalue, trust
from tupli_mcap.errors import NotFoundError, StorageError, TupliError, missing_extra
from tupli_mcap.remote import shown
from tupli_mcap.storage.atomic import Lock

if TYPE_CHECKING:
    import httpx

__all__ = ["DEFAULT_URL", "Session", "UnreachableError"]

DEFAULT_URL: Final = "http://127.0.0.1:8080"
_ATTEMPTS: Final = 4  # of a request that changes nothing when it is sent twice
_TIMEOUT: Final = 60.0
_SAFE: Final = ("GET", "HEAD", "PUT", "DELETE")
_URL_VARIABLE: Final = "TUPLI_MCAP_URL"
_TOKEN_VARIABLE: Final = "TUPLI_MCAP_TOKEN"


class UnreachableError(StorageError):
    """The server does not answer."""


class Session:
    """Requests to one server, from any thread.

    Tokens lie in `servers.json` in the directory of this user's configuration, by the server's address. A token in
    the environment (TUPLI_MCAP_TOKEN) comes before them.

    Raises:
        StorageError: the address is none of a web server.
        MissingExtraError: httpx is not installed.
    """

    def __init__(self, url: str | None = None, tokens: _TokenFile | None = None) -> None:
        try:
            import httpx
        except ImportError as err:
            raise missing_extra("a storage on a server needs httpx", "remote") from err
        self._tokens = tokens or _TokenFile(trust.config_dir() / "servers.json")
        self.url = _checked(url or os.environ.get(_URL_VARIABLE) or self._tokens.last() or DEFAULT_URL)
        self._client = client = httpx.Client(
            base_url=self.url, timeout=_TIMEOUT, headers={"Accept": "application/json"}
        )
        weakref.finalize(self, client.close)

    def another(self) -> Session:
        """One of the same server and user, with connections of its own."""
        return Session(self.url, self._tokens)

    @property
    def identity(self) -> tuple[str, str, str]:
        """Equal for sessions of one server and user, whose tokens lie at one place."""
        return self.url, self.username, str(self._tokens.path)

    @property
    def username(self) -> str:
        """Who is signed in; empty if nobody is."""
        return str(self._tokens.of(self.url).get("username", ""))

    def close(self) -> None:
        """Close the connections; asking anything afterwards is a StorageError."""
        self._client.close()

    # --- signing in ---

    def sign_in(self, username: str, password: str) -> None:
        """Gets tokens for a user, and keeps them."""
        pair = self.ask("POST", "/v1/tokens", {"username": username, "password": password}, anonymous=True)
        self._tokens.put(self.url, {"username": username, **pair})

    def sign_out(self) -> None:
        """Ends the sign-in, here and on the server."""
        refresh = self._tokens.of(self.url).get("refresh_token")
        self._tokens.put(self.url, None)
        if refresh:
            self.ask("POST", "/v1/tokens/end", {"refresh_token": refresh}, anonymous=True)

    def _renew(self, used: str) -> bool:
        """Exchanges the refresh token, unless another process has just done so; False if there is nothing to use."""
        with self._tokens.alone():
            known = self._tokens.of(self.url)
            if known.get("access_token") not in (None, used):
                return True
            if "refresh_token" not in known:
                return False
            told = {"refresh_token": known["refresh_token"]}
            try:
                pair = self.ask("POST", "/v1/tokens/refresh", told, anonymous=True)
            except UnreachableError:
                raise
            except TupliError:
                self._tokens.put(self.url, None)
                return False
            self._tokens.put(self.url, {"username": known["username"], **pair})
            return True

    # --- asking ---

    def ask(
        self,
        method: str,
        path: str,
        told: Any = None,
        *,
        anonymous: bool = False,
        repeat: bool | None = None,
        **query: Any,
    ) -> Any:
        """What the server answers to a JSON body, as a value; the errors that it tells are raised as they are named.

        repeat: whether to ask again where the connection fails; by default, where the method says so.
        """
        headers = {"Content-Type": "application/json"}
        content = None if told is None else jsonvalue.dumps(told).encode()
        response = self.send(
            method, path, content=content, headers=headers, params=query, anonymous=anonymous, repeat=repeat
        )
        return jsonvalue.loads(response.content) if response.content else None

    def send(
        self,
        method: str,
        path: str,
        *,
        anonymous: bool = False,
        repeat: bool | None = None,
        headers: dict[str, str] | None = None,
        **options: Any,
    ) -> httpx.Response:
        """A request, again if the connection fails and it may be repeated; refusals are raised as errors."""
        token = "" if anonymous else self._token()
        response = self._sent(method, path, token, repeat, headers or {}, options)
        if response.status_code == 401 and not anonymous and self._renew(token):
            response = self._sent(method, path, self._token(), repeat, headers or {}, options)
        if response.status_code == 401 and not anonymous:
            raise StorageError(f"{_error(response)}; sign in: tupli-mcap login USER --url {self.url}")
        if response.status_code >= 400:
            raise _error(response)
        return response

    def _sent(
        self, method: str, path: str, token: str, repeat: bool | None, headers: dict[str, str], options: Any
    ) -> httpx.Response:
        import httpx

        if token:
            headers = {**headers, "Authorization": f"Bearer {token}"}
        if self._client.is_closed:
            raise StorageError("the client is closed; open another one")
        attempts = _ATTEMPTS if (method in _SAFE if repeat is None else repeat) else 1
        for attempt in range(attempts):
            try:
                return self._client.request(method, path, headers=headers, **options)
            except httpx.TransportError as err:
                if attempt == attempts - 1:
                    raise UnreachableError(
                        f"{shown(self.url)} does not answer: {err}; is the server running, and the address right?"
                    ) from None
            time.sleep(0.2 * 2**attempt)
        raise UnreachableError(f"{shown(self.url)} does not answer")

    def _token(self) -> str:
        return os.environ.get(_TOKEN_VARIABLE) or str(self._tokens.of(self.url).get("access_token", ""))


class _TokenFile:
    """Tokens by server, readable by this user alone."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock(path.with_name(f"{path.name}.lock"))

    def alone(self) -> contextlib.AbstractContextManager[object]:
        """Keeps out the other processes and threads; reentrant in a thread."""
        return self._lock

    def of(self, url: str) -> dict[str, Any]:
        """What is kept for a server."""
        found = self._read().get(url)
        return found if isinstance(found, dict) else {}

    def last(self) -> str:
        """The server that was signed in to last; empty if there is none."""
        return next(reversed(self._read()), "")

    def put(self, url: str, tokens: dict[str, Any] | None) -> None:
        """Keeps the tokens of a server, or forgets them."""
        with self._lock:
            known = {name: kept for name, kept in self._read().items() if name != url}
            if tokens is not None:
                known[url] = tokens
            files.write_bytes(self.path, json.dumps(known, indent=2).encode(), permissions=0o600)

    def _read(self) -> dict[str, Any]:
        try:
            found = json.loads(self.path.read_bytes())
        except (OSError, ValueError):
            return {}
        return found if isinstance(found, dict) else {}


def _checked(url: str) -> str:
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or parts.query:
        raise StorageError(
            f"expected the address of a server, such as {DEFAULT_URL}, found {shown(url)!r:.100}"
        )
    return url.rstrip("/")


def _error(response: httpx.Response) -> TupliError:
    """The error that a server tells, of the class that a storage here would raise."""
    try:
        told = json.loads(response.content)
        detail, name = str(told["detail"]), str(told.get("error", ""))
    except (ValueError, KeyError, TypeError, AttributeError):
        detail, name = f"the server answers {response.status_code}", ""
    if response.status_code in (410, 423, 429, 502, 503, 504):
        return UnreachableError(f"the server is busy: {detail[:300]!r}")
    kind = getattr(errors, name, StorageError) if name in errors.__all__ else StorageError
    if not issubclass(kind, TupliError) or kind is TupliError:
        kind = NotFoundError if response.status_code == 404 else StorageError
    return kind("".join(c if c.isprintable() else " " for c in detail[:2000]))


def pages(session: Session, path: str, told: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All that is listed, a page at a time; `limit` and `offset` in `told` are of the whole."""
    left = told.get("limit")
    while True:
        page = session.ask("POST", path, {**told, "limit": left}, repeat=True)
        yield from page["items"]
        left = None if left is None else left - len(page["items"])
        if page["next"] is None or left == 0:
            return
        told = {**told, "cursor": page["next"], "offset": 0}
