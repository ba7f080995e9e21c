"""The log of a server: a line for each request and each failure, as JSON unless stderr is a terminal.

Of a request, only its route, its user and the client's address are written, so that no token, password, ticket or
other name gets into the log. Of a failure, the log says where it happened and of which types its errors are, but not
their texts, which may quote the whole request. Other texts are cut, and may still be a stranger's: control characters
and line breaks in them are escaped.
"""

from __future__ import annotations

import logging
import re
import sys
import traceback
from collections.abc import Iterator, MutableMapping
from typing import Any, Final

import structlog

LOG: Final = logging.getLogger("tupli_mcap.server")
"""The logger. Fields in `extra` become fields of the line."""

_MOST_TEXT: Final = 20_000  # characters of a field
_MOST_CAUSES: Final = 5
_MOST_FRAMES: Final = 30  # of a cause: the innermost
_SECRET: Final = re.compile(
    r"(?i)((?:ticket|token|password|secret|signature|credential|authorization|bearer)\w*[\"']?(?:\s*[=:]\s*|\s+)[\"']?)"
    r"[^\s\"'&,;}]{6,}|(?<=://)[^/\s@]+:[^/\s@]+(?=@)"
)
_CONTROL: Final = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def set_up() -> None:
    """Sends what the server and its libraries log to the standard error stream."""
    reading = sys.stderr.isatty()
    shown: Any = structlog.dev.ConsoleRenderer() if reading else structlog.processors.JSONRenderer()
    handler = logging.StreamHandler()
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[
                structlog.contextvars.merge_contextvars,
                structlog.stdlib.add_log_level,
                structlog.stdlib.add_logger_name,
                structlog.stdlib.ExtraAdder(),
                structlog.processors.TimeStamper(fmt="iso", utc=True),
                _traced,
                _harmless,
            ],
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, shown],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    LOG.setLevel(logging.WARNING if reading else logging.INFO)
    logging.captureWarnings(True)


def _traced(_logger: object, _method: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Puts the trace of a failure in place of its exception."""
    info = event.pop("exc_info", None)
    if isinstance(info, tuple) and info[1] is not None:
        event["exception"] = "\n".join(_trace(info[1], _MOST_CAUSES))
    return event


def _trace(err: BaseException, causes: int) -> Iterator[str]:
    """The files, lines and functions through which an error came, and its type; before it those of its cause."""
    cause = err.__cause__ or (None if err.__suppress_context__ else err.__context__)
    if cause is not None and causes > 1:
        yield from _trace(cause, causes - 1)
        yield "which led to:"
    for frame in traceback.extract_tb(err.__traceback__, -_MOST_FRAMES):
        yield f"  {frame.filename}:{frame.lineno}, in {frame.name}: {frame.line}"
    reason = f": {err.strerror}" if isinstance(err, OSError) and err.strerror else ""
    yield f"{type(err).__module__}.{type(err).__qualname__}{reason}"


def _harmless(_logger: object, _method: str, event: MutableMapping[str, Any]) -> dict[str, Any]:
    """Cuts texts, leaves out secrets, and escapes control characters, except line breaks of a trace."""
    return {key: _shown(value) if isinstance(value, str) else value for key, value in event.items()}


def _shown(text: str) -> str:
    known = _SECRET.sub(lambda found: f"{found[1] or ''}…", text[:_MOST_TEXT])
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], known)
