"""Images and stacks of frames in both of our formats: pixels in compressed chunks, and PNG."""

from __future__ import annotations

import functools
import itertools
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FrameStackObservation
from PIL import Image

from tools.bench.data import Array
from tools.bench.measure import Run, alternate, check, seconds_of
from tupli_mcap import RecordEpisodes, Recording
from tupli_mcap.messages.images.pictures import ImageFormat

__all__ = ["compare"]

_FORMS: tuple[ImageFormat, ...] = ("raw", "png")
_LENGTH = 200  # steps of an episode


class Showing(gym.Env[Any, Any]):
    """Shows pictures, one after the other."""

    def __init__(self, pictures: Array) -> None:
        self.observation_space = gym.spaces.Box(0, 255, pictures.shape[1:], np.uint8)
        self.action_space = gym.spaces.Discrete(2)
        self._next = itertools.cycle(pictures).__next__
        self._left = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self._left = _LENGTH
        return self._next(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._left -= 1
        return self._next(), 0.0, self._left == 0, False, {}


def compare(run: Run, screens: Path) -> list[dict[str, Any]]:
    """For each kind of pictures and each format: µs a step over the bare rollout, bytes a step, steps/s read."""
    return [row for title, make in _kinds(screens) for row in _measure(run, title, make)]


def _kinds(screens: Path) -> Iterator[tuple[str, Callable[[], gym.Env[Any, Any]]]]:
    colour = np.load(screens)
    grey = np.stack([np.asarray(Image.fromarray(screen).convert("L").resize((84, 84))) for screen in colour])
    yield "Breakout, 210 x 160 x 3", lambda: Showing(colour)
    yield "the last 4 of them", lambda: FrameStackObservation(Showing(colour), 4)
    yield "the last 4, 84 x 84, grey", lambda: FrameStackObservation(Showing(grey), 4)
    photographs = _photographs(len(colour))
    yield "a camera, 160 x 160 x 3, with noise", lambda: Showing(photographs)
    yield "the last 4 of these", lambda: FrameStackObservation(Showing(photographs), 4)


def _photographs(count: int) -> Array:
    """What a camera sees that moves along a smooth wall: shades, and the noise of its sensor (2 of 255)."""
    x, y = np.meshgrid(np.linspace(0, 4, 160), np.linspace(0, 4, 160))
    random = np.random.default_rng(5)
    found = np.empty((count, 160, 160, 3), np.uint8)
    for t, shift in enumerate(np.linspace(0, 20, count)):
        shades = np.stack([np.sin(x + shift), np.cos(y - shift), np.sin(x * y / 2 + shift)], axis=-1)
        found[t] = np.clip(128 + 90 * shades + random.normal(0, 2, shades.shape), 0, 255)
    return found


def _roll(env: Any, steps: int, states: list[Any] | None = None) -> None:
    state, _ = env.reset(seed=1)
    for _ in range(steps):
        if states is not None:
            states.append(state)
        state, _, terminal, _, _ = env.step(0)
        if terminal:
            state, _ = env.reset()


def _measure(run: Run, title: str, make: Callable[[], gym.Env[Any, Any]]) -> Iterator[dict[str, Any]]:
    steps = run.part(1000, 40)
    states: list[Any] = []
    _roll(make(), steps, states)
    paths = {form: run.fresh(f"{form}.mcap") for form in _FORMS}
    sides = {form: functools.partial(_record, make, path, form, steps) for form, path in paths.items()}
    recorded = alternate({"bare": lambda: seconds_of(lambda: _roll(make(), steps)), **sides}, run.rounds)
    wanted = np.array(states)
    readers = {
        f"{form} {threads}": functools.partial(_read, path, threads, wanted)
        for form, path in paths.items()
        for threads in (1, 2)
    }
    read = alternate(readers, run.rounds)
    bare = statistics.median(recorded["bare"])
    for form, path in paths.items():
        yield {
            "what": title,
            "form": form,
            "record": (statistics.median(recorded[form]) - bare) / steps * 1e6,
            "bytes": path.stat().st_size / steps,
            **{f"read{n}": steps / statistics.median(read[f"{form} {n}"]) for n in (1, 2)},
        }


def _record(make: Callable[[], gym.Env[Any, Any]], path: Path, form: ImageFormat, steps: int) -> float:
    """Seconds of a rollout, closing counted, opening not."""
    env = RecordEpisodes(make(), path, mode="w", image_format=form, attachments={})

    def whole() -> None:
        _roll(env, steps)
        env.close()

    return seconds_of(whole)


def _read(path: Path, threads: int, wanted: Array) -> float:
    """Seconds of opening and reading all states, which are checked afterwards."""
    found: list[Any] = []

    def whole() -> None:
        with Recording(path) as recording:
            found.append(recording.read(fields=["states"], threads=threads).states)

    seconds = seconds_of(whole)
    check(np.array_equal(found[0], wanted), f"{path}: other states")
    return seconds
