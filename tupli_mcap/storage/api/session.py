"""Signed-in requests to a server. Renews expired tokens, and repeats requests that failed on the way, if repeating them
is harmless."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import time
import weakref
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, BinaryIO, Final
from urllib.parse import urlsplit

from tupli_mcap import jsonvalue
from tupli_mcap.errors import FormatError, StorageError, missing_extra, warn
from tupli_mcap.remote import AUTHORITY, shown
from tupli_mcap.storage.api.answers import (
    LATER,
    Page,
    SignInError,
    TokenPair,
    UnreachableError,
    as_told,
    error_of,
)
from tupli_mcap.storage.api.tokens import TokenStore, user_tokens

if TYPE_CHECKING:
    import httpx

DEFAULT_URL: Final = "http://127.0.0.1:8080"
TIMEOUT: Final = 60.0  # seconds without a byte
_CONNECT_TIMEOUT: Final = 10.0
_ATTEMPTS: Final = 4  # of a request that may be repeated
_SAFE: Final = ("GET", "HEAD", "PUT", "DELETE")
_MOST_REDIRECTIONS: Final = 3
_MOST_BYTES: Final = 512 << 20  # of an answer that is read into memory: the largest has a benchmark
_PACKED: Final = (
    "",
    "identity",
    "gzip",
)  # a byte becomes 1000 at most; by zstd, or packed twice, any number of bytes
_OF_BODIES: Final = ("content-encoding", "content-length", "transfer-encoding")  # as they are sent
_NOTHING_LEFT: Final = 416  # there is nothing from that offset on
_URL_VARIABLE: Final = "TUPLI_MCAP_URL"
_TOKEN_VARIABLE: Final = "TUPLI_MCAP_TOKEN"
_users: dict[tuple[str, str], str] = {}  # by server and token of the environment


class Session:
    """Requests to one server, from any thread and any fork of the process.

    A token in the environment (TUPLI_MCAP_TOKEN) takes precedence over stored ones.

    Raises:
        StorageError: the address is not that of a web server, or the proxies or authorities that the environment names
            cannot be used.
        MissingExtraError: httpx is not installed.
    """

    def __init__(self, url: str | None = None, tokens: TokenStore | None = None) -> None:
        try:
            import httpx  # noqa: F401
        except ImportError as err:
            raise missing_extra("a storage on a server needs httpx", "remote") from err
        self.tokens = tokens or user_tokens()
        self.url = _checked(url or os.environ.get(_URL_VARIABLE) or self.tokens.last() or DEFAULT_URL)
        self._closed = False
        self._process = os.getpid()
        self._client = self._connected()

    def _connected(self) -> httpx.Client:
        import httpx

        logging.getLogger("httpx").addFilter(_NO_TICKETS)  # added twice, it is there once
        timeout = httpx.Timeout(TIMEOUT, connect=_CONNECT_TIMEOUT)
        accept = {"Accept": "application/json", "Accept-Encoding": "gzip"}
        try:
            client = httpx.Client(base_url=self.url, timeout=timeout, headers=accept)
        except OSError as err:
            authorities = os.environ.get("SSL_CERT_FILE") or os.environ.get("SSL_CERT_DIR")
            raise StorageError(
                f"expected certificates of authorities (PEM) in {authorities} (SSL_CERT_FILE): "
                f"{err.strerror or err}; correct or unset it"
            ) from err
        except (ImportError, ValueError, httpx.InvalidURL) as err:
            raise StorageError(
                "the proxies of the environment (HTTP_PROXY, HTTPS_PROXY, ALL_PROXY, NO_PROXY) cannot be used: "
                f"{shown(str(err)).rstrip('.')}; correct or unset them"
            ) from err
        weakref.finalize(self, client.close)
        return client

    @property
    def client(self) -> httpx.Client:
        """The connections of this process."""
        if self._closed:
            raise StorageError("the client is closed; open another one")
        if self._process != os.getpid():  # a forked child must not use its parent's connections
            self._client, self._process = self._connected(), os.getpid()
        return self._client

    def another(self) -> Session:
        """A session with the same server and user, and its own connections."""
        return Session(self.url, self.tokens)

    @property
    def known_user(self) -> str | None:
        """The signed-in user, empty if nobody is; None while the user of the token in the environment is unknown."""
        token = os.environ.get(_TOKEN_VARIABLE)
        return _users.get((self.url, token)) if token else self.tokens.username(self.url)

    @property
    def username(self) -> str:
        """The signed-in user; empty if nobody is. Asks the server for the user of a token in the environment."""
        if self.known_user is None:
            me = as_told(dict[str, Any], self.ask("GET", "/v1/me"))
            _users[self.url, os.environ[_TOKEN_VARIABLE]] = str(me.get("username", ""))
        return self.known_user or ""

    @property
    def identity(self) -> tuple[str, str, str]:
        """Equal for sessions with the same server, user and token store."""
        return self.url, self.username, str(self.tokens.path)

    def close(self) -> None:
        """Close the connections; later requests raise StorageError."""
        self._closed = True
        self._client.close()

    # --- signing in ---

    def sign_in(self, username: str, password: str) -> None:
        """Gets tokens for a user, and stores them."""
        pair = self.ask("POST", "/v1/tokens", {"username": username, "password": password}, anonymous=True)
        self.tokens.put(self.url, username, as_told(TokenPair, pair).model_dump())
        _warn_of_variable()

    def sign_out(self) -> None:
        """Ends the sign-in, here and on the server."""
        refresh = self.tokens.tokens(self.url).get("refresh_token")
        self.tokens.forget(self.url)
        if refresh:
            self.ask("POST", "/v1/tokens/end", {"refresh_token": refresh}, anonymous=True)
        _warn_of_variable()

    def _renew(self, used: str) -> bool:
        """Exchanges the refresh token, unless another process has just done so; False if there is none, or the server
        says that the sign-in has ended."""
        with self.tokens.lock:
            known = self.tokens.tokens(self.url)
            if known.get("access_token") not in (None, used):
                return True
            if "refresh_token" not in known:
                return False
            refresh = {"refresh_token": known["refresh_token"]}
            try:
                pair = self.ask("POST", "/v1/tokens/refresh", refresh, anonymous=True)
            except SignInError:
                self.tokens.end(self.url)
                return False
            self.tokens.put(self.url, self.tokens.username(self.url), as_told(TokenPair, pair).model_dump())
            return True

    # --- asking ---

    def ask(
        self,
        method: str,
        path: str,
        told: Any = None,
        *,
        content: bytes | None = None,
        headers: dict[str, str] | None = None,
        anonymous: bool = False,
        repeat: bool | None = None,
        **query: Any,
    ) -> Any:
        """Sends a JSON body, or `content`; returns the answer as a value. Raises the server's refusals as errors.

        repeat: repeat the request if the connection fails; by default, if its method is idempotent.
        """
        if content is None and told is not None:
            content = jsonvalue.dumps(told).encode()
        headers = {"Content-Type": "application/json", **(headers or {})}
        response = self.send(
            method, path, content=content, headers=headers, params=query, anonymous=anonymous, repeat=repeat
        )
        try:
            return jsonvalue.loads(response.content) if response.content else None
        except (ValueError, FormatError, RecursionError):
            raise StorageError(
                f"expected JSON from {shown(self.url)}, found something else; is it a tupli-mcap server?"
            ) from None

    def send(
        self,
        method: str,
        path: str,
        *,
        anonymous: bool = False,
        repeat: bool | None = None,
        stream: bool = False,
        headers: dict[str, str] | None = None,
        **options: Any,
    ) -> httpx.Response:
        """Sends a request, and repeats it if the connection fails and it may be repeated. Raises refusals as errors.

        stream: the caller reads the body and closes the answer; redirections are followed. content: bytes, or a
            function that returns them in pieces, each time from the beginning.
        """
        token = "" if anonymous else self._token()
        options |= {"headers": headers or {}, "stream": stream}
        response = self._sent(method, path, token, repeat, **options)
        if response.status_code == 401 and not anonymous and self._renew(token):
            response.close()
            response = self._sent(method, path, self._token(), repeat, **options)
        if response.status_code >= 400 and not (stream and response.status_code == _NOTHING_LEFT):
            answer = self._whole(response) if stream else response
            raise error_of(answer, shown(self.url), sign_in="" if anonymous else self._sign_in())
        return response

    def _sign_in(self) -> str:
        """Tells the user how to sign in."""
        if os.environ.get(_TOKEN_VARIABLE):
            return f"put another token into {_TOKEN_VARIABLE}, or take it out of the environment and sign in"
        return f"sign in: tupli-mcap login USER --url {shown(self.url)}"

    def _sent(
        self,
        method: str,
        path: str,
        token: str,
        repeat: bool | None,
        *,
        headers: dict[str, str],
        stream: bool,
        **options: Any,
    ) -> httpx.Response:
        import httpx

        if token:
            headers = {**headers, "Authorization": f"Bearer {token}"}
        last = (_ATTEMPTS if (method in _SAFE if repeat is None else repeat) else 1) - 1
        for attempt in range(last + 1):
            try:
                response = self._answered(method, path, stream, headers=headers, **options)
                if attempt and method == "DELETE" and response.status_code == 404:
                    return httpx.Response(204)  # it was deleted, and the answer was lost
                if attempt == last or response.status_code not in LATER:
                    return response
                response.close()
            except httpx.RequestError as err:
                if attempt == last:
                    raise self._unreachable(err) from None
            time.sleep(0.2 * 2**attempt)
        raise UnreachableError(f"{shown(self.url)} does not answer")

    def _answered(self, method: str, path: str, stream: bool, **options: Any) -> httpx.Response:
        """The answer to a request. Follows the redirection of a GET to a bucket, without sending the token there."""
        client = self.client
        if callable(options.get("content")):
            options["content"] = options["content"]()
        response = client.send(client.build_request(method, path, **options), stream=True)
        for _ in range(_MOST_REDIRECTIONS):
            further = response.next_request
            if further is None or method != "GET":
                break
            response.close()
            response = client.send(further, stream=True)
        return response if stream else self._whole(response)

    def _whole(self, response: httpx.Response) -> httpx.Response:
        """An answer with its body, which is read here. StorageError if that has no end: the server may be anybody's."""
        import httpx

        body = bytearray()
        with contextlib.closing(response):
            for piece in self._unpacked(response):
                body += piece
                if len(body) > _MOST_BYTES:
                    raise StorageError(
                        f"expected an answer of at most {_MOST_BYTES} bytes from {shown(self.url)}, found more; is it "
                        "a tupli-mcap server?"
                    )
        of_unpacked = [each for each in response.headers.multi_items() if each[0] not in _OF_BODIES]
        return httpx.Response(
            response.status_code, headers=of_unpacked, content=bytes(body), request=response.request
        )

    def _unpacked(self, response: httpx.Response) -> Iterator[bytes]:
        """The body of an answer in pieces. StorageError if one piece may be of any size."""
        packed = response.headers.get("content-encoding", "").lower()
        if packed not in _PACKED:
            raise StorageError(
                f"expected an answer from {shown(self.url)} that is packed by gzip or not at all, found {packed!r:.80}"
            )
        return response.iter_bytes()

    def _unreachable(self, err: Exception) -> UnreachableError:
        why = str(err) or type(err).__name__
        if "CERTIFICATE_VERIFY_FAILED" in why:
            return UnreachableError(
                f"the certificate of {shown(self.url)} is not trusted here: {why}; check the address; {AUTHORITY}"
            )
        return UnreachableError(
            f"{shown(self.url)} does not answer{_by_proxy(self.url)}: {why}; is the server running, and the address "
            "right?"
        )

    def stream(self, path: str, start: int) -> Iterator[bytes]:
        """The bytes of an answer from an offset on. If the connection breaks off, asks for the rest."""
        import httpx

        fruitless = 0
        while True:
            try:
                for piece in self._pieces(path, start):
                    fruitless, start = 0, start + len(piece)
                    yield piece
                return
            except httpx.RequestError as err:
                fruitless += 1
                if fruitless == _ATTEMPTS:
                    raise self._unreachable(err) from None
            time.sleep(0.2 * 2**fruitless)

    def _pieces(self, path: str, start: int) -> Iterator[bytes]:
        headers = {"Accept-Encoding": "identity", "Range": f"bytes={start}-"}
        with contextlib.closing(self.send("GET", path, headers=headers, stream=True)) as response:
            if response.status_code == _NOTHING_LEFT:
                return
            skipped = 0 if response.status_code == 206 else start  # all of it comes
            for piece in response.iter_raw():
                if len(piece) > skipped:  # else nothing new has come
                    yield piece[skipped:]
                skipped = max(0, skipped - len(piece))

    def fetch(self, path: str, told: Any, file: BinaryIO) -> None:
        """Writes the answer to a JSON body into a file; begins again if the connection breaks off."""
        import httpx

        content, headers = jsonvalue.dumps(told).encode(), {"Content-Type": "application/json"}
        for attempt in range(_ATTEMPTS):
            file.truncate(file.seek(0))
            try:
                answer = self.send("POST", path, content=content, headers=headers, stream=True, repeat=True)
                with contextlib.closing(answer):
                    for piece in self._unpacked(answer):
                        file.write(piece)
                return
            except httpx.RequestError as err:
                if attempt == _ATTEMPTS - 1:
                    raise self._unreachable(err) from None
            time.sleep(0.2 * 2**attempt)

    def _token(self) -> str:
        """Empty for a guest, whom nobody becomes by a sign-in that has ended."""
        token = os.environ.get(_TOKEN_VARIABLE) or self.tokens.tokens(self.url).get("access_token", "")
        name = "" if token else self.tokens.username(self.url)
        if name:
            url = shown(self.url)
            raise SignInError(
                f"the sign-in of {name} at {url} has ended; sign in again: tupli-mcap login {name} --url {url}, "
                f"or go on as a guest: tupli-mcap logout --url {url}"
            )
        return token


