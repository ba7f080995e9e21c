"""A proxy between a client and a server on this machine, which counts bytes and breaks connections on request."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections import deque
from collections.abc import Iterator
from typing import NamedTuple
from urllib.parse import urlsplit

__all__ = ["Between", "Fault", "between"]


class Fault(NamedTuple):
    """What happens to a connection.

    kind: "pass"; "refuse": closes it at once; "reset": closes it after so many bytes of both directions;
    "stall": passes nothing on after them; "5xx": answers 503 to the first request; "flip": flips a bit of a file on
    its way to the client, after so many bytes of files, "flip up": to the server. (JSON over such a connection
    needs TLS.)
    """

    kind: str = "pass"
    after: int = 0


class _Passed:
    """The traffic of a connection so far: bytes, bytes of files, and whether a file is on its way."""

    total = of_files = 0
    is_file = False


_ON_ITS_WAY = 1 << 16  # bytes to a client, which a reset throws away although they are counted
_FILES = (b"PATCH ", b"GET /v1/files/", b"GET /v1/artifacts/")
_ANSWER, _END_OF_HEAD = b"HTTP/1.", b"\r\n\r\n"
_REQUESTS = (b"GET ", b"POST ", b"PUT ", b"PATCH ", b"DELETE ", b"HEAD ")


class Between:
    """Accepts connections on `url`. `faults`: of the next connections; `up`, `down`: bytes passed on from and to
    clients; `away`: it does not listen."""

    def __init__(self, target: str) -> None:
        parts = urlsplit(target)
        self._target = (parts.hostname, parts.port)
        self.faults: deque[Fault] = deque()
        self.up = self.down = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._open: set[socket.socket] = set()
        self._stalled = threading.Event()
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def go_away(self) -> None:
        """Refuses new connections, and ends the open ones."""
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.drop()

    def come_back(self) -> None:
        """Accepts connections again."""
        self._listener = socket.create_server(("127.0.0.1", self.port))
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def drop(self) -> None:
        """Ends all connections."""
        for each in list(self._open):
            _reset(each)

    def release(self) -> None:
        """Ends the connections that are stalled."""
        self._stalled.set()
        self._stalled = threading.Event()

    @property
    def listens(self) -> bool:
        """Whether connections are accepted."""
        return self._listener.fileno() >= 0

    def close(self) -> None:
        """Ends everything."""
        self.release()
        self.go_away()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                client, _ = listener.accept()
            except OSError:
                return
            client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _ON_ITS_WAY)
            fault = self.faults.popleft() if self.faults else Fault()
            threading.Thread(target=self._serve, args=(client, fault), daemon=True).start()

    def _serve(self, client: socket.socket, fault: Fault) -> None:
        if fault.kind == "refuse":
            _reset(client)
            return
        if fault.kind == "5xx":
            with contextlib.suppress(OSError):
                client.recv(1 << 16)
                client.sendall(
                    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 4\r\nConnection: close\r\n\r\nbusy"
                )
                client.shutdown(socket.SHUT_WR)
                while client.recv(1 << 16):
                    pass
            client.close()
            return
        try:
            server = socket.create_connection(self._target)
        except OSError:
            _reset(client)
            return
        for each in (client, server):  # else a message's second part waits until the first one is confirmed
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._open |= {client, server}
        passed = _Passed()
        threads = [
            threading.Thread(target=self._pass, args=(client, server, fault, passed, True), daemon=True),
            threading.Thread(target=self._pass, args=(server, client, fault, passed, False), daemon=True),
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for each in (client, server):
            self._open.discard(each)
            each.close()

    def _pass(
        self, source: socket.socket, goal: socket.socket, fault: Fault, passed: _Passed, up: bool
    ) -> None:
        flips = fault.kind == ("flip up" if up else "flip")
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                if fault.kind in ("reset", "stall") and passed.total + len(data) > fault.after:
                    goal.sendall(data[: max(0, fault.after - passed.total)])
                    if fault.kind == "stall":
                        self._stalled.wait()
                    _reset(source)
                    _reset(goal)
                    return
                is_head = data.startswith(_REQUESTS if up else _ANSWER)
                if up and is_head:
                    passed.is_file = data.startswith(_FILES)
                if flips and passed.is_file:
                    body = len(data) - len(data.partition(_END_OF_HEAD)[2]) if is_head else 0
                    data, flips = self._flipped(data, body, fault.after - passed.of_files)
                    passed.of_files += len(data) - body
                passed.total += len(data)
                goal.sendall(data)
                if up:
                    self.up += len(data)
                else:
                    self.down += len(data)
        with contextlib.suppress(OSError):
            goal.shutdown(socket.SHUT_WR)

    @staticmethod
    def _flipped(data: bytes, body: int, after: int) -> tuple[bytes, bool]:
        """The bytes with one bit of the body flipped, if it is among them; and whether it is still to come."""
        at = body + after
        if not body <= at < len(data):
            return data, True
        return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :], False


def _reset(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()


@contextlib.contextmanager
def between(target: str) -> Iterator[Between]:
    """A proxy within the block."""
    proxy = Between(target)
    try:
        yield proxy
    finally:
        proxy.close()
