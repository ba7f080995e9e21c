"""A page in a real Chromium with software rendering: takes a picture as soon as the page shows something in colour."""

from __future__ import annotations

import contextlib
import io
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
from PIL import Image
from playwright.sync_api import Locator, Page, sync_playwright

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = (
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
FILLED = (
    0.02  # of the pixels are coloured where curves are shown; on the viewer's welcome page, less than 0.01
)
_TOP = 40  # rows of pixels of the viewer's own bar, whose signs are coloured


class Seen(NamedTuple):
    """A picture of a page: height x width x 3 bytes, and the errors of its scripts."""

    picture: np.ndarray
    complaints: list[str]

    @property
    def ink(self) -> float:
        """The share of coloured pixels below the viewer's bar."""
        return ink(self.picture)


@contextlib.contextmanager
def served(recording: Path, *options: str) -> Iterator[tuple[str, set[str]]]:
    """Runs `tupli-mcap view --web`; yields the URL that it prints, and the addresses that it listens on."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in the background of a shell
        signal.signal(signal.SIGINT, signal.default_int_handler)
    command = [
        sys.executable,
        "-c",
        "from tupli_mcap.cli import main; main()",
        "view",
        str(recording),
        *options,
        "--web",
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stderr is not None
    try:
        url = process.stdout.readline().strip()
        if not url.startswith("http://127.0.0.1:"):
            raise RuntimeError(f"expected a URL, found {url!r}: {process.stderr.read()[-2000:]}")
        told = psutil.Process(process.pid)
        sockets = [
            sock for one in (told, *told.children(recursive=True)) for sock in one.net_connections("tcp")
        ]
        yield url, {sock.laddr.ip for sock in sockets if sock.status == psutil.CONN_LISTEN}
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=20)


def browse(url: str, seconds: float = 150.0, size: tuple[int, int] = (1000, 700)) -> Seen:
    """Opens a page and waits until two pictures in a row are equal and coloured, or the time is over.

    The page can reach this machine only.
    """
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", *FLAGS])
        page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        page.add_init_script("console.debug = console.log = () => {}")  # thousands of lines on shaders
        page.route(lambda target: not target.startswith("http://127.0.0.1:"), lambda route: route.abort())
        complaints: list[str] = []
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(url)
        picture = _settled(page, time.monotonic() + seconds)
        chromium.close()
    return Seen(picture, complaints)


def _settled(page: Page, end: float) -> np.ndarray:
    picture = picture_of(page)
    while time.monotonic() < end:
        page.wait_for_timeout(300)
        before, picture = picture, picture_of(page)
        if min(ink(picture), ink(before)) > FILLED and np.abs(picture - before).mean() < 2:
            break
    return picture


def picture_of(page: Page | Locator) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def ink(picture: np.ndarray) -> float:
    """The share of coloured pixels below the viewer's bar."""
    below = picture[_TOP:]
    return float((below.max(axis=2) - below.min(axis=2) > 60).mean())


def save(seen: Seen, path: Path) -> None:
    """Write the picture as a PNG."""
    Image.fromarray(seen.picture.astype(np.uint8)).save(path)
