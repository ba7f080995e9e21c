"""The process that shows a rollout: follows the recording until the recorder has finished.

The recorder writes a line of JSON to its stdin for each file: path, UUID, and the offset at which this session begins.
It sends nothing else: when a recorder closes its file, or is killed, the file's lock is released. The process sleeps 50
times as long as it kept a core busy, and longer while no viewer is connected.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import sys
import time
from pathlib import Path
from typing import Protocol

from tupli_mcap.errors import TupliError
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.viewer.live.follow import Follower, follow
from tupli_mcap.viewer.live.target import Target, parse_target

_SHORTEST_REST = 1 / 20  # seconds between two looks
_IDLE_REST = 0.25  # the same while there is no viewer
_LONGEST_REST = 3.0
_REST = 50.0  # the process sleeps so many times as long as its last look kept a core busy
_PATIENCE = 60.0  # seconds for the recorder to name a file


class LiveView(Protocol):
    """A viewer, or a server that viewers connect to."""

    def show(self, follower: Follower) -> bool:
        """Shows what is new; may take a while. Returns False if there is no viewer to see it."""

    def go_on(self, path: Path) -> None:
        """Continues with another file of the same rollout."""

    def close(self) -> None:
        """Disconnects from the viewer, which stays open."""


class _Files:
    """The files that the recorder names on stdin, in their order."""

    def __init__(self) -> None:
        self._stdin = open(0, "rb", buffering=0)  # noqa: SIM115 - `select` does not see what a buffer holds
        self._is_open = True
        self._waiting: list[tuple[str, str, int]] = []

    def wait(self, seconds: float) -> None:
        """Sleeps; ends early if the recorder names a file, closes or dies."""
        if not self._is_open:
            time.sleep(seconds)
        elif select.select([self._stdin], [], [], seconds)[0]:
            line = self._stdin.readline()
            self._is_open = bool(line)
            if line:
                self._waiting.append(tuple(json.loads(line)))

    def next(self, seconds: float) -> tuple[str, str, int] | None:
        """The next file; None if the recorder does not name one in time."""
        if not self._waiting:
            self.wait(seconds)
        return self._waiting.pop(0) if self._waiting else None


def _run(view: LiveView, files: _Files) -> None:
    """Shows the files one after another, each until its recorder has finished it."""
    file = files.next(_PATIENCE)
    while file is not None:
        _show(view, files, *file)
        file = files.next(0)  # a recorder names the next file before it closes this one
        if file is not None:
            view.go_on(Path(file[0]))


def _show(view: LiveView, files: _Files, path: str, uuid: str, begin: int) -> None:
    follower: Follower | None = None
    rest, is_over = _SHORTEST_REST, False
    while not is_over:
        files.wait(rest)
        began = time.process_time()
        is_over = not is_locked(Path(path))  # read before the look, so that the last look sees everything
        if follower is None:
            follower = follow(Path(path), uuid, begin)
        seen = False
        if follower is not None:
            follower.is_over = is_over
            seen = view.show(follower)
        wanted = _REST * (time.process_time() - began)
        rest = min(max(_SHORTEST_REST if seen else _IDLE_REST, wanted), _LONGEST_REST)


def _view_of(target: Target, title: str) -> LiveView:
    if target.kind == "foxglove":
        from tupli_mcap.viewer.live.foxglove_view import FoxgloveView

        return FoxgloveView(target, title)
    from tupli_mcap.viewer.live.rerun_view import RerunView

    return RerunView(target, title, _say)


def _say(text: str) -> None:
    """Writes to stderr, which this process shares with the recorder."""
    with contextlib.suppress(OSError, ValueError):
        print(f"tupli-mcap: {text}", file=sys.stderr, flush=True)


def main() -> None:
    """Shows the rollout. An error is printed once, and does not disturb the recorder."""
    live, title = sys.argv[1:]
    try:
        view = _view_of(parse_target(live), title)
    except (OSError, RuntimeError, TupliError) as err:  # for example, the port is taken
        _say(f"live={live!r} cannot show the rollout ({err}); the recording goes on")
        return
    try:
        _run(view, _Files())
    except Exception as err:  # noqa: BLE001 - a bug of ours
        _say(f"the live view has ended ({type(err).__name__}: {err}); the recording goes on")
    with contextlib.suppress(Exception):
        view.close()
    os._exit(0)  # at a plain exit, the viewer's library would wait for a viewer that takes nothing


if __name__ == "__main__":
    main()
