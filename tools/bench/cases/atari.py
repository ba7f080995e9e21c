"""Recording Atari's screens beside the emulator's own step."""

from __future__ import annotations

import gc
import statistics
from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from tools.bench.measure import Run, Stopwatch, check, ratio
from tools.bench.targets import Target, at_most
from tools.bench.workloads import SEED

_TURN = 25  # steps: some 20 ms, in which a chunk of images becomes full


def overhead(run: Run) -> Iterator[Target]:
    """Breakout with screens of 210 x 160 x 3 as observations: what the first step makes and closing are counted.

    Opening the recording is not, as making the environment is not: both build an emulator, which takes 0.1 s, once.
    Two environments that are the same take turns of a few dozen steps: a machine may be twice as fast for a second.
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

    def once() -> dict[str, float]:
        path = run.fresh("breakout.mcap")
        bare = gym.Wrapper(gym.make("ALE/Breakout-v5"))
        recorded = RecordEpisodes(gym.make("ALE/Breakout-v5"), path)
        sides = {"bare": (bare, Stopwatch()), "recorded": (recorded, Stopwatch())}
        gc.collect()
        for number, begin in enumerate(range(0, steps, _TURN)):
            for env, watch in sorted(
                sides.values(), key=lambda side: side[0] is recorded, reverse=bool(number % 2)
            ):
                with watch:
                    _walk(env, actions[begin : begin + _TURN], first=begin == 0)
        with sides["recorded"][1]:
            recorded.close()
        bare.close()
        with Recording(path) as recording:
            check(recording.n_steps == steps, f"{recording.n_steps} steps")
            check(np.array_equal(recording.read(fields=["actions"]).actions, actions), "other actions")
        path.unlink()
        return {name: watch.seconds / steps * 1e6 for name, (_, watch) in sides.items()}

    once()
    found = [once() for _ in range(3 if run.quick else 2 * run.rounds)]
    values = {name: [times[name] for times in found] for name in ("bare", "recorded")}
    middle = {name: statistics.median(times) for name, times in values.items()}
    spread = sorted(times["recorded"] / times["bare"] - 1 for times in found)
    note = f"{middle['bare']:.0f} µs a step bare, {middle['recorded']:.0f} recorded"
    note += f"; between rollouts {spread[0]:.2f} to {spread[-1]:.2f}"
    yield at_most(what, 0.15, ratio(values["recorded"], values["bare"]) - 1, note)


def _walk(env: Any, actions: Sequence[int], *, first: bool) -> None:
    if first:
        env.reset(seed=SEED)
    for action in actions:
        _, _, terminal, timeout, _ = env.step(action)
        if terminal or timeout:
            env.reset()
