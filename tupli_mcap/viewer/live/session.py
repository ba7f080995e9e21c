"""Starting the process that shows a rollout, and telling it of the files.

It is started as a program, not forked (this process may have threads) and not by `multiprocessing` (which would run the
caller's script again). What becomes of it is no matter to the recording.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import warnings

from tupli_mcap.errors import missing_extra
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.viewer.live.target import parse_target

__all__ = ["LiveSession", "open_session"]

_FAREWELL = 10.0  # seconds that closing waits for the process, at most


class LiveSession:
    """The process that shows what is recorded, until `close`."""

    def __init__(self, process: subprocess.Popen[bytes], writer: RecordingWriter) -> None:
        self.process = process
        self.go_on(writer)

    def go_on(self, writer: RecordingWriter) -> None:
        """After the rest of the files before, what `writer` records is shown."""
        file = os.path.realpath(writer.path), writer.uuid, writer.container.position
        with contextlib.suppress(OSError):  # it has ended
            if self.process.stdin is not None:
                self.process.stdin.write(json.dumps(file).encode() + b"\n")
                self.process.stdin.flush()

    def close(self) -> None:
        """The rest is shown, and the process ends; it goes on alone if that takes longer than some seconds."""
        with contextlib.suppress(OSError):
            if self.process.stdin is not None:
                self.process.stdin.close()
        try:
            self.process.wait(_FAREWELL)
        except subprocess.TimeoutExpired:
            self.process.returncode = 0  # which is no leak to warn of


def open_session(writer: RecordingWriter, live: str, title: str) -> LiveSession | None:
    """Begins to show what `writer` records; None, and a warning, where no process can be had.

    Args:
        live: "rerun", "foxglove", or where a viewer listens.
        title: what the rollout is called.

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
            start_new_session=True,  # a Ctrl-C is for the recorder
        )
    except OSError as err:
        warnings.warn(
            f"live={live!r} cannot show the rollout ({err}); it is recorded all the same", stacklevel=4
        )
        return None
    return LiveSession(process, writer)
