"""`CHECKS`: all checks, in the order in which findings of one severity and recording are listed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from tupli_mcap.doctor import duplicates, episodes, steps, values
from tupli_mcap.doctor.findings import Finding
from tupli_mcap.doctor.measurements import Statistic


@dataclass(frozen=True)
class Check:
    """A check: its id, a line on what it finds, and its function.

    run: called with the `Measurements` of each recording, and with thresholds as keywords. needs: the statistic to
    measure for it. across: if true, `run` compares recordings: it is called once, with that statistic of each.
    """

    id: str
    summary: str
    run: Callable[..., Iterator[Finding]]
    needs: type[Statistic] | None = None
    across: bool = False

    @property
    def explanation(self) -> str:
        """The docstring of `run`: what exactly is checked, and how."""
        return inspect.cleandoc(self.run.__doc__ or "")

    @property
    def thresholds(self) -> dict[str, Any]:
        """The names and defaults of its thresholds."""
        parameters = inspect.signature(self.run).parameters.values()
        return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


_VALUES = values.LeafValues
_CHECKS = (
    Check("unfinished", "recordings whose writer did not finish", episodes.unfinished),
    Check("nan", "NaN in states, final states, actions, rewards", values.nan, _VALUES),
    Check("infinity", "infinite states, final states, actions, rewards", values.infinity, _VALUES),
    Check("outside-space", "values that are not in their space", values.outside_space, _VALUES),
    Check("missing-terminals", "no episode ends in a terminal state", episodes.missing_terminals),
    Check(
        "final-state-is-reset",
        "final states that belong to the next episode",
        episodes.final_state_is_reset,
        episodes.FinalStates,
    ),
    Check("missing-reset", "steps after an end without a reset", episodes.missing_reset),
    Check("one-step-episodes", "episodes of a single step", episodes.one_step_episodes),
    Check(
        "duplicate-episodes",
        "episodes that are equal in every step",
        duplicates.duplicate_episodes,
        duplicates.Digests,
        across=True,
    ),
    Check("repeated-seed", "one seed for several episodes", episodes.repeated_seed),
    Check("constant-dimension", "dimensions that never change", values.constant_dimension, _VALUES),
    Check("frozen-frames", "images that stand still", steps.frozen_frames, steps.Frames),
    Check("reward-outliers", "rewards far from all others", steps.reward_outliers, steps.Rewards),
    Check("unused-action", "actions that never occur", values.unused_action, _VALUES),
    Check("clock-jump", "long pauses inside episodes", steps.clock_jump, steps.Clock),
)
CHECKS: dict[str, Check] = {check.id: check for check in _CHECKS}
