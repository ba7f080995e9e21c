"""Connections whose clients keep the server waiting are ended: who never finishes the head of a request, stops in the
middle of a body, or does not take the answer; and those whose heads do not end."""

from __future__ import annotations

import asyncio
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

__all__ = ["PatientProtocol"]

_EVERY: Final = 4  # looks, while a client may be silent
_MOST_HEAD: Final = 128 << 10  # bytes; a piece of the body may have come with it


class PatientProtocol(HttpToolsProtocol):
    """A connection of uvicorn that is ended `head_seconds` after a request began and its head is not there, or when its
    client has neither sent what it has announced nor taken what it has asked for, in `stall_seconds`."""

    def __init__(self, *args: Any, head_seconds: float, stall_seconds: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.access_log = False  # whoever listens: its lines hold addresses with tickets
        self._patience = head_seconds, stall_seconds
        self._head_since: float | None = None  # a request has begun then, and its head is not there
        self._head_size = 0  # what has come of it
        self._moved = 0.0  # when the client has sent or taken something

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._head_since = self._moved = self.loop.time()
        self._look = self.loop.call_later(min(self._patience) / _EVERY, self._watch)

    def connection_lost(self, exc: Exception | None) -> None:
        self._look.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._moved = self.loop.time()
        if self._head_since is None and (self.cycle is None or self.cycle.response_complete):
            self._head_since, self._head_size = self._moved, 0
        super().data_received(data)
        if self._head_since is not None:
            self._head_size += len(data)
            if self._head_size > _MOST_HEAD:
                self.transport.abort()

    def on_headers_complete(self) -> None:
        self._head_since = None
        super().on_headers_complete()

    def pause_writing(self) -> None:
        self._moved = self.loop.time()
        super().pause_writing()

    def _watch(self) -> None:
        now, (head_seconds, stall_seconds) = self.loop.time(), self._patience
        busy = self.cycle is not None and not self.cycle.response_complete
        sending = busy and self.cycle.more_body and not self.flow.read_paused
        stalled = (sending or self.flow.write_paused) and now - self._moved > stall_seconds
        if stalled or (self._head_since is not None and now - self._head_since > head_seconds):
            self.transport.abort()
        else:
            self._look = self.loop.call_later(min(self._patience) / _EVERY, self._watch)
