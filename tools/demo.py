"""The demo: record two real rollouts, look at the dataset, replay the best episode.

Run it with `tools/demo`, which installs what it needs first.
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import tempfile
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control import MountainCarEnv
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from viewing import HeadlessViewer, NoViewerError

from tupli_mcap import F, FileStorage, TupliDataset, TupliEnvWrapper, viewer
from tupli_mcap.schema import EpisodeMetadataCallback, RLTuple
from tupli_mcap.vector import RecordEpisodes

ROOT = Path(__file__).resolve().parent.parent / "demo"
console = Console()


class WindyMountainCar(MountainCarEnv):
    """MountainCar with a head wind that follows a sine over time."""

    def __init__(self, strength: float = 0.0005) -> None:
        super().__init__()
        self.strength = strength
        self.time = 0

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return super().reset(seed=seed, options=options)

    def step(self, action):
        _, reward, terminated, truncated, _ = super().step(action)
        wind = self.strength * (1 + np.sin(self.time / 50))
        self.time += 1
        self.state = (self.state[0], float(np.clip(self.state[1] - wind, -self.max_speed, self.max_speed)))
        return np.array(self.state, dtype=np.float32), reward, terminated, truncated, {"wind": wind}


class Height(EpisodeMetadataCallback):
    """The highest position of an episode, and its return."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.highest = -np.inf
        self.total = 0.0

    def __call__(self, tuple: RLTuple) -> dict:
        self.highest = max(self.highest, float(tuple.state[0]))
        self.total += float(tuple.reward)
        return {"highest": self.highest, "cum_eps_reward": self.total}


def energy_pumping(state: np.ndarray) -> int:
    """Push the way the car is going: the simplest policy that climbs."""
    return 2 if state[1] > 0 else 0


def record_mountain_car(storage: FileStorage, episodes: int) -> str:
    windy = gym.wrappers.TimeLimit(WindyMountainCar(), max_episode_steps=400)
    with TupliEnvWrapper(windy, storage=storage, metadata_callback=Height()) as env:
        benchmark = env.store(name="windy mountain car", description="MountainCar slowed down by wind")
        env.action_space.seed(1)
        for episode in range(episodes):
            state, _ = env.reset(seed=episode)
            done = False
            while not done:
                action = energy_pumping(state) if episode % 2 else env.action_space.sample()
                state, _, terminated, truncated, _ = env.step(action)
                done = terminated or truncated
    return benchmark


def record_cart_poles(path: Path, steps: int) -> None:
    with RecordEpisodes(gym.make_vec("CartPole-v1", num_envs=8), path) as envs:
        envs.reset(seed=1)
        envs.action_space.seed(1)
        for _ in range(steps):
            envs.step(envs.action_space.sample())


def show(title: str, dataset: TupliDataset) -> None:
    table = Table(title=title, title_justify="left")
    for column in ("episode", "steps", "return", "end", "metadata"):
        table.add_column(column, justify="right" if column in ("steps", "return") else "left")
    headers = dataset.preview()
    for header in headers[:8]:
        facts = ", ".join(f"{key} {value:.3g}" for key, value in header.metadata.items())
        table.add_row(
            str(header.episode), str(header.n_tuples), f"{header.episode_return:g}", header.end, facts
        )
    if len(headers) > 8:
        table.add_row("…", "", "", "", f"{len(headers) - 8} more")
    console.print(table)


def replay(lab: Path, *, window: bool) -> None:
    """The best episode in the viewer; without a display, a file for it and a picture of what it shows."""
    command = f".venv/bin/tupli-mcap view {lab.relative_to(ROOT.parent)} --episodes best"
    if window:
        try:
            viewer.show(lab, "best")
            print(f"The viewer shows the best episode; again: {command}")
            return
        except viewer.ViewerError as err:
            print(f"No window: {str(err).partition(';')[0]}.")
    replay = viewer.save(lab, ROOT / "best.rrd", "best")
    print("A replay of the best episode is in demo/best.rrd; open it with: .venv/bin/rerun demo/best.rrd")
    print(f"  in a window: {command}\n  in a browser: {command} --web")
    if window and (picture := draw(replay)):
        print(f"  what it looks like: {picture.relative_to(ROOT.parent)}")


def draw(replay: Path) -> Path | None:
    """A picture of a replay, where this machine can draw without a display."""
    picture = replay.with_suffix(".png")
    with (
        contextlib.suppress(NoViewerError, TimeoutError, ConnectionError),
        tempfile.TemporaryDirectory() as folder,
    ):
        window = HeadlessViewer(Path(folder), (1280, 860))
        with window:
            window.portrait(replay, picture, 60)
    return picture if picture.exists() else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer steps")
    quick = parser.parse_args().quick
    shutil.rmtree(ROOT, ignore_errors=True)
    storage = FileStorage(ROOT / "lab")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        benchmark = record_mountain_car(storage, 4 if quick else 20)
    cart_poles = ROOT / "cartpole-vector.mcap"
    record_cart_poles(cart_poles, 200 if quick else 2000)

    lab = TupliDataset(storage)
    show(f"Windy MountainCar, benchmark {benchmark[:12]}…", lab)
    climbed = lab.with_episode_filter(F("metadata.highest") > 0)
    console.print(f"{len(climbed.preview())} of {len(lab.preview())} episodes got above 0 in position.\n")
    show("CartPole, 8 environments in one file", TupliDataset.from_files(cart_poles))

    print("\nTo look at them:")
    recording = next(iter(sorted((ROOT / "lab").rglob("*.mcap"))))
    for path in (recording, cart_poles):
        print(f"  .venv/bin/tupli-mcap info {path.relative_to(ROOT.parent)}")
    print("  .venv/bin/tupli-mcap episodes demo/lab --filter 'metadata.highest > 0'")
    print("They are ordinary MCAP files: Rerun, Foxglove and ROS tools open them too.\n")
    replay(ROOT / "lab", window=not quick)


if __name__ == "__main__":
    main()
