"""The real Rerun viewer without a screen: opens files, says which views show data, takes pictures, and always ends."""

from __future__ import annotations

import contextlib
import io
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
import rerun_cli
from PIL import Image
from rerun.experimental import View, ViewerClient, ViewerState

T = TypeVar("T")

VIEWER = Path(rerun_cli.__file__).parent / "rerun"  # the program itself: its Python shim would orphan it
SIZE = (900, 640)
_ADDRESS = re.compile(r"gRPC connections on 127\.0\.0\.1:(\d+)")
_OPTIONS = ("--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen")
_SOME = 100  # pixels of data that make a view filled
_BAR = 36  # rows of pixels
_PATIENCE = 120.0  # seconds: the machine may be busy
_FADED = 6.0  # seconds after which the viewer's notes on loading are gone
_ENVIRONMENT = {"RUST_LOG": "info", "NO_COLOR": "1", "RERUN_APP_ONLY": "true", "DISPLAY": ""}


class NoViewerError(RuntimeError):
    """The viewer cannot run here; the message is its own output."""


class HeadlessViewer:
    """A viewer process on 127.0.0.1 that opens files one after another.

    Args:
        folder: where the process may leave its log and its settings.
        size: of the window, in pixels.
        piped: a file that it reads from its standard input, as `rerun - < FILE`.
    """

    def __init__(self, folder: Path, size: tuple[int, int] = SIZE, piped: Path | None = None) -> None:
        self._log = folder / "viewer.log"
        self._size = size
        home = {name: str(folder) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME")}
        words = ["--headless", "--window-size", f"{size[0]}x{size[1]}", *_OPTIONS, *(["-"] if piped else [])]
        with self._log.open("wb") as log, (piped or Path(os.devnull)).open("rb") as source:
            self._process = subprocess.Popen(
                [VIEWER, *words],
                stdout=log,
                stderr=subprocess.STDOUT,
                stdin=source,
                env=os.environ | home | _ENVIRONMENT,
                start_new_session=True,  # so that ending the group ends all it started
            )
        try:
            self.client = ViewerClient.connect(f"rerun+http://127.0.0.1:{self._port()}/proxy")
            self._seen = self._last_log()
        except (ConnectionError, TimeoutError) as err:  # it listens before it looks for a graphics adapter
            self.close()
            raise NoViewerError(f"the viewer did not start: {self._words()}") from err
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        return self._process.pid

    def _port(self) -> int:
        for _ in patiently(_PATIENCE):
            if found := _ADDRESS.search(self._words()):
                return int(found[1])
            if self._process.poll() is not None:
                break
        raise NoViewerError(f"the viewer did not start: {self._words()}")

    def _words(self) -> str:
        """The end of its output."""
        return self._log.read_text(encoding="utf-8", errors="replace")[-2000:]

    def show(self, *paths: Path) -> ViewerState:
        """Closes all files, opens these in order, and waits until they are drawn; the last one is in front."""
        if self._state().recordings:
            self.client.close("all")
        self._seen = self._last_log()
        self.client.open([str(path) for path in paths])
        try:
            return self.settled()
        except TimeoutError:  # a busy viewer may say that a file holds no recording before it has read it
            self.client.open([str(path) for path in paths])
            return self.settled()

    def settled(self) -> ViewerState:
        """The state once nothing loads any more and every view has been drawn at least once."""
        for _ in patiently(_PATIENCE):
            state = self._state()
            if state.recordings and not state.loading:
                break
        else:
            raise TimeoutError(f"the viewer is still loading: {state.loading or 'no recording appeared'}")
        if any(recording.timelines for recording in state.recordings):
            self._pause()
        self.screenshot()  # reports are those of the last time a view was drawn
        return self._state()

    def _state(self) -> ViewerState:
        return answer(self.client.get_state)

    def _pause(self) -> None:
        """Stops the time, else every picture waits for the next ones."""
        for _ in patiently(_PATIENCE):
            try:
                return answer(lambda: self.client.set_time(play_state="paused"))
            except ConnectionError as err:  # the recording in front is not the one that has some
                if "no timelines" not in str(err):
                    raise
        raise TimeoutError("the recording in front has no timelines")

    def seek(self, timeline: str, step: int) -> None:
        """Stop at a step of a sequence timeline."""
        answer(lambda: self.client.set_time(timeline, sequence=step, play_state="paused"))

    def filled(self, *names: str) -> dict[str, bool]:
        """The name of every view in sight (or of these), and whether it shows any data; not those behind a tab."""
        state = self._state()
        inks = {view.name: self.ink(view) for view in state.views if not names or view.name in names}
        return {name: ink > _SOME for name, ink in inks.items() if ink is not None}

    def problems(self) -> list[str]:
        """The errors of views and the viewer since the last `show`."""
        state = self._state()
        views = [
            f"{view.name}: {report.severity}: {report.summary} {report.details or ''}"
            for view in state.views
            for report in view.reports
        ]
        logs = [
            f"{entry.level} {entry.target}: {entry.message}"
            for entry in self.client.get_logs(self._seen)
            if entry.level in ("WARN", "ERROR") and not _of_the_machine(entry.message)
        ]
        return views + logs

    def _last_log(self) -> int | None:
        entries = self.client.get_logs()
        return entries[-1].sequence if entries else None

    def screenshot(self, view: View | None = None) -> np.ndarray:
        """A picture of the window, or of one of its views: height x width x 3 bytes."""
        png = answer(lambda: self.client.take_screenshot(None if view is None else view.view_id))
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def ink(self, view: View) -> int | None:
        """The number of a view's pixels that show data: bright ones of a text, coloured ones elsewhere.

        Grids are grey, and what stands in an empty text is dim.

        None where it is behind another tab.
        """
        try:
            pixels = self.screenshot(view).astype(int)
        except ConnectionError as err:
            if "NotFound" in str(err):
                return None
            raise
        brightest = pixels.max(axis=2)
        if view.view_class == "TextDocument":
            return int((brightest > 170).sum())
        return int((brightest - pixels.min(axis=2) > 60).sum())

    def portrait(self, replay: Path, goal: Path, step: int) -> None:
        """A picture of a replay at a step, as a PNG, without the viewer's own bar and its notes on this machine."""
        self.show(replay)
        self.seek("step", step)
        time.sleep(_FADED)
        picture = Image.fromarray(self.screenshot()[_BAR:])
        picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
            goal, optimize=True
        )

    def close(self) -> None:
        """Ends the viewer and all its processes."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGTERM)
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait(5)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _of_the_machine(message: str) -> bool:
    """Whether a message is about this machine's graphics, or about a picture that could not be taken."""
    return any(
        word in message.lower()
        for word in (
            "software rasterizer",
            "adapter",
            "not found for screenshot",
            "failed to render screenshot",
        )
    )


def answer(ask: Callable[[], T]) -> T:
    """What the viewer answers; asked again where it is too busy to do so in the 15 seconds that its client waits."""
    for _ in patiently(_PATIENCE):
        with contextlib.suppress(TimeoutError):
            return ask()
    return ask()


def patiently(seconds: float, pause: float = 0.05) -> Iterator[None]:
    """Yield again and again until the time is over."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        yield
        time.sleep(pause)
