"""Lets this environment's own viewer draw a replay once, without a screen, and looks whether there is anything on it.

Needs no more of rerun-sdk than its program, so that it runs under old versions too.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import rerun_cli
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import viewed

from tupli_mcap import viewer


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        replay = viewer.save(viewed.courier(Path(folder) / "courier.mcap"), Path(folder) / "courier.rrd")
        picture = Path(folder) / "courier.png"
        program = Path(rerun_cli.__file__).parent / "rerun"
        options = ["--headless", "--bind", "127.0.0.1", "--port", "auto", "--window-size", "1000x700"]
        run = subprocess.run(
            [program, replay, *options, "--screenshot-to", picture],
            capture_output=True,
            text=True,
            timeout=120,
        )
        if not picture.exists():
            sys.exit(f"expected a picture, found exit code {run.returncode}: {run.stderr[-2000:]}")
        pixels = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    coloured = float((pixels.max(axis=2) - pixels.min(axis=2) > 60).mean())
    print(f"drawn: {coloured:.1%} of the window is in colour")
    if coloured < 0.01:
        sys.exit("expected curves in colour, found an empty window")


if __name__ == "__main__":
    main()
