"""Takes the README's pictures: real recordings, replayed in the real viewer, without a screen.

Run it with `.venv/bin/python tools/screenshots.py` after `tools/setup-viewer`; it writes docs/replay-*.png.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
import viewed
from viewing import HeadlessViewer

from tupli_mcap import viewer

ROOT = Path(__file__).resolve().parent.parent
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
                path = docs / f"replay-{title}.png"
                window.portrait(replay, path, step)
                print(
                    f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} KiB {window.problems() or ''}"
                )


if __name__ == "__main__":
    main()
