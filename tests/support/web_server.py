"""A web server of files in memory, which serves ranges as configured, and keeps a list of the requests."""

from __future__ import annotations

import contextlib
import http.server
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

__all__ = ["Asked", "WebServer", "serving"]


class Asked(NamedTuple):
    """A request: its method, its range, its If-Match, how many bytes of a body it got, and its Authorization."""

    method: str
    range: str | None
    if_match: str | None
    sent: int
    authorization: str | None


class WebServer(http.server.ThreadingHTTPServer):
    """Serves `files`, by path. Its attributes configure the answers, and may change at any time."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {}
        self.tags: dict[str, str] = {}
        self.asked: list[Asked] = []
        self.ranges = self.conditions = True
        self.no_suffix = 0  # the status code of the answer to a suffix range, if that is refused
        self.lengths = self.heads = True  # whether it says how long files are, and answers HEAD
        self.beyond = 0  # how many bytes it sends after those of a range
        self.failures: list[int] = []  # status codes of the next answers
        self.reason = b"no"  # their body
        self.sign_in = ""  # the Authorization that every request must have, if any
        self.delay = 0.0  # seconds before each answer, and before its last byte

    def url(self, path: str = "/r.mcap") -> str:
        return f"http://127.0.0.1:{self.server_port}{path}"

    @property
    def sent(self) -> int:
        return sum(each.sent for each in self.asked)


class _Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # else the last byte waits until the others are confirmed
    server: WebServer

    def log_message(self, *_: Any) -> None:
        pass

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        self.send_error(self.server.failures.pop(0) if self.server.failures else 501)

    def do_GET(self) -> None:
        server, path, asked = self.server, self.path.partition("?")[0], self.headers.get("Range")
        time.sleep(server.delay)
        data = server.files.get(path)
        tag = server.tags.get(path, '"first"')
        status, body, headers = (
            200,
            data or b"",
            {"ETag": tag, "Last-Modified": "Mon, 23 Nov 2026 00:00:00 GMT"},
        )
        unless = self.headers.get("If-None-Match"), self.headers.get("If-Modified-Since")
        wanted = re.fullmatch(r"bytes=(\d*)-(\d*)", asked or "") if server.ranges else None
        match = self.headers.get("If-Match")
        if server.failures:
            status, body = server.failures.pop(0), server.reason
        elif server.sign_in not in ("", self.headers.get("Authorization")):
            status, body = 401, b"no"
        elif self.command == "HEAD" and not server.heads:
            status, body = 405, b""
        elif data is None:
            status, body = 404, b"no"
        elif server.conditions and match not in (None, tag):
            status, body = 412, b"no"
        elif server.conditions and (unless[0] == tag or unless == (None, headers["Last-Modified"])):
            status, body = 304, b""
        elif wanted and not wanted[1] and server.no_suffix:
            status, body = server.no_suffix, b"no"
        elif wanted:
            size = len(data)
            start = int(wanted[1]) if wanted[1] else max(0, size - int(wanted[2]))
            stop = min(size, int(wanted[2]) + 1) if wanted[1] and wanted[2] else size
            status, body = (206, data[start:stop]) if start < stop else (416, b"")
            headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}" if body else f"bytes */{size}"
            body += bytes(server.beyond)
        head = self.command == "HEAD"
        sent = 0 if head else len(body)
        server.asked.append(Asked(self.command, asked, match, sent, self.headers.get("Authorization")))
        self.send_response(status)
        for name, value in headers.items():
            if name == "ETag" and not value:
                continue
            self.send_header(name, value)
        if server.lengths:
            self.send_header("Content-Length", str(len(body)))
        else:
            self.close_connection = True
        self.end_headers()
        if not head:
            with contextlib.suppress(ConnectionError):  # the client wants no more
                self.wfile.write(body[:-1])
                time.sleep(server.delay)
                self.wfile.write(body[-1:])


@contextmanager
def serving() -> Iterator[WebServer]:
    """A server within the block."""
    with WebServer() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
