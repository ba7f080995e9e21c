"""The log of a server: a line for each request and each failure, JSON unless somebody reads it in a terminal.

Nothing of a request is written but its route, so that no token, password, ticket or name gets there.
"""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import MutableMapping
from typing import Any, Final

import structlog

__all__ = ["LOG", "set_up"]

LOG: Final = logging.getLogger("tupli_mcap.server")
"""What is told with a message, in `extra`, gets into the line."""

_SECRET: Final = re.compile(
    r"(?i)((?:ticket|token|password|secret|signature|credential|authorization|bearer)\w*[\"']?(?:\s*[=:]\s*|\s+)[\"']?)"
    r"[^\s\"'&,;}]{6,}|(?<=://)[^/\s@]+:[^/\s@]+(?=@)"
)


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
                _without_secrets,
            ],
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, shown],
        )
    )
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    LOG.setLevel(logging.WARNING if reading else logging.INFO)
    logging.captureWarnings(True)


def _without_secrets(_logger: object, _method: str, event: MutableMapping[str, Any]) -> dict[str, Any]:
    return {
        key: _SECRET.sub(lambda found: f"{found[1] or ''}…", value) if isinstance(value, str) else value
        for key, value in event.items()
    }
