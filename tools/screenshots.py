"""Takes the README's pictures: real recordings, replayed in the real viewer, without a screen.

Run it with `.venv/bin/python tools/screenshots.py` after `tools/setup-viewer`; it writes docs/replay-*.png.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import viewed
from viewing import HeadlessViewer

from tupli_mcap import viewer

ROOT = Path(__file__).resolve().parent.parent
_BAR = 36  # rows of pixels: the viewer's own bar, which warns of this machine's graphics
_FADED = 6.0  # seconds after which the viewer's notes on loading are gone
_COLORS = 192
_PICTURES: dict[
    str, tuple[Callable[[Path], Path], viewer.Form, int]
] = {  # ..., the step on which time stands
    "cartpole": (viewed.cart_pole, "compare", 60),
    "breakout": (viewed.atari, "joined", 180),
    "courier": (viewed.courier, "joined", 60),
}


def main() -> None:
    docs = ROOT / "docs"
    docs.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with HeadlessViewer(folder, (1280, 860)) as window:
            for title, (record, form, step) in _PICTURES.items():
                replay = viewer.save(record(folder / f"{title}.mcap"), folder / f"{title}.rrd", form=form)
                window.show(replay)
                window.seek("step", step)
                time.sleep(_FADED)
                shot = Image.fromarray(window.screenshot()[_BAR:])
                path = docs / f"replay-{title}.png"
                shot.quantize(_COLORS, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
                    path, optimize=True
                )
                print(
                    f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} KiB {window.problems() or ''}"
                )


if __name__ == "__main__":
    main()
