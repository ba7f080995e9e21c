"""Parses `live=`: which viewer, and where it listens."""

from __future__ import annotations

import re
from typing import NamedTuple

from tupli_mcap.errors import RecordingError
from tupli_mcap.viewer.process import LOCAL, answers

RERUN_PORT, FOXGLOVE_PORT = 9876, 8765
_URL = re.compile(
    r"(?P<scheme>[a-z+]+)://(?P<host>\[[0-9a-fA-F:.]+\]|[^/:\[\]@?#\s]+)(:(?P<port>\d{1,5}))?(?P<path>/\S*)?"
)
_RERUN, _FOXGLOVE = ("rerun", "rerun+http", "rerun+https"), ("foxglove", "ws")


class Target(NamedTuple):
    """A viewer's kind ("rerun" or "foxglove"), host and port; `url` to connect to, empty where we start the viewer."""

    kind: str
    host: str
    port: int
    url: str = ""

    def answers(self) -> bool:
        return answers(self.host.strip("[]"), self.port)


def parse_target(text: str) -> Target:
    """The viewer that `live=` names. RecordingError if it names none."""
    if text == "rerun":
        return Target("rerun", LOCAL, RERUN_PORT)
    if text == "foxglove":
        return Target("foxglove", LOCAL, FOXGLOVE_PORT)
    url = _URL.fullmatch(text) if isinstance(text, str) else None
    port = int(url["port"] or 0) if url else 0
    if url and port < 1 << 16:
        scheme, host, path = url["scheme"], url["host"], url["path"] or ""
        if scheme in _RERUN and path in ("", "/", "/proxy"):
            port = port or RERUN_PORT
            return Target("rerun", host, port, f"{scheme}://{host}:{port}/proxy")
        if scheme in _FOXGLOVE and path in ("", "/"):
            return Target("foxglove", host, port if url["port"] else FOXGLOVE_PORT)
    raise RecordingError(
        "live: expected 'rerun', 'foxglove', 'rerun+http://host:port/proxy' or 'foxglove://host:port', "
        f"found {text!r:.200}"
    )
