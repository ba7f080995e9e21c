"""Sends a rollout to a Rerun viewer over gRPC. A viewer that is closed or slow gets nothing until it is back."""

from __future__ import annotations

import subprocess
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tupli_mcap.viewer.live.follow import Follower
from tupli_mcap.viewer.live.rerun_panels import LivePanels
from tupli_mcap.viewer.live.target import Target
from tupli_mcap.viewer.process import has_display, start, viewer_program
from tupli_mcap.viewer.sdk import import_quickly, rerun_sdk

_TRY_AGAIN = 1.0  # seconds between two looks for a viewer that is not there
_PATIENCE = 0.5  # seconds for a viewer to take what it was sent
_FAREWELL = 20.0  # the same for the rest, when the rollout is over: the recorder does not wait so long
_STARTING = 20.0  # seconds for a viewer that we have started to answer
_SILENCE = 3.0  # seconds after which what listens and has taken nothing is no viewer


class RerunView:
    """Connects to a Rerun viewer, or starts one and connects to it. ViewerError if there is no viewer program to start.

    title: the name of the rollout. warn: called once if no viewer answers, or if one is gone.
    """

    def __init__(self, target: Target, title: str, warn: Callable[[str], None]) -> None:
        import_quickly()
        self._sdk = rerun_sdk()
        self._target = target
        self._title = self._first_title = title
        self._panels = LivePanels(title)
        self._warn: Callable[[str], None] | None = warn
        self._identity = uuid.uuid4().hex
        self._url = target.url or f"rerun+http://{target.host}:{target.port}/proxy"
        self._stream: Any = None
        self._is_behind = False
        self._connected = 0.0
        self._has_taken = False  # steps, of this stream
        self._next_try = 0.0
        self._answers = False
        self._viewer: subprocess.Popen[bytes] | None = None
        self._expected = time.monotonic()  # until then, a viewer that does not answer may still be starting
        if not target.url and not target.answers():
            self._start_viewer()

    def _start_viewer(self) -> None:
        if not has_display():
            self._say(
                f"there is no display to start a Rerun viewer on; start one that listens at {self._url}, or record "
                "without live="
            )
            return
        self._viewer = start(viewer_program(), "--port", str(self._target.port), log=subprocess.DEVNULL)
        self._expected = time.monotonic() + _STARTING

    def show(self, follower: Follower) -> bool:
        if self._stream is None and not self._is_there():
            return False
        if not self._panels.decide(follower):
            return True
        if self._stream is None:
            self._connect()
        patience = _FAREWELL if follower.is_over else _PATIENCE
        if self._is_behind and not self._caught_up(patience):
            return True
        self._panels.send(self._stream, follower)
        self._has_taken |= self._caught_up(patience)
        return True

    def go_on(self, path: Path) -> None:
        """Begins another recording in the viewer: rows, episodes and steps count from 0 again."""
        self._part()
        self._identity = uuid.uuid4().hex
        self._title = f"{self._first_title} ({path.stem})"
        self._panels = LivePanels(self._title)

    def _is_there(self) -> bool:
        """True if a viewer answers. Without one, the SDK would buffer all data, and wait for a viewer at the end."""
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

    def _connect(self) -> None:
        panels = self._panels
        self._stream = self._sdk.RecordingStream(panels.application, recording_id=self._identity)
        self._stream.connect_grpc(self._url, default_blueprint=panels.blueprint)
        self._stream.send_recording_name(self._title)
        panels.declare(self._stream)
        self._is_behind = True
        self._connected, self._has_taken = time.monotonic(), False

    def _caught_up(self, patience: float) -> bool:
        """True if the viewer has taken everything. Until then, nothing more is sent to it."""
        try:
            self._stream.flush(timeout_sec=patience)
        except RuntimeError as err:
            self._is_behind = True
            if "timed out" not in str(err) or not self._target.answers():
                self._lose()
            elif not self._has_taken and time.monotonic() > self._connected + _SILENCE:
                self._say(
                    f"what listens at {self._url} takes nothing, as if it were no Rerun viewer; name another port "
                    "with live=, or end it"
                )
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

    def _part(self) -> None:
        """Disconnects once the viewer has everything: what `flush` has sent may still wait for the viewer to read."""
        stream, self._stream = self._stream, None
        if stream is not None and not self._is_behind:
            parting = threading.Thread(target=stream.disconnect, daemon=True)  # has no limit of its own
            parting.start()
            parting.join(_FAREWELL)

    def close(self) -> None:
        self._part()
        if self._viewer is not None and self._viewer.poll() is None:
            self._viewer.returncode = 0  # it stays open; Popen is not to warn of it
