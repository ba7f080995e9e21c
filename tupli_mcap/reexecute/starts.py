"""Decides how each episode of a recording has to be started to run it again.

A reset with a seed starts a chain. A reset without one goes on with the random stream of the episode before it, so
it can be repeated only by repeating all episodes from the chain's start, in their order, on one environment.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal, NamedTuple

from tupli_mcap.messages.episodes import INTERRUPTED
from tupli_mcap.recording import Recording

How = Literal["seeded", "drawn", "captured", "follows", "continues", "unknown"]


class ResetCall(NamedTuple):
    """The arguments of a call of `reset`; `options` is exact JSON, empty for none."""

    seed: int | None
    options: str


class EpisodePlan(NamedTuple):
    """How an episode starts.

    position, number, env: its position in `Recording.episodes`, its number, its sub-environment.
    how: "seeded" (a seed was given to reset), "drawn" (a new environment drew it), "captured" (no seed, but the
        environment in the file is as it was before that reset), "follows" (no seed, the episode before it is
        recorded), "continues" (no reset at all), "unknown" (no seed, and what came before it is not recorded).
    after_end: whether the episode before it in its sub-environment ended by itself, and not by this reset.
    gap: whether steps or episodes before it are missing in the recording.
    resets: the resets to make, of which the last one starts the episode; empty if it continues without a reset.
    auto: whether `gymnasium.wrappers.Autoreset` may have started it, which resets in `step`.
    """

    position: int
    number: int
    env: int
    how: How
    resets: tuple[ResetCall, ...]
    after_end: bool
    gap: bool
    auto: bool

    @property
    def starts_chain(self) -> bool:
        """Whether it can be run without the episodes before it."""
        return self.how in ("seeded", "drawn")

    @property
    def needs_predecessor(self) -> bool:
        return self.how in ("follows", "continues")


def plan_episodes(recording: Recording, *, captured: bool) -> list[list[EpisodePlan]]:
    """The plans of each sub-environment, in the order of the recording.

    captured: the environment in the file has its state from before the first reset (a pickle, not a spec).
    """
    plans: list[list[EpisodePlan]] = [[] for _ in range(recording.num_envs)]
    last: dict[int, int] = {}  # sub-environment -> row of its last episode
    rows = recording.index
    for position in range(len(rows)):
        env = int(rows["env"][position])
        plans[env].append(_plan(recording, position, last.get(env), captured and env == 0))
        last[env] = position
    return plans


def _plan(recording: Recording, position: int, before: int | None, captured: bool) -> EpisodePlan:
    row = recording.index[position]
    start = recording.episode_start(position)
    number = int(row["episode"])
    # Episodes are numbered across sub-environments, so a missing number may be of any of them.
    missing = 0 if before is None else int(recording.index[before]["episode"]) - before
    gap = number - position != missing
    after_end = before is not None and recording.index[before]["end"] != INTERRUPTED
    # without a final state (of a repaired or hand-made file), the state of the environment after it is not known
    gap = gap or (before is not None and recording.index[before]["final_row"] < 0)
    earlier = recording.resets_before(position)
    lost = [i for i, reset in enumerate(earlier) if reset.continued]
    starts = [*(earlier[lost[-1] + 1 :] if lost else earlier), start]
    seeded = [i for i, reset in enumerate(starts) if reset.seed_number is not None]
    how: How
    if start.continued:
        how = "continues" if after_end else "unknown"
        starts = []
    elif seeded:
        how = "seeded" if starts[seeded[-1]].seed_given else "drawn"
        starts = starts[seeded[-1] :]
    elif lost:
        how = "unknown"
    elif before is not None:
        how = "follows"
    else:
        how = "captured" if captured and not gap else "unknown"
    plain = not start.options and start.reset_info == "{}" and len(starts) == 1
    resets = tuple(ResetCall(reset.seed_number, reset.options) for reset in starts)
    return EpisodePlan(
        position, number, int(row["env"]), how, resets, after_end, gap,
        auto=how == "follows" and plain and after_end,
    )  # fmt: skip


def up_to_last(plans: list[EpisodePlan], chosen: Collection[int]) -> list[EpisodePlan]:
    last = max((i for i, plan in enumerate(plans) if plan.number in chosen), default=-1)
    return plans[: last + 1]


def needed_for(plans: list[EpisodePlan], chosen: Collection[int]) -> list[EpisodePlan]:
    """The chosen episodes, and the episodes before them that they continue."""
    needed = []
    wanted = False
    for plan in reversed(plans):
        wanted = wanted or plan.number in chosen
        if wanted:
            needed.append(plan)
            wanted = not plan.starts_chain
    return needed[::-1]
