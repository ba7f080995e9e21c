"""Finds the viewer's program, which comes with rerun-sdk; starts its process on 127.0.0.1, waits for it, ends it."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from tupli_mcap.viewer.sdk import ViewerError, rerun_sdk, version_of

LOCAL = "127.0.0.1"
_PATIENCE = 30.0  # seconds for a viewer to start
_ANSWER = 0.25  # seconds for one that listens to answer


def viewer_program() -> Path:
    """The program `rerun`: that of the installed rerun-sdk, else one of the same version on the PATH. ViewerError if
    there is none."""
    sdk = rerun_sdk().__version__
    again = f"install it with pip install --force-reinstall rerun-sdk=={sdk}"
    spec = importlib.util.find_spec("rerun_cli")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        program = Path(folder) / "rerun"
        if program.is_file():
            return program
    on_path = shutil.which("rerun")
    if on_path is None:
        raise ViewerError(f"there is no viewer: expected the program 'rerun' of rerun-sdk {sdk}; {again}")
    version = run_quietly(Path(on_path), "--version")
    if version_of(version) != version_of(sdk):
        raise ViewerError(
            f"expected the viewer {on_path} to be of version {sdk}, as rerun-sdk is, found {version.strip()[:80]!r}; "
            f"{again}"
        )
    return Path(on_path)


def run_quietly(program: Path, *arguments: str) -> str:
    """Runs a program; returns what it prints. ViewerError if it cannot be run, or fails."""
    try:
        done = subprocess.run(
            [program, *arguments], capture_output=True, text=True, errors="replace", check=False, timeout=600
        )
    except (OSError, subprocess.TimeoutExpired) as err:
        raise ViewerError(f"the viewer {program} cannot be run: {err}") from err
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
        raise ViewerError(f"{program.name} {' '.join(arguments[:2])} failed: {last[:200]}")
    return done.stdout


def has_display() -> bool:
    """Whether a window can be opened."""
    if sys.platform == "darwin":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def free_port() -> int:
    """A free port of 127.0.0.1."""
    with socket.socket() as found:
        found.bind((LOCAL, 0))
        return int(found.getsockname()[1])


def answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), _ANSWER).close()
    except OSError:
        return False
    return True


def start(program: Path, *arguments: str, log: IO[bytes] | int) -> subprocess.Popen[bytes]:
    """Starts the viewer in a session of its own, so that Ctrl-C reaches this process only. ViewerError if it cannot be
    run."""
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


def _wait_for(process: subprocess.Popen[bytes], ports: list[int], log: Path) -> None:
    """Returns once the viewer listens. ViewerError, which quotes its last output, if it ends before that, or takes
    longer than half a minute."""
    until = time.monotonic() + _PATIENCE
    left = list(ports)
    while left and time.monotonic() < until and process.poll() is None:
        if answers(LOCAL, left[0]):
            left.pop(0)
        else:
            time.sleep(0.02)
    if left:
        words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        last = next((line for line in reversed(words) if "rror" in line), words[-1] if words else "nothing")
        raise ViewerError(
            f"the viewer did not start; its last output is {last.strip()[-200:]!r}; "
            "write a file with --save, or look in a browser with --web"
        )


@contextlib.contextmanager
def started(program: Path, ports: list[int], *arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    """The viewer's process, which listens at these ports; it is ended if the block fails. ViewerError if it does not
    start."""
    with tempfile.TemporaryDirectory(prefix="tupli-mcap-") as folder:
        path = Path(folder) / "log"
        with path.open("wb") as log:
            process = start(program, *arguments, log=log)
        try:
            _wait_for(process, ports, path)
            yield process
        except BaseException:
            end(process)
            raise


@contextlib.contextmanager
def web_viewer(program: Path, *arguments: str) -> Iterator[tuple[subprocess.Popen[bytes], int, int]]:
    """The web viewer within the block: its process, the port that takes data, the port of its page. ViewerError if it
    does not start."""
    data, page = free_port(), free_port()
    ports = ["--serve-web", "--port", str(data), "--web-viewer-port", str(page)]
    with started(program, [data, page], *ports, *arguments) as process:
        yield process, data, page
        end(process)


def end(process: subprocess.Popen[bytes]) -> None:
    """Ends the viewer and all processes that it started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(3)
            return
