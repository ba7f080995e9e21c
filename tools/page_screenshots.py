"""Takes the pictures of the page that `tupli-mcap browse` serves: real recordings, in a real Chromium.

    python tools/page_screenshots.py [--all DIR] [--recordings DIR]

Writes docs/page-*.png. --all also takes every page wide, narrow and dark, into DIR. --recordings keeps the recordings.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import httpx
import numpy as np
from gymnasium.envs.box2d.lunar_lander import heuristic
from PIL import Image
from playwright.sync_api import Browser, sync_playwright

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
import viewed
from browsing import CHROMIUM
from pages import browsing, carts

from tupli_mcap import RecordEpisodes

ROOT = Path(__file__).resolve().parent.parent
WIDE, NARROW = (1280, 860), (390, 780)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--all", type=Path, help="where pictures of all pages go")
    parser.add_argument("--recordings", type=Path, help="where the recordings are kept")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = options.recordings or Path(name) / "runs"
        if not root.exists():
            record(root)
        with browsing(root) as address, sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            take(chromium, address, options.all)


def record(root: Path) -> None:
    """Records runs like those of users."""
    root.mkdir(parents=True)
    carts(root, seeds=4, episodes=60)
    viewed.courier(root / "courier.mcap")
    viewed.atari(root / "breakout.mcap", episodes=3)
    lander(root / "lander.mcap")
    renders("MountainCarContinuous-v0", root / "car.mcap", lambda state: np.sign(state[1:]) * 0.9)
    renders("Pendulum-v1", root / "pendulum.mcap", lambda state: np.clip(-6 * state[1:2] - state[2:], -2, 2))


def lander(path: Path, episodes: int = 3) -> None:
    """Landings by Gymnasium's own controller, with what the environment renders, and whether they succeeded."""
    names = ["x", "y", "speed x", "speed y", "angle", "turn rate", "left leg", "right leg"]
    env = gym.make("LunarLander-v3", continuous=True, render_mode="rgb_array")
    labels = {"state": names, "action": ["main engine", "side engines"]}
    told = {"name": "heuristic", "metadata": {"algo": "heuristic"}, "tags": ["baseline"], "labels": labels}
    with RecordEpisodes(env, path, frames=True, capture="versions", **told) as recorder:
        for seed in range(1, episodes + 1):
            state, _ = recorder.reset(seed=seed)
            done = False
            while not done:
                state, _, terminated, truncated, _ = recorder.step(heuristic(env.unwrapped, state))
                done = terminated or truncated
    with viewed_recording(path) as recording:
        for episode in recording:
            episode.annotate(success=episode.return_ > 200)


def viewed_recording(path: Path) -> Any:
    """The recording, open."""
    from tupli_mcap import Recording

    return Recording(path)


def renders(name: str, path: Path, policy: Any, episodes: int = 2) -> None:
    """Episodes of an environment with what it renders."""
    with RecordEpisodes(
        gym.make(name, render_mode="rgb_array"), path, frames=True, frame_format="jpeg"
    ) as env:
        viewed.rollout(env, lambda state: np.asarray(policy(state), np.float32), episodes)


def take(chromium: Browser, address: str, everything: Path | None) -> None:
    """The pictures of the documentation, and those of all pages."""
    pages = dict(places(address))
    for title in ("datasets", "dataset", "episode"):
        dark = title == "episode"
        shoot(
            chromium,
            address + pages[title],
            ROOT / "docs" / f"page-{title}.png",
            WIDE,
            dark=dark,
            whole=False,
        )
    if everything is not None:
        everything.mkdir(parents=True, exist_ok=True)
        for title, place in pages.items():
            for form, size, dark in (("wide", WIDE, False), ("narrow", NARROW, False), ("dark", WIDE, True)):
                shoot(
                    chromium, address + place, everything / f"{title}-{form}.png", size, dark=dark, whole=True
                )


def places(address: str) -> Iterator[tuple[str, str]]:
    """A page of each kind."""

    def listed(query: str) -> list[str]:
        return [e["id"] for e in httpx.get(f"{address}/episodes?{query}&format=json").json()["episodes"]]

    land, ride = listed("dataset=LunarLander-v3&sort=-return"), listed("dataset=CartPole-v1&sort=-return")
    yield "datasets", "/"
    yield "dataset", "/dataset/LunarLander-v3?show=best"
    yield "carts", "/dataset/CartPole-v1?show=best"
    yield "courier", next(f"/episode/{uri}" for uri in listed('filter=recording=="courier.mcap"'))
    yield "breakout", "/dataset/ALE/Breakout-v5"
    yield "episodes", "/episodes?dataset=CartPole-v1&sort=-return"
    yield "wrong", "/episodes?filter=steps+%3E+100+and+retrun+%3E+3"
    yield "episode", f"/episode/{land[0]}?step=120"
    yield "compare", f"/compare?{'&'.join(f'episode={uri}' for uri in ride[::12])}"
    yield "landings", f"/compare?{'&'.join(f'episode={uri}' for uri in land)}"
    yield "nothing", "/?q=hopper"


def shoot(
    chromium: Browser, address: str, path: Path, size: tuple[int, int], *, dark: bool, whole: bool
) -> None:
    """One picture."""
    scheme: Any = "dark" if dark else "light"
    page = chromium.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
    page.goto(address)
    page.wait_for_load_state("networkidle")
    page.screenshot(path=path, full_page=whole)
    small = Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE)
    small.save(path, optimize=True)
    page.close()
    print(path)


if __name__ == "__main__":
    main()
