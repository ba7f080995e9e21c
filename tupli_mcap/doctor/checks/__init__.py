"""The checks: each judges the chart of one recording, or the contents of all."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from tupli_mcap.doctor.checks import (
    actions,
    clocks,
    endings,
    files,
    repeats,
    resets,
    rewarding,
    values,
    variation,
)
from tupli_mcap.doctor.findings import Finding

__all__ = ["CHECKS", "Check"]


@dataclass(frozen=True)
class Check:
    """A check: its id, what it looks for in one line, and the function that judges.

    needs: what has to be measured for it, some of `tupli_mcap.doctor.chart.NEEDS`. across: it compares recordings.
    """

    id: str
    summary: str
    run: Callable[..., Iterator[Finding]]
    needs: frozenset[str] = frozenset()
    across: bool = False

    @property
    def explanation(self) -> str:
        """What exactly is judged, and how."""
        return inspect.cleandoc(self.run.__doc__ or "")

    @property
    def thresholds(self) -> dict[str, Any]:
        """The names and defaults of its thresholds."""
        parameters = inspect.signature(self.run).parameters.values()
        return {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}


_VALUES = frozenset({"values"})

# In the order findings of one severity and one recording are told.
CHECKS: dict[str, Check] = {
    check.id: check
    for check in (
        Check("no-episodes", "recordings without an episode", files.no_episodes),
        Check("unfinished", "recordings whose writer did not finish", files.unfinished),
        Check("nan", "NaN in states, final states, actions, rewards", values.nan, _VALUES),
        Check("infinity", "infinite states, final states, actions, rewards", values.infinity, _VALUES),
        Check("outside-space", "values that are not in their space", values.outside_space, _VALUES),
        Check("stored-dtype", "dtypes wider than the space declares", values.stored_dtype, _VALUES),
        Check(
            "flags-inside",
            "terminals and timeouts before the last step",
            endings.flags_inside,
            frozenset({"flags"}),
        ),
        Check("missing-terminals", "no episode ends in a terminal state", endings.missing_terminals),
        Check("interrupted", "episodes cut off without terminal or timeout", endings.interrupted),
        Check("time-limit-as-terminal", "time limits recorded as terminals", endings.time_limit_as_terminal),
        Check(
            "missing-final-state", "episodes whose last next state is unknown", endings.missing_final_state
        ),
        Check(
            "final-state-is-reset",
            "final states that belong to the next episode",
            resets.final_state_is_reset,
            frozenset({"seams"}),
        ),
        Check("missing-reset", "steps after an end without a reset", resets.missing_reset),
        Check("one-step-episodes", "episodes of a single step", endings.one_step_episodes),
        Check("episode-length", "episodes longer than the limit, or than all others", endings.episode_length),
        Check(
            "duplicate-episodes",
            "episodes that are equal in every step",
            repeats.duplicate_episodes,
            frozenset({"digests"}),
            across=True,
        ),
        Check("repeated-seed", "one seed for several episodes", repeats.repeated_seed),
        Check("constant-dimension", "dimensions that never change", variation.constant_dimension, _VALUES),
        Check("frozen-frames", "images that stand still", variation.frozen_frames, frozenset({"frames"})),
        Check("state-scale", "dimensions of very different range", variation.state_scale, _VALUES),
        Check("constant-reward", "rewards that are all equal", rewarding.constant_reward, _VALUES),
        Check(
            "reward-outliers",
            "rewards far from all others",
            rewarding.reward_outliers,
            frozenset({"rewards"}),
        ),
        Check("return-outliers", "returns far from all others", rewarding.return_outliers),
        Check("unused-action", "actions that never occur", actions.unused_action, _VALUES),
        Check("action-imbalance", "one action nearly always", actions.action_imbalance, _VALUES),
        Check("saturated-action", "continuous actions at their bounds", actions.saturated_action, _VALUES),
        Check(
            "action-range", "continuous actions that use little of their range", actions.action_range, _VALUES
        ),
        Check("clock-jump", "long pauses inside episodes", clocks.clock_jump, frozenset({"clock"})),
        Check("clock-held", "steps in a row at the same time", clocks.clock_held, frozenset({"clock"})),
        Check("clock-unset", "times before the year 2000", clocks.clock_unset),
        Check("metadata-nan", "NaN in the metadata of episodes", files.metadata_nan),
    )
}
