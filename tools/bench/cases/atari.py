"""Recording Atari's screens beside the emulator's own step."""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.measure import Run, alternate, check, ratio, seconds_of
from tools.bench.targets import Target, at_most
from tools.bench.workloads import SEED


def overhead(run: Run) -> Iterator[Target]:
    """Breakout with screens of 210 x 160 x 3 as observations: closing the recording is counted.

    Opening it is not, as making the environment is not: both build an emulator, which takes 0.1 s, once.
    """
    what = "record Atari's screens, overhead over the emulator's step"
    try:
        import ale_py
    except ImportError:
        yield at_most(what, 0.15, None, "ale-py is not installed")
        return
    from tupli_mcap import RecordEpisodes, Recording

    gym.register_envs(ale_py)
    steps = run.part(3000, 300)
    actions = np.random.default_rng(SEED).integers(0, 4, steps).tolist()

    def rollout(env: Any) -> None:
        env.reset(seed=SEED)
        for action in actions:
            _, _, terminal, timeout, _ = env.step(action)
            if terminal or timeout:
                env.reset()

    def bare() -> float:
        env = gym.Wrapper(gym.make("ALE/Breakout-v5"))
        seconds = seconds_of(lambda: rollout(env))
        env.close()
        return seconds / steps * 1e6

    def recorded() -> float:
        path = run.fresh("breakout.mcap")
        env = RecordEpisodes(gym.make("ALE/Breakout-v5"), path)

        def work() -> None:
            rollout(env)
            env.close()

        seconds = seconds_of(work)
        with Recording(path) as recording:
            check(recording.num_steps == steps, f"{recording.num_steps} steps")
            check(np.array_equal(recording.read(fields=["actions"]).actions, actions), "other actions")
        path.unlink()
        return seconds / steps * 1e6

    sides = {"bare": bare, "recorded": recorded}
    alternate(sides, 1)
    values = alternate(sides, max(run.rounds, 3))
    middle = {name: statistics.median(found) for name, found in values.items()}
    note = f"{middle['bare']:.0f} µs a step bare, {middle['recorded']:.0f} recorded"
    yield at_most(what, 0.15, ratio(values["recorded"], values["bare"]) - 1, note)
