"""The viewer's process: started on 127.0.0.1, waited for, ended."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import IO

from tupli_mcap.viewer.sdk import ViewerError

__all__ = [
    "LOCAL",
    "end",
    "free_port",
    "has_display",
    "scratch",
    "start",
    "stopped_by_signals",
    "wait_for_ports",
]

LOCAL = "127.0.0.1"
_PATIENCE = 30.0  # seconds until a viewer that does not answer is given up


def has_display() -> bool:
    """Whether a window can be opened."""
    if sys.platform == "darwin":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def free_port() -> int:
    """A port of 127.0.0.1 that nobody listens on."""
    with socket.socket() as found:
        found.bind((LOCAL, 0))
        return int(found.getsockname()[1])


def start(program: Path, *arguments: str, log: IO[bytes]) -> subprocess.Popen[bytes]:
    """Starts the viewer in a session of its own, so that a Ctrl-C reaches this process only.

    Raises:
        ViewerError: it cannot be run.
    """
    environment = os.environ | {"RERUN_APP_ONLY": "true", "NO_COLOR": "1"}
    try:
        return subprocess.Popen(
            [program, "--bind", LOCAL, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env=environment,
        )
    except OSError as err:
        raise ViewerError(f"the viewer {program} cannot be run: {err.strerror or err}") from err


def wait_for_ports(process: subprocess.Popen[bytes], ports: list[int], log: Path) -> None:
    """Returns once the viewer listens.

    Raises:
        ViewerError: it ends before, or does not within half a minute; with its last words.
    """
    until = time.monotonic() + _PATIENCE
    left = list(ports)
    while left and time.monotonic() < until and process.poll() is None:
        with socket.socket() as probe:
            probe.settimeout(0.2)
            if probe.connect_ex((LOCAL, left[0])) == 0:
                left.pop(0)
                continue
        time.sleep(0.02)
    if left:
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = next((line for line in reversed(words) if "rror" in line), words[-1] if words else "nothing")
        raise ViewerError(
            f"the viewer did not start, its last words are {last.strip()[-200:]!r}; "
            "write a file with --save, or look in a browser with --web"
        )


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A directory for what the viewer reads and says."""
    with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
        yield Path(folder)


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """SIGTERM and SIGHUP raise KeyboardInterrupt within the block, as Ctrl-C does; only in the main thread."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGTERM, signal.SIGHUP)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends the viewer and whatever it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(3)
            return
