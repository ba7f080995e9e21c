"""`Tap`: a wrapper between an environment and its recorder, so that a recorder can be added after a reset, and removed
again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from tupli_mcap.recording.write.options import MetadataCallback
from tupli_mcap.schema import RLTuple
from tupli_mcap.wrappers.base import reset_callback


class PendingReset(NamedTuple):
    """A reset without a step that no recorder has seen."""

    result: tuple[Any, dict[str, Any]]
    seed: int | None
    options: dict[str, Any] | None


class Tap(gym.Wrapper[Any, Any, Any, Any]):
    """Passes an earlier reset to a recorder, and outlives the recorder: closing it closes nothing."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.pending: PendingReset | None = None
        self.step = env.step  # type: ignore[method-assign]  # one call less in each step

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        return self.env.spec

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        if self.pending is not None:
            result, self.pending = self.pending.result, None
            return result
        return self.env.reset(seed=seed, options=options)

    def close(self) -> None:
        pass


class Retyped:
    """A callback that is given tuples of another class."""

    def __init__(self, callback: MetadataCallback, tuple_class: type[RLTuple]) -> None:
        self._callback = callback
        self._tuple_class = tuple_class

    def reset(self) -> None:
        reset_callback(self._callback)

    def __call__(self, tuple: RLTuple) -> Mapping[str, Any]:
        return self._callback(
            self._tuple_class.from_env_step(
                tuple.state, tuple.action, tuple.reward, tuple.terminal, tuple.timeout, tuple.info
            )
        )
