"""Records a rollout in one call: makes the environment, runs a policy, writes one file."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array, iterate

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError, TupliError, brief, warn
from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe.description import spread_of
from tupli_mcap.recording.write.options import RENDER_MODE, RecordOptions
from tupli_mcap.wrappers.single import RecordEpisodes
from tupli_mcap.wrappers.vector import RecordEpisodes as RecordVectorEpisodes

Policy = Callable[[Any], Any]
"""A function from one observation (never a batch) to one action."""
STEPS: Final = 1000  # of a rollout, unless steps or episodes are given
_REPORTS = 200  # reports of progress in a rollout, about


class RolloutSummary(NamedTuple):
    """The result of one call; interrupted episodes count too. `size` is that of whole files (bytes).

    `path` is the last of the files, `paths` are all of them. `return_mean` leaves out the `return_nan` episodes whose
    return is NaN; it is NaN if there is no other.
    """

    path: Path
    paths: list[Path]
    episodes: int
    steps: int
    return_mean: float
    return_nan: int
    seconds: float
    size: int


def record_rollouts(
    env_id: str,
    path: str | os.PathLike[str],
    *,
    steps: int | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    num_envs: int = 1,
    policy: Policy | None = None,
    progress: Callable[[int], None] | None = None,
    **options: Any,
) -> RolloutSummary:
    """Records steps or episodes of a registered environment into the MCAP file `path`.

    Args:
        env_id: as `gymnasium.make` takes it; "module:Name-v0" imports the module first.
        steps: in total, by default 1000 if no `episodes` are given; with several sub-environments at least this many.
            The last episode may end "interrupted".
        episodes: ends the rollout once this many episodes have ended, over all sub-environments; the episodes of the
            other ones end "interrupted".
        seed: of the first reset (sub-environment i: seed + i) and of random actions; None draws one.
        num_envs: more than 1 records a SyncVectorEnv.
        policy: called with one observation, returns one action; random actions by default.
        progress: called with the number of steps so far: about 200 times if `steps` are given, else after every 100.
        options: those of `RecordEpisodes`; for `frames` the environment is made with render_mode="rgb_array".

    Raises:
        RecordingError: the environment cannot be made, the policy or the environment failed (what was
            recorded before is in the file), or the file cannot be written.
        OSError: one that the policy or the environment raised, as it is.
        SpaceError: a space that cannot be recorded.
        KeyboardInterrupt: as usual; once it records, with the files so far as arguments.
    """
    limit = _Limit(steps, episodes)
    if limit.steps < 1 or limit.episodes < 1 or num_envs < 1:
        raise RecordingError(
            "expected at least 1 step, 1 episode and 1 environment, "
            f"found steps={steps}, episodes={episodes}, num_envs={num_envs}"
        )
    began = time.perf_counter()
    asked = RecordOptions(**options)
    report = _every(max(1, (steps or 100 * _REPORTS) // _REPORTS), progress)
    wrapped = _recorder(_make(env_id, num_envs, RENDER_MODE if asked.every else None), path, options)
    known = wrapped._writer.index.count
    try:
        with _closing(wrapped):
            run: Any = _run if isinstance(wrapped, RecordEpisodes) else _run_vector
            done = run(wrapped, limit, seed, policy, report)
    except KeyboardInterrupt as err:
        raise KeyboardInterrupt(*wrapped.paths) from err
    return _summary(wrapped.paths, known, done, time.perf_counter() - began)


def _summary(paths: list[Path], known: int, steps: int, seconds: float) -> RolloutSummary:
    """The summary of the files; the first one had `known` episodes before."""
    returns = np.concatenate([_returns(path) for path in paths])[known:]
    size = sum(path.stat().st_size for path in paths)
    spread = spread_of(returns)
    mean, odd = (float("nan"), 0) if spread is None else (spread.mean, spread.nan)
    return RolloutSummary(paths[-1], paths, len(returns), steps, mean, odd, seconds, size)


def _returns(path: Path) -> Array:
    with Recording(path) as recording:
        return np.asarray(recording.index["return"])


def _make(env_id: str, num_envs: int, render_mode: str | None) -> Any:
    """The environment, or a vector environment of several."""

    def make() -> gym.Env[Any, Any]:
        return gym.make(env_id) if render_mode is None else gym.make(env_id, render_mode=render_mode)

    try:
        return make() if num_envs == 1 else gym.vector.SyncVectorEnv([make] * num_envs)
    except (Exception, SystemExit) as err:  # an environment's constructor may raise anything
        raise RecordingError(f"the environment {env_id!r} cannot be made: {brief(err)}") from err


def _recorder(
    env: Any, path: str | os.PathLike[str], options: dict[str, Any]
) -> RecordEpisodes | RecordVectorEpisodes:
    """The recorder of an environment, which is closed if it cannot be recorded."""
    try:
        if isinstance(env, gym.vector.VectorEnv):
            return RecordVectorEpisodes(env, path, **options)
        return RecordEpisodes(env, path, **options)
    except BaseException:
        with contextlib.suppress(Exception, SystemExit):
            env.close()
        raise


@contextlib.contextmanager
def _closing(env: RecordEpisodes | RecordVectorEpisodes) -> Iterator[None]:
    """Closes a wrapper after the block; warns if the environment fails at that, for its recording is finished then."""
    try:
        yield
    finally:
        try:
            env.close()
        except (TupliError, OSError):
            raise
        except (Exception, SystemExit) as err:  # noqa: BLE001 - an environment may raise anything
            warn(f"{env.path} is finished, but the environment failed when it was closed: {brief(err)}")


class _Limit:
    """When a rollout is over: after so many steps, or so many episodes that have ended."""

    def __init__(self, steps: int | None, episodes: int | None) -> None:
        self.episodes = sys.maxsize if episodes is None else episodes
        self.steps = steps if steps is not None else STEPS if episodes is None else sys.maxsize

    def allows(self, steps: int, episodes: int) -> bool:
        """Whether the rollout goes on after these."""
        return steps < self.steps and episodes < self.episodes


def _run(
    env: RecordEpisodes, limit: _Limit, seed: int | None, policy: Policy | None, report: Callable[[int], None]
) -> int:
    """Takes the steps, and calls `report` with their number so far; returns it."""
    env.action_space.seed(seed)
    done = episodes = 0
    ended, again = True, seed
    state: Any = None
    while limit.allows(done, episodes):
        with _failures(done, env.path):
            if ended:
                state, _ = env.reset(seed=again)
                again = None
            action = env.action_space.sample() if policy is None else policy(state)
            state, _, terminal, timeout, _ = env.step(action)
            ended = bool(terminal or timeout)
        done, episodes = done + 1, episodes + ended
        report(done)
    return done


def _run_vector(
    env: RecordVectorEpisodes,
    limit: _Limit,
    seed: int | None,
    policy: Policy | None,
    report: Callable[[int], None],
) -> int:
    """The same with several sub-environments; returns how many steps were taken."""
    env.action_space.seed(seed)
    done = episodes = 0
    with _failures(done, env.path):
        states, _ = env.reset(seed=seed)
    resetting = np.zeros(env.num_envs, dtype=np.bool_)
    next_step = "next" in str(env.metadata.get("autoreset_mode", "next")).lower()
    while limit.allows(done, episodes):
        with _failures(done, env.path):
            actions = env.action_space.sample() if policy is None else _actions(env, policy, states)
            states, _, terminals, timeouts, _ = env.step(actions)
            done += env.num_envs - int(resetting.sum())
            ended = np.logical_or(terminals, timeouts)
            episodes += int(ended.sum())
            if next_step:  # the step after an end is a reset, which is not recorded
                resetting = ended
        report(done)
    return done


def _actions(env: RecordVectorEpisodes, policy: Policy, states: Any) -> Any:
    space = env.single_action_space
    chosen = [policy(state) for state in iterate(env.observation_space, states)]
    batch: Any = create_empty_array(space, env.num_envs)
    return concatenate(space, chosen, batch)


@contextlib.contextmanager
def _failures(done: int, path: Path) -> Iterator[None]:
    """Turns an error of the policy or the environment into a RecordingError that names the step."""
    try:
        yield
    except (TupliError, OSError):
        raise
    except (Exception, SystemExit) as err:
        raise RecordingError(
            f"the policy or the environment failed at step {done}: {brief(err)}"
            + (f"; {path} holds the steps before it" if done else "")
        ) from err


def _every(interval: int, progress: Callable[[int], None] | None) -> Callable[[int], None]:
    if progress is None:
        return lambda done: None
    told = 0

    def report(done: int) -> None:
        nonlocal told
        if done >= told + interval:
            told = done
            progress(done)

    return report
