"""`VecRecordEpisodes` records `VecEnv`s of Stable-Baselines3: it shows them to the vector recorder as Gymnasium's."""

from __future__ import annotations

import inspect
import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.errors import missing_extra
from tupli_mcap.recording.write.episodes import ResetFacts
from tupli_mcap.recording.write.options import check_known
from tupli_mcap.wrappers.base import Recorder, wrong_kind
from tupli_mcap.wrappers.vector import RecordEpisodes

try:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import (
        DummyVecEnv,
        SubprocVecEnv,
        VecEnv,
        VecEnvWrapper,
        VecFrameStack,
    )
except ImportError as err:
    raise missing_extra("tupli_mcap.sb3 needs stable-baselines3", "sb3") from err

_FINAL = "terminal_observation"
_TIMEOUT = "TimeLimit.truncated"


class VecRecordEpisodes(Recorder, VecEnvWrapper):  # type: ignore[misc]  # its types are not followed
    """Records every sub-environment of a Stable-Baselines3 `VecEnv` into the MCAP file `path`.

        venv = VecRecordEpisodes(make_vec_env("CartPole-v1", n_envs=4), "runs/")
        PPO("MlpPolicy", venv).learn(100_000)
        venv.close()

    It records what passes through it: inside `VecNormalize`, what the environments gave; around it, what the policy
    learns from. The final state of an episode is `terminal_observation` of its last info. An episode ends as a timeout
    if that info says `TimeLimit.truncated`. `EvalCallback` needs both environments wrapped alike; give the second one
    `split="eval"`. `make_vec_env(..., wrapper_class=RecordEpisodes, wrapper_kwargs={"path": "runs/"})` makes a file for
    each sub-environment instead.

    Args:
        venv: `DummyVecEnv`, `SubprocVecEnv`, a wrapper around one, or a `VecEnv` of your own.
        path: the recording (.mcap), or a directory, in which a new file is named by run or environment, and time.
        options: those of `tupli_mcap.RecordEpisodes` and of `tupli_mcap.vector.RecordEpisodes`.

    Raises:
        MissingExtraError: Stable-Baselines3 is not installed (at import; extra `sb3`).
        RecordingError: it is no `VecEnv`; else as `tupli_mcap.RecordEpisodes`.

    Not thread-safe.
    """

    def __init__(self, venv: VecEnv, path: str | os.PathLike[str], **options: Any) -> None:
        if not isinstance(venv, VecEnv):
            raise wrong_kind(venv, "a VecEnv of Stable-Baselines3")
        check_known(type(self).__name__, options, list(inspect.signature(_Recorder).parameters))
        super().__init__(venv)
        options.setdefault("stack_size", _stack_size(venv))
        self._shown = StableBaselinesVecEnv(venv)
        self._recorder = _Recorder(self._shown, path, **options)
        self.rotation, self._work = self._recorder.rotation, self._recorder._work
        self._actions: Any = None

    def step_async(self, actions: Any) -> None:
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        self._recorder.step(self._actions)
        return self._shown.result

    def reset(self) -> Any:
        return self._recorder.reset()[0]

    def close(self) -> None:
        """Finishes the recording, then closes the environments. Calling it twice is fine.

        Raises:
            RecordingError: the disk refuses; everything that was recorded is safe.
        """
        self._recorder.close()


class StableBaselinesVecEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """A `VecEnv` as a vector environment of Gymnasium with same-step autoreset.

    `step` waits for the step that was sent to the `VecEnv` before.

    Attributes:
        envs: the sub-environments in this process, without the Monitor of `make_vec_env`, which changes no step.
        spec: of the first sub-environment, in any process, without that Monitor; None if there is none.
        spec_is_of_one: `spec` makes a single sub-environment.
        result: what the `VecEnv` returned last.
    """

    spec_is_of_one = True
    closed = True  # else Gymnasium closes the environments when this is collected

    def __init__(self, venv: VecEnv) -> None:
        self._venv = venv
        self.num_envs = n = venv.num_envs
        self.single_observation_space, self.single_action_space = venv.observation_space, venv.action_space
        self.observation_space = batch_space(venv.observation_space, n)
        self.action_space = batch_space(venv.action_space, n)
        self.metadata = {**(getattr(venv, "metadata", None) or {}), "autoreset_mode": "SameStep"}
        self.render_mode = venv.render_mode
        self.envs = [_unmonitored(env) for env in getattr(venv.unwrapped, "envs", ())]
        self.spec = _spec_of(venv)
        self.result: Any = None
        self._nobody = np.zeros(n, np.bool_)

    def asked(self) -> tuple[Sequence[int | None], Sequence[Any]]:
        """The seeds and options that the next reset passes to the sub-environments."""
        base, nothing = self._venv.unwrapped, [None] * self.num_envs
        return getattr(base, "_seeds", nothing), getattr(base, "_options", nothing)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> Any:
        states = self._venv.reset()
        return states, self._reset_infos()

    def step(self, actions: Any) -> Any:
        self.result = states, rewards, dones, infos = self._venv.step_wait()
        rewards = np.asarray(rewards, np.float64)  # as they are stored
        done = np.asarray(dones)
        if not any(done.tolist()):
            return states, rewards, self._nobody, self._nobody, infos
        done = done.astype(np.bool_)
        timeouts = done & np.array([bool(info.get(_TIMEOUT)) for info in infos])
        return states, rewards, done & ~timeouts, timeouts, self._with_final_infos(states, done, infos)

    def render(self) -> Any:
        return self._venv.get_images()

    def close(self, **kwargs: Any) -> None:
        self._venv.close()

    def _reset_infos(self) -> list[Any]:
        """The infos of the last resets; only Stable-Baselines3's own environments keep them."""
        base = self._venv.unwrapped
        known = isinstance(base, DummyVecEnv | SubprocVecEnv)
        return list(base.reset_infos) if known else [{}] * self.num_envs

    def _with_final_infos(self, states: Any, done: Array, infos: Sequence[Any]) -> list[Any]:
        """The infos of a batch: those that are `done` get the info of the reset, with the step's as `final_info`."""
        found, resets = list(infos), self._reset_infos()
        for i in np.flatnonzero(done).tolist():
            final = {key: value for key, value in infos[i].items() if key != _FINAL}
            found[i] = {**resets[i], "final_info": final}
            if infos[i].get(_FINAL) is not None:
                found[i][_FINAL] = _as_in(states, infos[i][_FINAL])
        return found


class _Recorder(RecordEpisodes):
    """A recorder that takes the seeds and options of a reset from the `VecEnv`."""

    env: StableBaselinesVecEnv

    def _facts(
        self, seeds: Sequence[int | None], unseeded: list[bool], options: str, infos: Any
    ) -> list[ResetFacts]:
        facts = super()._facts(seeds, unseeded, options, infos)
        texts = [jsonvalue.dumps_any(one) if one else "" for one in self._options]
        return [one._replace(options=text) for one, text in zip(facts, texts, strict=True)]

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        seeds, self._options = self.env.asked()
        return super().reset(seed=seeds)


def _as_in(states: Any, state: Any) -> Any:
    """One state in the dtypes of a batch: a `VecEnv` casts all states to them, but not final ones."""
    if isinstance(states, dict):
        return {key: _as_in(batch, state[key]) for key, batch in states.items()}
    if isinstance(states, tuple):
        return tuple(_as_in(batch, one) for batch, one in zip(states, state, strict=True))
    return np.asarray(state, states.dtype)


def _unmonitored(env: Any) -> Any:
    return env.env if isinstance(env, Monitor) else env


def _stack_size(venv: VecEnv) -> int | None:
    """How many frames the outermost `VecFrameStack` stacks."""
    while isinstance(venv, VecEnvWrapper):
        if isinstance(venv, VecFrameStack):
            stack_size: int = venv.stacked_obs.n_stack
            return stack_size
        venv = venv.venv
    return None


def _spec_of(venv: VecEnv) -> Any:
    try:
        spec = venv.get_attr("spec", 0)[0]
        wrappers = spec.additional_wrappers
    except Exception:  # noqa: BLE001 - a `VecEnv` of anybody's class may have no such thing
        return None
    if wrappers and wrappers[-1].entry_point == f"{Monitor.__module__}:{Monitor.__name__}":
        return replace(spec, additional_wrappers=wrappers[:-1])
    return spec
