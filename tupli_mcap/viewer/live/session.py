"""Starts the process that shows a rollout, and names the files to it.

It is started as a program: a fork would copy the locks of this process's threads, and `multiprocessing` would run the
caller's script again. If it fails, the recording goes on.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys

from tupli_mcap.errors import missing_extra, warn
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.viewer.live.target import parse_target

_FAREWELL = 10.0  # seconds that closing waits for the process, at most


class LiveSession:
    """The process that shows the recording, until `close`."""

    def __init__(self, process: subprocess.Popen[bytes], writer: RecordingWriter) -> None:
        self.process = process
        self.go_on(writer)

    def go_on(self, writer: RecordingWriter) -> None:
        """Shows the file of `writer` after the files before it."""
        file = os.path.realpath(writer.path), writer.place.uuid, writer.container.position
        with contextlib.suppress(OSError):  # the process has ended
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(file).encode() + b"\n")
                self.process.stdin.flush()

    def close(self) -> None:
        """Waits some seconds for the process to show the rest and end; a slower one goes on alone."""
        with contextlib.suppress(OSError):
            if self.process.stdin is not None:
                self.process.stdin.close()
        try:
            self.process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            self.process.returncode = 0  # it goes on; Popen is not to warn of it


def open_session(writer: RecordingWriter, live: str, title: str) -> LiveSession | None:
    """Starts to show the file of `writer`. Warns and returns None if no process can be started.

    Args:
        live: "rerun", "foxglove", or where a viewer listens.
        title: the name of the rollout.

    Raises:
        RecordingError: `live` names no viewer.
        MissingExtraError: the extra `rerun` or `foxglove` is not installed.
    """
    kind = parse_target(live).kind
    if importlib.util.find_spec(kind) is None:
        raise missing_extra(f"a live view in {kind.capitalize()} needs {kind}-sdk", kind)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        process = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", __package__, live, title],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # Ctrl-C reaches the recorder only
        )
    except OSError as err:
        warn(f"live={live!r} cannot show the rollout ({err}); the recording goes on")
        return None
    return LiveSession(process, writer)
