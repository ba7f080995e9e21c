"""Interrupts a recorder at one event, and once more while it handles that; then checks the files."""

from __future__ import annotations

import gc
import itertools
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

from tupli_mcap import RecordEpisodes, Recording, RecordingError, verify_recording
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.recording.write.rotation import series
from tupli_mcap.schema import EpisodeMetadataCallback
from tupli_mcap.vector import RecordEpisodes as RecordVector

LENGTH = 4
STEPS = 14


class Counting(gym.Env[Any, Any]):
    """Episodes of LENGTH steps. A state encodes its environment, episode and step, so no two are equal."""

    action_space = spaces.Discrete(3)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, kind: str = "box", first: int = 0) -> None:
        self.kind, self.number, self.render_mode = kind, first, "rgb_array"
        self.observation_space = {
            "box": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            "text": spaces.Text(20, min_length=0, charset="0123456789"),
            "image": spaces.Box(0, 255, (4, 4, 3), np.uint8),
        }[kind]

    def _state(self) -> Any:
        if self.kind == "text":
            return str(self.number)
        if self.kind == "box":
            return np.full(2, self.number, np.float32)
        return np.full(48, 0, np.uint8).reshape(4, 4, 3) + np.array(
            [self.number % 200, self.number // 200, 0], np.uint8
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.number += 100 - self.number % 100
        return self._state(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.number += 1
        return self._state(), 1.0, self.number % 100 == LENGTH, False, {"n": float(self.number)}

    def render(self) -> Any:
        return np.full((2, 2, 3), self.number % 100, np.uint8)


def number(state: Any) -> int:
    """Which state it is."""
    if isinstance(state, str):
        return int(state)
    flat = np.asarray(state).reshape(-1)
    return int(flat[0]) if flat.dtype == np.float32 else int(flat[0]) + 200 * int(flat[1])


class Count(EpisodeMetadataCallback):
    """Counts the steps of an episode."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.n = 0

    def __call__(self, tuple: Any) -> dict[str, Any]:
        self.n += 1
        return {"n": self.n}


def single(kind: str = "box", **options: Any) -> Callable[[Path], Any]:
    """Makes a recorder of one environment."""

    def make(path: Path) -> Any:
        callback = {"metadata_callback": Count()} if options.get("record_info") else {}
        return RecordEpisodes(Counting(kind), path, chunk_size=400, attachments={}, **options, **callback)

    return make


def vector(mode: str, kind: str = "box", **options: Any) -> Callable[[Path], Any]:
    """Makes a recorder of two sub-environments."""

    def make(path: Path) -> Any:
        envs = SyncVectorEnv(
            [lambda i=i: Counting(kind, 10_000 * i) for i in range(2)],  # type: ignore[misc]
            autoreset_mode=gym.vector.AutoresetMode[mode],  # unknown to Gymnasium 1.0
        )
        return RecordVector(envs, path, chunk_size=400, attachments={}, **options)

    return make


SCENARIOS: dict[str, tuple[str, Callable[[Path], Any]]] = {
    "plain": ("x", single()),
    "infos, metadata, frames": ("x", single(record_info=True, frames=2)),
    "text": ("x", single("text")),
    "image": ("x", single("image")),
    "flushed": ("x", single(flush_seconds=0)),
    "durable": ("x", single(durability="step")),
    "rotating": ("x", single(max_bytes=2500, record_info=True)),
    "append": ("a", single(mode="a")),
    "replace": ("w", single(mode="w")),
    "vector": ("x", vector("NEXT_STEP")),
    "vector, same step": ("x", vector("SAME_STEP")),
    "vector, infos": ("x", vector("NEXT_STEP", record_info=True)),
    "vector, text": ("x", vector("NEXT_STEP", "text")),
    "vector, rotating": ("x", vector("NEXT_STEP", max_bytes=2000)),
}


class Interruption:
    """Raises KeyboardInterrupt at the `at`-th call or line event of the package, and with `again` once more at the
    `again`-th call after that."""

    def __init__(self, at: int, again: int = 0) -> None:
        self.left, self.again = at, again

    @property
    def has_struck(self) -> bool:
        return self.left <= 0

    def __enter__(self) -> Interruption:
        sys.settrace(self._trace)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)
        sys.setprofile(None)

    def _trace(self, frame: Any, event: str, arg: Any) -> Any:
        if "tupli_mcap" not in frame.f_code.co_filename or frame.f_code.co_name == "__del__":
            return None
        self._count()
        return self._local

    def _local(self, frame: Any, event: str, arg: Any) -> Any:
        if event == "line":
            self._count()
        return self._local

    def _count(self) -> None:
        self.left -= 1
        if self.left == 0:
            if self.again:
                sys.setprofile(self._profile)  # Python switches a trace function off when it raises
            raise KeyboardInterrupt

    def _profile(self, frame: Any, event: str, arg: Any) -> None:
        if event in ("call", "c_call") and "tupli_mcap" in frame.f_code.co_filename:
            self.again -= 1
            if self.again == 0:
                raise KeyboardInterrupt


@dataclass
class Rollout:
    """A policy at a recorder: `seen` are the transitions whose step has returned."""

    make: Callable[[Path], Any]
    path: Path
    env: Any = None
    seen: list[tuple[int, int]] = field(default_factory=list)
    states: list[Any] = field(default_factory=list)

    def open(self) -> None:
        self.env = self.make(self.path)

    def run(self, steps: int) -> None:
        """Steps through episodes; flushes in the middle."""
        env = self.env
        if isinstance(env, RecordEpisodes):
            self.states = [number(env.reset()[0])]
        else:
            self.states = [number(s) for s in env.reset()[0]]
        over = [False] * len(self.states)
        for i in range(steps):
            if isinstance(env, RecordEpisodes):
                state, _, terminal, _, _ = env.step(1)
                self._note([number(state)], [terminal], [over[0]])
                if terminal:
                    self.states = [number(env.reset()[0])]
            else:
                states, _, terminals, _, infos = env.step(np.ones(2, np.int64))
                finals = infos.get("final_obs", [None, None])
                after = [number(f if f is not None else s) for f, s in zip(finals, states, strict=True)]
                self._note(after, terminals, over)
                self.states = [number(s) for s in states]
                over = [bool(t) and f is None for t, f in zip(terminals, finals, strict=True)]
            if i == steps // 2:
                env.flush()

    def _note(self, after: list[int], terminals: Any, over: list[bool]) -> None:
        self.seen += [
            pair for pair, skip in zip(zip(self.states, after, strict=True), over, strict=True) if not skip
        ]
        self.states = after

    def play(self) -> None:
        """Uses all methods of a recorder."""
        self.open()
        self.run(STEPS)
        self.env.close()


def files_of(path: Path) -> list[Path]:
    """The files of a rollout that exist."""
    base, later = series(path)
    return [file for file in (base, *later.values()) if file.exists()]


def transitions(files: list[Path]) -> Iterator[tuple[int, int]]:
    """The recorded transitions."""
    for file in files:
        with Recording(file) as recording:
            for episode in recording.episodes:
                states = [number(step.state) for step in episode] + [number(episode.final_state)]
                yield from itertools.pairwise(states)


def interrupted(name: str, directory: Path, at: int, again: int = 0, *, go_on: bool = False) -> bool:
    """Interrupts a scenario and checks the files; False if it ended before."""
    mode, make = SCENARIOS[name]
    path = directory / "r.mcap"
    before: list[tuple[int, int]] = []
    if mode != "x":
        _record_old(path)
        before = list(transitions([path]))
    rollout = Rollout(make, path)
    interruption = Interruption(at, again)
    try:
        with interruption:
            rollout.play()
    except KeyboardInterrupt:
        pass
    if rollout.env is not None:
        if go_on:
            try:
                rollout.run(6)
            except RecordingError as err:
                assert "broke off the recorder's work" in str(err) or "is closed" in str(err)  # noqa: PT017
        rollout.env.close()
    rollout.env = None
    gc.collect()
    left = {file.name for file in directory.iterdir()} - {file.name for file in files_of(path)}
    # a file under a name of its own, made while a recording was opened, may stay as after a kill
    assert not left or (again and all(name.startswith(".") and name.endswith(".tmp") for name in left)), left
    _check(mode, path, rollout.seen, before, slack=2 if name.startswith("vector") else 1)
    return interruption.has_struck


def _record_old(path: Path) -> None:
    with RecordEpisodes(Counting(first=5000), path, attachments={}) as env:
        env.reset()
        for _ in range(3):
            env.step(0)


def _check(
    mode: str, path: Path, seen: list[tuple[int, int]], before: list[tuple[int, int]], *, slack: int
) -> None:
    files = files_of(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = list(transitions(files))
        for file in files:
            with Recording(file) as recording:
                assert recording.complete or not recording.n_steps
            report = verify_recording(file)
            assert report.ok, (file.name, report.problems)
    if before:
        assert path.exists()
        if mode == "a":
            assert found[: len(before)] == before
            found = found[len(before) :]
        elif found == before:
            assert not seen
            found = []
    counts = Counter(found)
    assert max(counts.values(), default=1) == 1
    assert not Counter(seen) - counts, "an acknowledged step is missing"
    assert len(found) <= len(seen) + slack
    assert all(b == a + 1 for a, b in found), "steps are spliced"
    assert not any(is_locked(file) for file in files)
