"""The autoreset mode of a vector environment: as it is declared, and as its batches show it.

NEXT_STEP: after an end, the next call resets the sub-environment and ignores its action: a hole, no step.
SAME_STEP: the call that ends an episode already returns the next one's first state; the final one is in its infos.
DISABLED: the caller resets, all or by `reset_mask`.

With the wrong mode, the next episode's first state would be recorded as a final one, a reset as a step, or a step as a
reset. An environment may declare no mode, or a wrong one, so:

1. A final state in the infos of a batch that ends episodes, other than the state that is returned, says same-step.
   Where no mode is declared and no end has been recorded yet, that mode is taken; where another one is declared, or
   ends have been recorded, the batch is refused. A mode given by the caller takes precedence, with a warning.
2. A flag in the batch after an end shows that this was a step, and no reset; where no mode is declared, a reward shows
   it too. That batch is refused. (Wrappers may give rewards to resets, so a declared mode takes precedence over a
   reward.)
3. Where no mode is declared, an end is written with the batch after it: if that is refused, without a final state.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from tupli_mcap.arrays import Array
from tupli_mcap.errors import StepError
from tupli_mcap.spaces.exact import shorten

Mode = Literal["NextStep", "SameStep", "Disabled"]
_MODES: tuple[Mode, ...] = ("NextStep", "SameStep", "Disabled")
_OTHERWISE = (
    'pass autoreset_mode="SameStep" if it resets in the step that ends an episode, "NextStep" if in the next one, '
    '"Disabled" if you reset it'
)


class Autoreset:
    """The mode of one vector environment, for all the recordings of a wrapper.

    Attributes:
        mode: the mode that is recorded by; "SameStep" once rule 1 applied.
        is_assumed: neither the environment nor the caller has said which mode it is.
        needs_no_finals: the caller has given same-step autoreset, whether infos hold final states or not.
        has_ended: ends are recorded by the mode.
        doubt: what the caller should be told, if anything.
    """

    def __init__(self, mode: Mode, *, given: bool, assumed: bool = False) -> None:
        self.mode = mode
        self.is_assumed = assumed
        self.needs_no_finals = given and mode == "SameStep"
        self.doubt = ""
        self.has_ended = False
        self._given = given
        self._has_told = False

    @classmethod
    def of(cls, env: Any, given: Any) -> Autoreset:
        """The mode that the caller gives, or the environment declares; by default next-step is assumed; StepError if
        the mode is none of the three."""
        # those of Gymnasium 1.0 do not declare the only mode they have
        base = env.unwrapped
        known = isinstance(base, SyncVectorEnv | AsyncVectorEnv) or type(base).__module__.startswith(
            "gymnasium."
        )
        declared = (env.metadata or {}).get("autoreset_mode", "NextStep" if known else None)
        found = declared if given is None else given
        if found is None:
            return cls("NextStep", given=False, assumed=True)
        text = str(getattr(found, "value", found)).replace("_", "").replace("-", "").lower()
        for mode in _MODES:
            if text == mode.lower():
                return cls(mode, given=given is not None)
        raise StepError(f"autoreset_mode: expected NextStep, SameStep or Disabled, found {found!r:.80}")

    @property
    def is_plain(self) -> bool:
        """True for next-step autoreset that is not assumed."""
        return self.mode == "NextStep" and not self.is_assumed

    def note_finals(self, *, changed: bool) -> None:
        """Takes a batch with ends whose infos hold final states; if it returned other states than these (`changed`),
        and no mode is declared, the mode is same-step from now on.

        StepError if that contradicts what was recorded, or what the environment declares.
        """
        if self.mode == "SameStep" or not changed:
            return  # nothing contradicts what is said
        if self._given:
            self._doubt(
                f"an episode ended with a final state in infos that is not the state returned, as under same-step "
                f"autoreset, and is recorded as under {self.mode}, as you have said"
            )
            return
        if self.has_ended or not self.is_assumed:
            raise StepError(
                f"an episode ended with a final state in infos that is not the state returned, as under same-step "
                f"autoreset, and is recorded as under {self.mode}; pass "
                f'autoreset_mode="SameStep", or "{self.mode}" if that is right'
            )
        self.mode, self.is_assumed = "SameStep", False

    def _doubt(self, text: str) -> None:
        """Tells the caller, once."""
        if not self._has_told:
            self._has_told, self.doubt = True, text

    def check_resets(self, holes: Array, done: Array, rewards: Array) -> None:
        """Checks a batch in which the sub-environments `holes` should have been reset.

        StepError if they took a step.
        """
        steps = done & holes
        if self.is_assumed:
            steps = steps | (holes & _rewarded(rewards, holes))
        if steps.any():
            i = int(steps.argmax())
            what = "another end" if done[i] else f"the reward {shorten(rewards[i])}"
            raise StepError(
                f"expected a reset of sub-environment {i} after its end, as next-step autoreset does it, found {what}; "
                + _OTHERWISE
            )

    def note_ends(self, *, known: bool) -> None:
        """Chooses the warning for the caller once ends are recorded. `known`: with their final states."""
        if self.is_assumed:
            self._doubt(
                "the vector environment declares no autoreset mode, and is recorded as under next-step autoreset "
                f'(pass autoreset_mode="NextStep" if that is right); {_OTHERWISE}'
            )
        elif not known:
            self._doubt(
                "same-step autoreset without final states in infos (final_obs): "
                "episodes are recorded without them"
            )


def _rewarded(rewards: Array, alike: Array) -> Array:
    """Who has a reward other than 0. Rewards of another shape are refused when they are stored."""
    if rewards.shape[:1] != alike.shape:
        return np.zeros_like(alike)
    found: Array = np.asarray(rewards != 0, np.bool_).reshape(len(alike), -1).max(axis=1, initial=False)
    return found
