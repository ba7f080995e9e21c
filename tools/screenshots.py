"""Takes the pictures of README and site: real recordings, replayed in the real viewer, without a screen.

Run it with `.venv/bin/python tools/screenshots.py` after `tools/setup-viewer`; it writes docs/replay-*.png and the
animation docs/replay.webp.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
from gymnasium.envs.box2d.lunar_lander import heuristic
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import viewed
from viewing import HeadlessViewer

from tupli_mcap import RecordEpisodes, viewer

ROOT = Path(__file__).resolve().parent.parent
_PICTURES: dict[
    str, tuple[Callable[[Path], Path], viewer.Form, int]
] = {  # ..., the step on which time stands
    "cartpole": (viewed.cart_pole, "compare", 60),
    "breakout": (viewed.atari, "joined", 180),
    "courier": (viewed.courier, "joined", 60),
}
_BAR = 36  # rows of pixels: the viewer's own bar
_EVERY, _FRAME, _LAST = 4, 60, 1500  # steps of a frame; milliseconds of a frame, and of the last one


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    docs = ROOT / "docs"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with HeadlessViewer(folder, (1280, 860)) as window:
            for title, (record, form, step) in _PICTURES.items():
                replay = viewer.save(record(folder / f"{title}.mcap"), folder / f"{title}.rrd", form=form)
                window.portrait(replay, docs / f"replay-{title}.png", step)
                _tell(docs / f"replay-{title}.png", window)
        with HeadlessViewer(folder, (1100, 680)) as window:
            replay = viewer.save(_land(folder / "lander.mcap"), folder / "lander.rrd")
            _film(window, replay, docs / "replay.webp", 370)
            _tell(docs / "replay.webp", window)


def _land(path: Path) -> Path:
    """Two landings by Gymnasium's own controller, with what the environment renders."""
    state = ["x", "y", "speed x", "speed y", "angle", "turn rate", "left leg", "right leg"]
    env = gym.make("LunarLander-v3", continuous=True, render_mode="rgb_array")
    labels = {"state": state, "action": ["main engine", "side engines"]}
    with RecordEpisodes(env, path, frames=True, labels=labels, capture="versions") as recorder:
        for seed in (1, 2):
            seen, _ = recorder.reset(seed=seed)
            done = False
            while not done:
                seen, _, terminated, truncated, _ = recorder.step(heuristic(env.unwrapped, seen))
                done = terminated or truncated
    return path


def _film(window: HeadlessViewer, replay: Path, goal: Path, steps: int) -> None:
    """Moves the time cursor through the steps, and films the viewer."""
    window.portrait(replay, goal.with_suffix(".png"), 0)  # waits until its notes are gone
    goal.with_suffix(".png").unlink()
    pictures = []
    for step in range(0, steps, _EVERY):
        window.seek("step", step)
        window.screenshot()  # the one before it may still show the step before
        pictures.append(Image.fromarray(window.screenshot()[_BAR:]))
    times = [_FRAME] * (len(pictures) - 1) + [_LAST]
    pictures[0].save(
        goal, save_all=True, append_images=pictures[1:], duration=times, loop=0, quality=70, method=6
    )


def _tell(path: Path, window: HeadlessViewer) -> None:
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} KiB {window.problems() or ''}")


if __name__ == "__main__":
    main()