def _warn_of_variable() -> None:
    if os.environ.get(_TOKEN_VARIABLE):
        warn(f"requests are still those of the token in {_TOKEN_VARIABLE}; unset it to use your own sign-in")


def _by_proxy(url: str) -> str:
    """The proxy that the environment names for a server, for an error; "" without one."""
    from urllib.request import getproxies, proxy_bypass

    parts = urlsplit(url)
    proxies = getproxies()
    proxy = proxies.get(parts.scheme) or proxies.get("all")
    if not proxy or proxy_bypass(parts.hostname or ""):
        return ""
    return f" through the proxy {shown(proxy if '://' in proxy else f'http://{proxy}')}"


class _NoTickets(logging.Filter):
    """Removes secret addresses of recordings from httpx's log: whoever has one can read the recording."""

    def filter(self, record: logging.LogRecord) -> bool:
        if isinstance(record.args, tuple):
            record.args = tuple(
                re.sub("ticket=[^&]+", "ticket=…", str(arg)) if "ticket=" in str(arg) else arg
                for arg in record.args
            )
        return True


_NO_TICKETS: Final = _NoTickets()


def _checked(url: str) -> str:
    try:
        parts = urlsplit(url)
        has_more = parts.username or parts.password or parts.query or parts.port == 0
        is_address = parts.scheme in ("http", "https") and parts.hostname and not has_more
    except (
        ValueError,
        AttributeError,
        TypeError,
    ):  # no text, a port that is none, half of a pair of brackets
        is_address = False
    if not is_address:
        raise StorageError(
            f"expected the address of a server, such as {DEFAULT_URL}, without a user or a query (tupli-mcap login "
            f"signs in), found {shown(str(url))!r:.100}"
        )
    return url.rstrip("/")


def pages(session: Session, path: str, asked: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """All items of a list, fetched page by page; `limit` and `offset` in `asked` are of the whole list."""
    left = asked.get("limit")
    while True:
        page = as_told(Page, session.ask("POST", path, {**asked, "limit": left}, repeat=True))
        yield from page.items
        left = None if left is None else left - len(page.items)
        if page.next is None or left == 0:
            return
        asked = {**asked, "cursor": page.next, "offset": 0}
