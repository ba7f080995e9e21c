"""Lets this environment's viewer draw a replay without a screen, and checks that it shows curves.

Uses little of rerun-sdk, so that it runs with old versions too.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from PIL import Image
from rerun.experimental import ViewerClient

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import viewed

from tupli_mcap import viewer
from tupli_mcap.viewer.process import free_port, viewer_program

_SECONDS = 60.0
_ENOUGH = 0.03  # of the window is in colour where curves are drawn


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        replay = viewer.save(viewed.courier(Path(folder) / "courier.mcap"), Path(folder) / "courier.rrd")
        port = free_port()
        options = ["--headless", "--bind", "127.0.0.1", "--port", str(port), "--window-size", "1000x700"]
        process = subprocess.Popen([viewer_program(), replay, *options], stderr=subprocess.DEVNULL)
        try:
            found = drawn(port, Path(folder) / "courier.png")
        finally:
            process.terminate()
            process.wait(20)
    print(f"drawn: {found:.1%} of the window is in colour")
    sys.exit(found < _ENOUGH)


def drawn(port: int, picture: Path) -> float:
    """The coloured part of the window; waits until it is large enough."""
    found, end = 0.0, time.monotonic() + _SECONDS
    while found < _ENOUGH and time.monotonic() < end:
        time.sleep(1.0)
        try:
            ViewerClient(f"rerun+http://127.0.0.1:{port}/proxy").save_screenshot(str(picture))
        except (ConnectionError, RuntimeError):  # it does not listen yet
            continue
        time.sleep(1.0)  # old versions answer before they have written it
        if picture.exists():
            pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
            found = float((pixels.max(axis=2) - pixels.min(axis=2) > 60).mean())
    return found


if __name__ == "__main__":
    main()
