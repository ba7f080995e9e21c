"""The thread that shows a rollout: it looks at the recording's journal now and then, within a budget of time.

`step()` knows nothing of it, so the rollout loses only what this thread takes of the interpreter, and what the viewer's
library takes of the cores: both are measured, and the thread rests 40 times as long, and longer where nobody looks.
Whatever happens here, the rollout goes on; what went wrong is said once, as a warning.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
import warnings
import weakref
from typing import Protocol

from tupli_mcap.live.follow import Watcher
from tupli_mcap.live.target import parse_target
from tupli_mcap.recording.write.writer import RecordingWriter

__all__ = ["LiveSession", "LiveView", "open_session"]

_SHORTEST_REST = 1 / 20  # seconds between two looks
_IDLE_REST = 0.25  # the same where nobody looks
_LONGEST_REST, _LONGEST_VECTOR_REST = 1.0, 3.0  # there is more to show of several sub-environments
_REST = 40.0  # times as long as showing kept a core busy
_HANDOVER = 0.001  # seconds that the stepping thread waits beside, as the interpreter comes and goes
_FAREWELL = 3.0  # seconds that closing waits for the thread, at most


class LiveView(Protocol):
    """A viewer, or a server that viewers connect to. Only the session's thread calls `show` and `close`."""

    def show(self, watcher: Watcher) -> bool:
        """Shows what is new. May take a while; must return, and say False, where there is nobody to see it.

        Raises:
            Exception: whatever: the session is over then.
        """
        ...

    def go_on(self, writer: RecordingWriter) -> None:
        """The next watcher's steps go to another file of the same rollout."""
        ...

    def close(self) -> None:
        """Lets go of the viewer, which stays as it is."""
        ...


class _Meter:
    """Seconds of CPU time of this process without the thread that made the meter, which is the one that steps.

    The viewer's library works in threads of its own, which no clock tells from those of others: what else the process
    does while something is shown counts, too, and slows the view down rather than the rollout.
    """

    def __init__(self) -> None:
        self._clock: int | None = None
        if hasattr(time, "pthread_getcpuclockid"):  # not on macOS
            self._clock = time.pthread_getcpuclockid(threading.get_ident())

    def busy(self) -> float:
        if self._clock is None:
            return time.thread_time()
        try:
            return time.process_time() - time.clock_gettime(self._clock)
        except OSError:  # that thread is over
            return time.process_time()


class LiveSession:
    """Shows what `writer` records in `view`, from a thread of its own, until `close`."""

    def __init__(self, writer: RecordingWriter, view: LiveView) -> None:
        self._view = view
        self._watcher = Watcher(writer)
        self._next: list[Watcher] = []
        self._stopping = threading.Event()
        self._meter = _Meter()
        self._longest_rest = _LONGEST_VECTOR_REST if writer.is_vector else _LONGEST_REST
        self._thread: threading.Thread | None = threading.Thread(
            target=self._run, name="tupli-mcap-live", daemon=True
        )
        _sessions.add(self)
        self._thread.start()

    def _run(self) -> None:
        try:
            rest, last = _SHORTEST_REST, False
            while not last:
                last = self._stopping.wait(rest)  # what came in the meantime is shown before the end
                began = self._meter.busy()
                following, self._next = self._next, []  # before the look: what came until then is shown
                seen = self._show()
                for watcher in following:
                    self._watcher = watcher
                    self._view.go_on(watcher.writer)
                    seen = self._show()
                shortest = _SHORTEST_REST if seen else _IDLE_REST
                wanted = _REST * (self._meter.busy() - began + _HANDOVER)
                rest = min(max(shortest, wanted), self._longest_rest)
        except Exception as err:  # noqa: BLE001 - the rollout must not notice
            _warn(f"the live view has ended ({type(err).__name__}: {err}); the recording goes on")
        finally:
            with contextlib.suppress(Exception):
                self._view.close()

    def _show(self) -> bool:
        """False if nobody looks; before the first step, who does is not known."""
        return self._watcher.layout is None or self._view.show(self._watcher)

    def go_on(self, writer: RecordingWriter) -> None:
        """Shows the rest of the recording, then what `writer` records."""
        self._next = [*self._next, Watcher(writer)]

    def close(self) -> None:
        """Shows the rest and ends the thread. Waits for a viewer that does not take it for a few seconds at most."""
        self._stopping.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(_FAREWELL)

    def forget(self) -> None:
        """In a forked child, which has no such thread."""
        self._thread = None


_sessions: weakref.WeakSet[LiveSession] = weakref.WeakSet()


def _forget_all() -> None:
    for session in list(_sessions):
        session.forget()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_all)


def open_session(writer: RecordingWriter, live: str, title: str) -> LiveSession | None:
    """Begins to show what `writer` records; None, and a warning, where no viewer can be had.

    Args:
        live: "rerun", "foxglove", or where a viewer listens.
        title: what the rollout is called.

    Raises:
        RecordingError: `live` names no viewer.
        MissingExtraError: the extra `rerun` or `foxglove` is not installed.
    """
    target = parse_target(live)
    view: LiveView
    try:
        if target.kind == "rerun":
            from tupli_mcap.live.rerun_view import RerunView
            from tupli_mcap.viewer.live import Sketch

            view = RerunView(target, title, Sketch, _warn)
        else:
            from tupli_mcap.live.foxglove_view import FoxgloveView

            view = FoxgloveView(target, title, writer)
    except (OSError, RuntimeError) as err:  # the port is taken, say
        _warn(f"live={live!r} cannot show the rollout ({err}); it is recorded all the same")
        return None
    return LiveSession(writer, view)


def _warn(text: str) -> None:
    with contextlib.suppress(Warning):  # made an error by a filter: not in this thread
        warnings.warn(text, stacklevel=3)
