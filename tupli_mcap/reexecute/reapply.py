"""Runs an episode again: resets the environment with the recorded seed and options, and steps it with the actions.

It returns what the environment returns; other modules compare and render.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.environment import autoresets_of
from tupli_mcap.errors import TupliError, brief
from tupli_mcap.recording import Recording
from tupli_mcap.recording.episode import item_getter
from tupli_mcap.reexecute.starts import EpisodePlan, ResetCall


class EnvironmentFailedError(TupliError):
    """The environment raised `cause` at `step`; -1 is the reset."""

    def __init__(self, step: int, cause: BaseException) -> None:
        self.step = step
        self.cause = cause
        where = "reset" if step < 0 else f"step {step}"
        super().__init__(f"the environment failed in {where} with {brief(cause)}")


class Moment(NamedTuple):
    """The values that the environment returned; reward and flags are None for a reset.

    The state is the environment's own object, which its next step may change.
    """

    state: Any
    reward: Any = None
    terminal: Any = None
    timeout: Any = None
    info: Any = None


class Reexecutor:
    """Runs the episodes of one sub-environment again, in the order of the calls.

    make: builds the environment. owned: whether this object closes it; otherwise the caller does. plain: pass numbers
    in actions as Python's, not NumPy's, because a recording does not say which of them the policy gave.

    All episodes run in one environment, since wrappers may carry state from one to the next, until an episode began in
    a new environment when it was recorded.
    """

    def __init__(
        self, make: Callable[[], gym.Env[Any, Any]], *, owned: bool = True, plain: bool = False
    ) -> None:
        self._make = make
        self._owned = owned
        self.plain = plain
        self._env: gym.Env[Any, Any] | None = None
        self._used = False
        self._last: Moment | None = None
        self._last_action: Any = None

    @property
    def used(self) -> bool:
        """True if the environment has been reset before."""
        return self._env is not None and self._used

    @property
    def env(self) -> gym.Env[Any, Any]:
        """The environment; built at the first use."""
        if self._env is None:
            self._env = self._make()
            self._used = False
        return self._env

    def step(self, number: int, action: Any) -> Moment:
        """Takes step `number` of the episode. It goes on after an end, as a recorded episode may.
        EnvironmentFailedError if the environment raises."""
        try:
            moment = Moment(*self.env.step(action))
        except (Exception, SystemExit) as err:
            raise EnvironmentFailedError(number, err) from err
        self._last, self._last_action = moment, action
        return moment

    def start(self, plan: EpisodePlan) -> Moment:
        """Starts an episode. EnvironmentFailedError if the environment raises."""
        if plan.how == "drawn" and self.used:
            self.close()  # an environment draws its own seed only in its first reset, so a new one began here
        if plan.how == "continues" and self._last is not None:
            return Moment(self._last.state)
        env = self.env
        resets_itself = any(layer.autoreset for layer in autoresets_of(env))
        if plan.auto and resets_itself and self._last is not None:
            try:
                state, *_ = env.step(self._last_action)  # Autoreset ignores the action after an end
            except (Exception, SystemExit) as err:
                raise EnvironmentFailedError(-1, err) from err
            self._last = Moment(state)
            return self._last
        moment = Moment(None)
        for seed, text in plan.resets or (ResetCall(None, ""),):
            options = jsonvalue.loads(text) if text else None
            if isinstance(options, dict):
                options.pop("reset_mask", None)  # in older recordings; it was for the vector environment
            self._used = True
            try:
                state, info = env.reset(seed=seed, options=options)
            except (Exception, SystemExit) as err:
                raise EnvironmentFailedError(-1, err) from err
            moment = Moment(state, info=info)
        self._last = moment
        return moment

    def close(self) -> None:
        """Closes the environment; the next episode builds a new one."""
        env, self._env = self._env, None
        self._last = None
        if env is not None and self._owned:
            with contextlib.suppress(Exception):  # the environment is not used again
                env.close()


def recorded_actions(recording: Recording, columns: Any, *, plain: bool) -> Callable[[int], Any]:
    """A function from a step's index to its action, of the type of the action space's samples; with `plain`, NumPy
    numbers become Python's."""
    get: Callable[[int], Any] = item_getter(recording.action_space, columns)
    return (lambda step: _plain(get(step))) if plain else get


def _plain(action: Any) -> Any:
    if isinstance(action, dict):
        return {key: _plain(item) for key, item in action.items()}
    if type(action) is tuple:
        return tuple(_plain(item) for item in action)
    return action.item() if isinstance(action, np.generic) else action
