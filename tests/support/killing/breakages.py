"""Defects to put into the recorder; the check must find each, since a harness that cannot fail proves nothing."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from tupli_mcap.journal import logs
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.encode_rows import COMMIT
from tupli_mcap.messages.layout import SEQUENCE_OFFSET
from tupli_mcap.recording.write.rows import single as rows

__all__ = ["BREAKAGES"]


def _commit_before_the_data() -> None:
    begin = rows.SingleRows.__init__

    def init(self: Any, *args: Any, **kwargs: Any) -> None:
        begin(self, *args, **kwargs)
        buffer, offset, count = self._buffer, self._encoder.offset, self._encoder.count

        def hasty(put: Callable[..., None]) -> Callable[..., None]:
            def hastily(*step: Any) -> None:
                COMMIT.pack_into(buffer, offset() + SEQUENCE_OFFSET, count(), time.time_ns())
                put(*step)

            return hastily

        self.put = hasty(self.put)

    rows.SingleRows.__init__ = init  # type: ignore[method-assign]


def _forget_the_pending_state() -> None:
    def switch(self: Any) -> None:
        area, half = self._area, self._half
        self._half = 1 - half
        flushed, self._flushed = self._flushed, 0
        self._go_to(self._half)
        self._emit(half * area.half, flushed, area.rows)

    rows.SingleRows._switch = switch  # type: ignore[method-assign]


def _events_taken_off_first() -> None:
    def flush(self: Any, *, keep_last: bool = False) -> None:
        self._commit[0] = 0  # before they are in the file
        flushed(self, keep_last=keep_last)

    flushed = logs.EventLog.flush
    logs.EventLog.flush = flush  # type: ignore[method-assign]


def _chunks_late() -> None:
    """Every chunk is written only when later ones are due: halves are used again before they are in the file."""
    finish, kept = Container.finish_chunks, []

    def late(self: Any, packed: Any) -> None:
        kept.append((self, packed))
        if len(kept) > 3:
            finish(*kept.pop(0))

    Container.finish_chunks = late  # type: ignore[method-assign]


BREAKAGES: dict[str, Callable[[], None]] = {
    "commit before the data": _commit_before_the_data,
    "forget the pending state": _forget_the_pending_state,
    "events taken off first": _events_taken_off_first,
    "chunks late": _chunks_late,
}
