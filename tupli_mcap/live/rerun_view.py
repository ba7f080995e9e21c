"""A Rerun viewer, over gRPC: one that is closed or slow is left alone until it is back."""

from __future__ import annotations

import os
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from tupli_mcap.live.follow import Follower
from tupli_mcap.live.target import Target

__all__ = ["Picture", "RerunView"]

_TRY_AGAIN = 1.0  # seconds between two looks for a viewer that is not there
_PATIENCE = 0.5  # seconds for a viewer to take what it was sent; then nothing more is sent until it has
_FAREWELL = 1.5  # the same for the rest, when the rollout is over
_STARTING = 20.0  # seconds for a viewer that we have started


class Picture(Protocol):
    """What of a rollout is sent to Rerun."""

    application: str
    blueprint: Any

    def declare(self, stream: Any) -> None:
        """Sends what does not change; again for every new connection."""
        ...

    def send(self, stream: Any, follower: Follower) -> None:
        """Sends what is new."""
        ...


class RerunView:
    """Connects to a Rerun viewer, or starts one and connects to it.

    Args:
        sketch: given a title, what makes the picture; None as long as too little is known for it.
        warn: told once, if there is no viewer or no longer one.

    Raises:
        MissingExtraError: the rerun-sdk that is installed is too old.
    """

    def __init__(
        self,
        target: Target,
        title: str,
        sketch: Callable[[str], Callable[[Follower], Picture | None]],
        warn: Callable[[str], None],
    ) -> None:
        from tupli_mcap.viewer.sdk import import_quickly, rerun_sdk

        import_quickly()
        self._sdk = rerun_sdk()
        self._target = target
        self._title = self._first_title = title
        self._sketch = sketch
        self._draw = sketch(title)
        self._warn: Callable[[str], None] | None = warn
        self._identity = uuid.uuid4().hex
        self._url = target.url or f"rerun+http://{target.host}:{target.port}/proxy"
        self._picture: Picture | None = None
        self._stream: Any = None
        self._is_behind = False
        self._next_try = 0.0
        self._answers = False
        self._viewer: subprocess.Popen[bytes] | None = None
        self._expected = time.monotonic()  # until when a missing viewer is no surprise
        if not target.url and not target.answers():
            self._start_viewer()

    def _start_viewer(self) -> None:
        if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            self._say(
                f"there is no display to start a Rerun viewer on; start one that listens at {self._url}, or record "
                "without live="
            )
            return
        command = [
            sys.executable,
            "-m",
            "rerun",
            "--bind",
            self._target.host,
            "--port",
            str(self._target.port),
        ]
        quiet = subprocess.DEVNULL
        self._viewer = subprocess.Popen(
            command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True
        )
        self._expected = time.monotonic() + _STARTING

    def show(self, follower: Follower) -> bool:
        if self._stream is None and not self._is_there():
            return False
        if self._picture is None:
            self._picture = self._draw(follower)
        if self._picture is None:
            return True
        if self._stream is None:
            self._connect(self._picture)
        patience = _FAREWELL if follower.is_over else _PATIENCE
        if self._is_behind and not self._caught_up(patience):
            return True
        self._picture.send(self._stream, follower)
        self._caught_up(patience)
        return True

    def go_on(self, path: Path) -> None:
        """Another recording in the viewer: rows, episodes and steps count from 0 again."""
        if self._stream is not None and not self._caught_up(_PATIENCE):
            self._lose()
        self._stream = self._picture = None
        self._identity = uuid.uuid4().hex
        self._title = f"{self._first_title} ({path.stem})"
        self._draw = self._sketch(self._title)

    def _is_there(self) -> bool:
        """True if a viewer answers: without one the SDK would keep what it is sent, and wait for it at the end."""
        now = time.monotonic()
        if now < self._next_try:
            return self._answers
        self._next_try = now + _TRY_AGAIN
        self._answers = self._target.answers()
        if self._viewer is not None and self._viewer.poll() is not None:  # it could not start, or was closed
            self._expected = 0.0
        if not self._answers and now > self._expected:
            self._say(f"no Rerun viewer answers at {self._url}; the rollout is shown once one does")
        return self._answers

    def _connect(self, picture: Picture) -> None:
        self._stream = self._sdk.RecordingStream(picture.application, recording_id=self._identity)
        self._stream.connect_grpc(self._url, default_blueprint=picture.blueprint)
        self._stream.send_recording_name(self._title)
        picture.declare(self._stream)
        self._is_behind = True

    def _caught_up(self, patience: float) -> bool:
        """True if the viewer has everything; what it cannot take yet is not added to."""
        try:
            self._stream.flush(timeout_sec=patience)
        except RuntimeError as err:
            self._is_behind = True
            if "timed out" not in str(err) or not self._target.answers():
                self._lose()
            return False
        self._is_behind = False
        return True

    def _lose(self) -> None:
        self._stream = None  # without a flush, which would wait for it
        self._next_try = 0.0
        self._say(f"the Rerun viewer at {self._url} is gone; the rollout is shown again once it is back")

    def _say(self, text: str) -> None:
        warn, self._warn = self._warn, None
        if warn is not None:
            warn(f"{text} (the recording goes on)")

    def close(self) -> None:
        self._stream = None
        if self._viewer is not None and self._viewer.poll() is None:
            self._viewer.returncode = 0  # it stays open, which is no leak to warn of
