"""Measures what recording costs a learner, and how fast arrays are written.

    python tools/bench_writing.py [--rounds 16]

1. PPO of stable-baselines3 learns 25,000 steps, as in its own first example, with and without `VecRecordEpisodes`, in
   turns, in this process: CPU time. Must reach: at most 3 % more (the median of the rounds). PyTorch has one thread:
   others wait for it in loops, and would count its time twice.
2. `write_rollout` beside `numpy.save` of the same arrays, in turns: wall-clock time. Must reach: half of its speed.
   "The least" is what no valid recording can go without: the messages of the steps, with the checksums of their chunk
   and of the file; it has no index, no episodes and no journal.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from tupli_mcap import write_rollout
from tupli_mcap.mcap.records import BODY, crc32
from tupli_mcap.sb3 import VecRecordEpisodes

ENVS, STEPS, LEARNED = 8, 256, 25_000
CHUNK = 256 << 10  # bytes, as a recording has them


def learn(path: Path | None) -> None:
    """Learns `LEARNED` steps."""
    env: Any = DummyVecEnv([lambda: gym.make("CartPole-v1")] * ENVS)
    if path is not None:
        env = VecRecordEpisodes(env, path, mode="w")
    PPO("MlpPolicy", env, n_steps=STEPS, seed=0, device="cpu").learn(LEARNED)
    env.close()


def rollout(width: int, steps: int) -> dict[str, Any]:
    """Arrays of floats that do not compress."""
    rng = np.random.default_rng(0)
    wide = rng.random((steps, width), np.float32)
    return {"states": wide, "actions": wide[:, :6].copy(), "rewards": rng.random(steps)}


def save(path: Path, arrays: dict[str, Any]) -> None:
    for name, array in arrays.items():
        np.save(path.with_suffix(f".{name}.npy"), array)


def least(path: Path, arrays: dict[str, Any]) -> None:
    """Writes the arrays as messages, with two checksums."""
    flags = {name: np.zeros(len(arrays["rewards"]), np.bool_) for name in ("terminals", "timeouts")}
    fields = [(name, array.dtype, array.shape[1:]) for name, array in {**arrays, **flags}.items()]
    message = np.dtype([("head", f"V{BODY + 8}"), *fields])
    together = max(1, CHUNK // message.itemsize)
    rows: Any = np.zeros(together, message)
    in_file = 0
    with path.open("wb", buffering=0) as file:
        for first in range(0, len(arrays["rewards"]), together):
            given = {name: array[first : first + together] for name, array in arrays.items()}
            part = rows[: len(given["rewards"])]
            for name, values in given.items():
                part[name] = values
            data = part.view(np.uint8).data
            crc32(data)  # of the chunk
            in_file = crc32(data, in_file)
            file.write(data)


def in_turns(rounds: int, clock: Callable[[], float], *work: Callable[[], object]) -> tuple[list[float], ...]:
    """The times (s) of each piece of work."""
    times: tuple[list[float], ...] = tuple([] for _ in work)
    for number in range(rounds + 1):
        for took, each in zip(times, work, strict=True):
            begun = clock()
            each()
            if number:  # the first round warms up
                took.append(clock() - begun)
    return times


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=16)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    good = True
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        bare, recorded = in_turns(rounds, time.process_time, lambda: learn(None), lambda: learn(path))
        more = statistics.median(recorded) / statistics.median(bare) - 1
        print(f"PPO with recording: {more:+.1%} (must reach: at most +3%), {bare[0]:.2f} s without")
        good &= more <= 0.03
        for width, steps in ((17, 500_000), (1_000, 20_000), (30_000, 600)):
            arrays = rollout(width, steps)
            for compression in ("zstd", "none"):
                saving, bounding, writing = in_turns(
                    rounds,
                    time.perf_counter,
                    lambda arrays=arrays: save(path, arrays),
                    lambda arrays=arrays: least(path, arrays),
                    lambda arrays=arrays, kind=compression: write_rollout(
                        path, **arrays, mode="w", compression=kind
                    ),
                )
                ratio, most = (
                    statistics.median(saving) / statistics.median(took) for took in (writing, bounding)
                )
                size = sum(array.nbytes for array in arrays.values()) / 1e6
                print(
                    f"write_rollout, {width} floats a step, {compression}: {ratio:.2f} of numpy.save "
                    f"(must reach: 0.5; the least: {most:.2f}), {size:.0f} MB in {statistics.median(writing):.2f} s"
                )
                good &= ratio >= 0.5
    sys.exit(not good)


if __name__ == "__main__":
    main()
