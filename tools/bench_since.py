#!/usr/bin/env python
"""Compares the cost of recording with an earlier commit: `python tools/bench_since.py COMMIT [--rounds 300]`.

Two processes, one per version, record the same environment, which does nothing, in turns of some milliseconds, so that
other load on the machine affects both alike. The time of the environment alone is subtracted.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array

ROOT = Path(__file__).resolve().parent.parent
SAME_STEP, NEXT_STEP = gym.vector.AutoresetMode.SAME_STEP, gym.vector.AutoresetMode.NEXT_STEP
# steps of an episode, sub-environments, and how they start the next one: how `n` reset, or whether one has a seed
KINDS: dict[str, tuple[int, int, Any]] = {
    "22 steps": (22, 1, False),
    "22 seeded steps": (22, 1, True),
    "1000 steps": (1000, 1, False),
    "64 x 22 steps": (22, 64, SAME_STEP),
    "64 x 22 next": (22, 64, NEXT_STEP),
    "64 x 1000 steps": (1000, 64, SAME_STEP),
}
TURN = 6400  # steps, those of all sub-environments together
WARM_UP = 10  # rounds that do not count


class Nothing(gym.Env[Any, Any]):
    """Episodes of `length` steps; the state never changes."""

    observation_space = spaces.Box(-5, 5, (4,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, length: int) -> None:
        self.length, self.state = length, np.zeros(4, np.float32)
        super().reset(seed=1)  # or every reset draws a seed, for all that the recorder knows

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.t = 0
        return self.state, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.t += 1
        return self.state, 1.0, self.t >= self.length, False, {}


class Nothings(gym.vector.VectorEnv[Any, Any, Any]):
    """`n` sub-environments of that kind, which all end and reset in the same step."""

    def __init__(self, length: int, n: int, mode: gym.vector.AutoresetMode) -> None:
        self.length, self.num_envs = length, n
        self.single_observation_space, self.single_action_space = (
            Nothing.observation_space,
            Nothing.action_space,
        )
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, n)
        self.action_space = gym.vector.utils.batch_space(self.single_action_space, n)
        self.metadata = {"autoreset_mode": mode}
        self.period = length + (mode == NEXT_STEP)  # a reset is a step, too
        self.states, self.rewards = np.zeros((n, 4), np.float32), np.ones(n)
        self.no, self.yes = np.zeros(n, np.bool_), np.ones(n, np.bool_)

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.t = 0
        return self.states, {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.t += 1
        if self.t % self.period != self.length % self.period:
            return self.states, self.rewards, self.no, self.no, {}
        infos = {} if self.period > self.length else {"final_obs": self.states}
        return self.states, self.rewards, self.yes, self.no, infos


def turn_of(length: int, n: int, how: Any, path: Path | None) -> Callable[[], None]:
    """A function that makes the steps of one turn, recorded to `path` or not."""
    import tupli_mcap
    import tupli_mcap.vector

    kwargs: Any = {"mode": "w", "attachments": {}}
    if n > 1:
        env: Any = Nothings(length, n, how)
        env = env if path is None else tupli_mcap.vector.RecordEpisodes(env, path, **kwargs)
        actions = np.ones(n, np.int64)
        env.reset(seed=1)

        def steps() -> None:
            for _ in range(TURN // n):
                env.step(actions)

        return steps
    env = Nothing(length)
    env = env if path is None else tupli_mcap.RecordEpisodes(env, path, **kwargs)
    action, seed = np.int64(1), 1 if how else None
    env.reset(seed=1)

    def step() -> None:
        for _ in range(TURN):
            if env.step(action)[2]:
                env.reset(seed=seed)

    return step


def work(kind: str, path: str) -> None:
    """One side: for every line on stdin, makes a turn and prints its seconds."""
    warnings.simplefilter("ignore")
    turn = turn_of(*KINDS[kind], Path(path) if path else None)
    for _ in sys.stdin:
        began = time.perf_counter()
        turn()
        print(time.perf_counter() - began, flush=True)
    os._exit(0)


def compare(kind: str, trees: list[Path], rounds: int, directory: Path) -> list[Array]:
    """Microseconds a step of each turn: the environment alone, and recorded by each tree."""
    sides = []
    for i, (tree, path) in enumerate([(ROOT, ""), *((tree, f"{k}.mcap") for k, tree in enumerate(trees))]):
        command = [sys.executable, __file__, "--work", kind, path and str(directory / path)]
        process = subprocess.Popen(
            command, stdin=-1, stdout=-1, text=True, env={**os.environ, "PYTHONPATH": str(tree)}
        )
        sides.append((i, process))
    times: list[list[float]] = [[] for _ in sides]
    for round_ in range(rounds + WARM_UP):
        first = round_ % len(sides)
        for i, process in sides[first:] + sides[:first]:
            print(file=process.stdin, flush=True)
            line = process.stdout.readline()  # type: ignore[union-attr]
            if not line:
                raise SystemExit(f"{kind}: a side stopped with code {process.wait()}")
            if round_ >= WARM_UP:
                times[i].append(float(line))
    for _, process in sides:
        process.stdin.close()  # type: ignore[union-attr]
        process.wait()
    return [np.array(side) / TURN * 1e6 for side in times]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit")
    parser.add_argument("--rounds", type=int, default=300)
    parser.add_argument("--only", choices=KINDS, action="append")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        before = Path(name) / "before"
        git = ["git", "-C", str(ROOT)]
        subprocess.run([*git, "worktree", "add", "-q", "--detach", str(before), options.commit], check=True)
        try:
            print(
                "microseconds a step, the environment taken off: lower quartile, median; growth of the median"
            )
            for kind in options.only or KINDS:
                alone, old, new = compare(kind, [before, ROOT], options.rounds, Path(name))
                old, new = old - alone, new - alone
                growth = np.median(new) / np.median(old) - 1
                low = [np.quantile(side, 0.25) for side in (old, new)]
                middle = [np.median(side) for side in (old, new)]
                print(
                    f"{kind:16} before {low[0]:.2f} {middle[0]:.2f}   now {low[1]:.2f} {middle[1]:.2f}   "
                    f"{growth:+.1%}",
                    flush=True,
                )
        finally:
            subprocess.run([*git, "worktree", "remove", "--force", str(before)], check=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(*sys.argv[2:])
    else:
        main()
