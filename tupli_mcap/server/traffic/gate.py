"""Wraps every request: gives it an id, limits its body, counts and logs it, and writes errors only into the log.

A body is read, and its JSON parsed, before the caller is known: strangers may send only short ones.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable
from typing import Any, Final

from fastapi import HTTPException
from fastapi.security.utils import get_authorization_scheme_param
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bind_contextvars, clear_contextvars

from tupli_mcap.server.settings import Settings
from tupli_mcap.server.traffic.logs import LOG
from tupli_mcap.server.traffic.metrics import Metrics

_CONTENT: Final = frozenset(
    ("/v1/benchmarks", "/v1/artifacts", "/benchmarks/create", "/artifacts/upload", "/episodes/record")
)
_METHODS: Final = frozenset(("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"))
_BYTES: Final = frozenset(("/v1/artifacts",))  # takes no JSON
_MARKS: Final = (b"[", b"{", b",")
# A proxy that many use keeps no answer: some look neither at Authorization nor at what a ticket is worth by then.
_HEADERS: Final = {b"x-content-type-options": b"nosniff", b"cache-control": b"private, no-cache"}
_QUIET: Final = frozenset(("/health", "/ready", "/metrics"))


class Gate:
    """An ASGI application around the server's. known: whether a token is that of a user."""

    def __init__(
        self, app: ASGIApp, settings: Settings, metrics: Metrics, known: Callable[[str], bool]
    ) -> None:
        self._app, self._settings, self._metrics, self._known = app, settings, metrics, known

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        passing = _Passing(scope, receive, send, self._settings.max_marks)
        clear_contextvars()
        bind_contextvars(id=passing.id)  # which is in every line of the log from here on
        with self._metrics.running.track_inprogress():
            try:
                if (refusal := await self._refusal(scope)) is not None:
                    await passing.answer(*refusal)
                else:
                    await self._app(scope, passing.receive, passing.send)
            except ClientDisconnect:
                pass  # in the middle of its body; noted as 499
            except Exception:
                LOG.exception("failed", extra={"route": _route(scope)})
                if not passing.status:
                    await passing.answer(500, "the server has failed; its log says more")
                else:
                    raise  # ends the connection, so that the client does not take the answer for complete
            finally:
                self._note(scope, passing)

    async def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """The status and the reason for refusing a body; None to read it."""
        headers, settings = dict(scope["headers"]), self._settings
        if scope["method"] == "PATCH":  # its body is measured while it arrives
            return None
        most = settings.max_body if scope["path"] in _CONTENT else settings.max_message
        said = headers.get(b"content-length", b"0")
        if b"transfer-encoding" in headers or not said.isdigit() or len(said) >= 20 or int(said) > most:
            return 413, f"expected a body of at most {most} bytes, with its Content-Length"
        if int(said) <= settings.max_message:
            return None
        _, token = get_authorization_scheme_param(headers.get(b"authorization", b"").decode("latin-1"))
        if bool(token) and await run_in_threadpool(self._known, token):
            return None
        return 401, f"expected at most {settings.max_message} bytes of somebody who is not signed in; sign in"

    def _note(self, scope: Scope, passing: _Passing) -> None:
        method = scope["method"] if scope["method"] in _METHODS else "-"
        route, seconds = _route(scope), time.monotonic() - passing.begun
        status = passing.status or 499  # the client has disconnected
        self._metrics.requests.labels(method, route, str(status)).inc()
        self._metrics.seconds.labels(method, route).observe(seconds)
        self._metrics.received.inc(passing.received)
        self._metrics.sent.inc(passing.sent)
        if route in _QUIET and status < 400:
            return
        client = scope.get("client")
        told = {
            "user": scope.get("state", {}).get("user"),
            "address": client[0] if client else None,
            "method": method,
            "route": route,
            "status": status,
            "seconds": round(seconds, 4),
            "received": passing.received,
            "sent": passing.sent,
        }
        LOG.info("request", extra=told)


class _Passing:
    """A request on its way through the gate."""

    def __init__(self, scope: Scope, receive: Receive, send: Send, max_marks: int) -> None:
        self.id = secrets.token_hex(8)
        self.begun = time.monotonic()
        self.status = self.received = self.sent = 0
        self._receive, self._send, self._max_marks = receive, send, max_marks
        self._marks = 0  # so far
        kinds = [value.lower() for name, value in scope["headers"] if name == b"content-type"]
        may_be = not any(kinds) or any(b"json" in kind for kind in kinds)
        self._is_json = may_be and scope["method"] != "PATCH" and scope["path"] not in _BYTES
        scope.setdefault("state", {})

    async def receive(self) -> Message:
        """Receives a part of the body; HTTPException if its JSON may have too many values: a mark comes before each."""
        message = await self._receive()
        body = message.get("body", b"")
        self.received += len(body)
        if self._is_json:
            self._marks += sum(map(body.count, _MARKS))
            if self._marks > self._max_marks:
                raise HTTPException(
                    413,
                    f"expected JSON with at most {self._max_marks} commas and opening brackets, found more",
                )
        return message

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            headers = {**_HEADERS, b"x-request-id": self.id.encode()}
            known = {key for key, _ in message.get("headers", ())}
            added = [(key, value) for key, value in headers.items() if key not in known]
            message = {**message, "headers": [*message.get("headers", ()), *added]}
        self.sent += len(message.get("body", b""))
        await self._send(message)

    async def answer(self, status: int, detail: str) -> None:
        body = json.dumps({"detail": detail, "error": "StorageError"}).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
        await self.send({"type": "http.response.start", "status": status, "headers": headers})
        await self.send({"type": "http.response.body", "body": body})


def _route(scope: Scope) -> str:
    """The path of a route, with names of parameters in place of their values."""
    found: Any = getattr(scope.get("route"), "path", None)
    return str(found) if found else "-"
