"""The log of a server: a line for each request and each failure, as JSON unless stderr is a terminal.

Of a request, only its route is written, so that no token, password, ticket or name gets into the log. Error messages
may hold text from a stranger: control characters and line breaks in them are escaped.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import MutableMapping
from typing import Any, Final

import structlog

LOG: Final = logging.getLogger("tupli_mcap.server")
"""The logger. Fields in `extra` become fields of the line."""

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
                structlog.processors.format_exc_info,
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


def _harmless(_logger: object, _method: str, event: MutableMapping[str, Any]) -> dict[str, Any]:
    """Leaves out secrets, and escapes control characters, except line breaks of a traceback."""
    return {key: _shown(value) if isinstance(value, str) else value for key, value in event.items()}


def _shown(text: str) -> str:
    known = _SECRET.sub(lambda found: f"{found[1] or ''}…", text)
    return _CONTROL.sub(lambda found: repr(found[0])[1:-1], known)
