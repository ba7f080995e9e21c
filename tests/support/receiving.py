"""A Rerun receiver without a window, which keeps what it is sent."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
from viewing import VIEWER
from waiting import wait_for


def answers(port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 0.2):
        return True
    return False


@contextlib.contextmanager
def receiver(port: int, out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's own receiver, without a window: what it is sent goes to a file."""
    command = [str(VIEWER), "--bind", "127.0.0.1", "--port", str(port), "--save", str(out)]
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        wait_for(lambda: answers(port))
        yield process
        # a recorder waits only some seconds for who shows it; a receiver that was killed waits for nobody
        wait_for(lambda: process.poll() is not None or not is_shown_at(port))
        before, quiet = None, 0
        # something is on its way, or the receiver is at work with it, or waits for a processor to be
        while quiet < 3:
            now = (out.stat().st_size, used(process.pid)) if out.exists() else None
            quiet = 0 if has_unread(port) or is_at_work(process.pid) or now != before else quiet + 1
            before = now
            time.sleep(0.5)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGINT)
        process.wait(120)


def is_shown_at(port: int) -> bool:
    """Whether a process still shows a rollout in the viewer at a port."""
    address = str(port).encode()
    for place in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (place / "cmdline").read_bytes().split(b"\0")
            if b"tupli_mcap.viewer.live" in words and any(address in word for word in words):
                return True
    return False


def url(port: int) -> str:
    return f"rerun+http://127.0.0.1:{port}/proxy"


def used(pid: int) -> float:
    """The processor time of a process and its children, in seconds; 0 if it is gone."""
    try:
        process = psutil.Process(pid)
        every = [one.cpu_times() for one in (process, *process.children(recursive=True))]
    except psutil.NoSuchProcess:
        return 0.0
    return sum(times.user + times.system for times in every)


def is_at_work(pid: int) -> bool:
    """Whether a thread of a process runs, or waits for a processor or the disk."""
    for place in Path(f"/proc/{pid}/task").glob("*/stat"):
        with contextlib.suppress(OSError):
            if place.read_text().rpartition(")")[2].split()[0] in "RD":
                return True
    return False


def has_unread(port: int) -> bool:
    """Whether something lies at a port that its process has not read, such as the end of a connection."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, local, _, state, queues, *_ = line.split()
        if int(local.partition(":")[2], 16) == port and (
            state == "08" or (state == "01" and int(queues.partition(":")[2], 16))
        ):
            return True
    return False
