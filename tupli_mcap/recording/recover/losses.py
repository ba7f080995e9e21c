"""Which steps of a damaged recording are lost, by episode, as far as the rest of it shows."""

from __future__ import annotations

import bisect
from typing import NamedTuple

from tupli_mcap.recording.recover.episodes import Plan
from tupli_mcap.recording.recover.step_runs import StepRun

_END = 1 << 64  # beyond any row number


class Losses(NamedTuple):
    """`steps` maps episodes to ranges of steps (None: to an unknown end); `rows` counts those known to have been."""

    steps: dict[int, list[tuple[int, int | None]]]
    rows: int


def losses(plan: Plan) -> Losses:
    """The steps that are lost of a planned recording."""
    runs: dict[int, list[StepRun]] = {}
    for episode in plan.episodes:
        runs.setdefault(episode.run.episode, []).append(episode.run)
    ended = {episode.run.episode for episode in plan.episodes if episode.tail}
    steps = {}
    for number in sorted(set(runs) | set(plan.records.ends) | set(plan.records.starts)):
        lost = _of_episode(plan, number, runs.get(number, []), ended=number in ended)
        if lost:
            steps[number] = lost
    kept = sum(stop - first for ranges in plan.kept.values() for first, stop in ranges)
    return Losses(steps, sum(plan.totals) - kept)


def _of_episode(plan: Plan, number: int, runs: list[StepRun], *, ended: bool) -> list[tuple[int, int | None]]:
    end = plan.records.ends.get(number)
    at = 0
    lost: list[tuple[int, int | None]] = []
    for run in sorted(runs, key=lambda run: run.step):
        if run.step > at:
            lost.append((at, run.step))
        at = max(at, run.step + run.steps)
    if end is not None and end.end.length > at:
        lost.append((at, end.end.length))
    if end is None and not ended and (runs or _is_in_a_hole(plan, number)):
        lost.append((at, None))
    return lost


def _is_in_a_hole(plan: Plan, number: int) -> bool:
    """Whether an episode whose start alone is left had steps."""
    start = plan.records.starts[number].start
    kept = plan.kept.get(start.env, [])
    after = bisect.bisect_right(kept, (start.first_row, _END))
    total = plan.totals[start.env] if start.env < len(plan.totals) else 0
    behind = after == len(kept) and start.first_row >= total
    return not behind and not (after and start.first_row < kept[after - 1][1])
