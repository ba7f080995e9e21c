"""Ends connections whose clients keep the server waiting: those that do not finish the head of a request, stop in the
middle of a body, or do not read the answer; and those with endless heads."""

from __future__ import annotations

import asyncio
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

_EVERY: Final = 4  # looks, while a client may be silent
_MOST_HEAD: Final = 128 << 10  # bytes; a piece of the body may have come with it


class PatientProtocol(HttpToolsProtocol):
    """A connection of uvicorn. It is ended if the head of a request takes longer than `head_seconds`, or if the client
    has neither sent nor read anything for `stall_seconds` while it should."""

    def __init__(self, *args: Any, head_seconds: float, stall_seconds: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.access_log = False  # because its lines hold addresses with tickets
        self._patience = head_seconds, stall_seconds
        self._head_since: float | None = None  # when a request began whose head is not complete
        self._head_size = 0  # bytes of it that have arrived
        self._moved = 0.0  # when the client last sent or read something

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
