"""Checks that a reopened recording has every finished step that its processes reported, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from environments import same

from tupli_mcap import Recording

__all__ = ["Found", "check_recording", "found_in", "problems_of"]


@dataclass
class Found:
    """An episode as it was read."""

    env: int
    number: int
    end: str
    total: float
    seed: int | None
    options: Any
    reset_info: dict[str, Any]
    steps: list[tuple[Any, ...]]
    final: Any
    metadata: dict[str, Any]
    times: tuple[int, int]


def found_in(recording: Recording) -> list[Found]:
    """All episodes of a recording."""
    return [
        Found(
            e.env, e.number, e.end, e.return_, e.seed, e.options, e.reset_info, [tuple(step) for step in e],
            e.final_state, e.metadata, (e.start_time, e.end_time),
        )
        for e in recording.episodes
    ]  # fmt: skip


@dataclass(eq=False)
class _Told:
    """An episode as it was reported: `certain` of its steps were finished."""

    reset: tuple[Any, ...]
    steps: list[tuple[Any, ...]] = field(default_factory=list)
    certain: int = 0

    @property
    def metadata(self) -> dict[str, Any]:
        """The callback's metadata after all steps."""
        total = 0.0
        for step in self.steps:  # `sum` of Python 3.12 rounds otherwise
            total += float(step[2])
        return {"steps": len(self.steps), "total": total}


def _told_episodes(reports: Sequence[tuple[str, Any]]) -> dict[int, list[_Told]]:
    """The reported episodes, by sub-environment."""
    told: dict[int, list[_Told]] = {}
    finished = max((i for i, (name, _) in enumerate(reports) if name == "done"), default=-1)
    for i, (name, value) in enumerate(reports):
        if name == "reset":
            told.setdefault(value[0], []).append(_Told(value[1:]))
        elif name == "step":
            episode = told[value[0]][-1]
            episode.steps.append(value[1:])
            episode.certain += i < finished
    return told


def check_recording(
    found: Sequence[Found],
    reports: Sequence[tuple[str, Any]],
    *,
    vector: bool,
    infos: Any,
    metadata: bool = False,
) -> tuple[int, list[str]]:
    """(finished steps that were reported, what is wrong with the episodes that one process recorded)."""
    told, problems, steps = _told_episodes(reports), [], 0
    numbers = [episode.number for episode in found]
    if numbers != sorted(set(numbers)):
        problems.append(f"episode numbers are not in order: {numbers}")
    for env in sorted({*told, *(episode.env for episode in found)}):
        mine = [episode for episode in found if episode.env == env]
        expected = [episode for episode in told.get(env, []) if episode.steps]
        steps += sum(episode.certain for episode in expected)
        if len(mine) == len(expected) - 1 and not expected[-1].certain:
            expected.pop()  # its only step was not finished, and is not there
        if len(mine) != len(expected):
            problems.append(f"env {env}: {len(expected)} episodes were told of, {len(mine)} are there")
        for a, b in zip(mine, expected, strict=False):
            following = expected[expected.index(b) + 1 :]
            ended = (len(b.steps) == b.certain and any(b.steps[-1][3:5])) or any(e.certain for e in following)
            if metadata and a.metadata != b.metadata and (ended or a.metadata):
                problems.append(f"env {env}, episode {a.number}: its metadata are {a.metadata}")
            problems += [
                f"env {env}, episode {a.number}: {problem}"
                for problem in problems_of(a, b.reset, b.steps, b.certain, vector=vector, infos=infos)
            ]
    return steps, problems


def problems_of(
    found: Found,
    reset: tuple[Any, ...],
    steps: Sequence[tuple[Any, ...]],
    certain: int,
    *,
    vector: bool,
    infos: Any,
) -> list[str]:
    """What is wrong with an episode. `certain` of its `steps` (action, state, reward, terminal, timeout, info) were
    finished."""
    n = len(found.steps)
    if not certain <= n <= len(steps) or not n:
        return [f"{certain} steps were finished, {n} are there"]
    state, seed, options, reset_info = reset
    problems, total = [], 0.0
    for i, (step, (action, after, reward, terminal, timeout, info)) in enumerate(
        zip(found.steps, steps, strict=False)
    ):
        pairs = (step[0], state), (step[1], action), (_plain(step[2]), _plain(reward))
        names = ("state", "action", "reward")
        problems += [
            f"{name} of step {i} differs" for name, pair in zip(names, pairs, strict=True) if not same(*pair)
        ]
        if step[3:5] != (terminal, timeout):
            problems.append(f"flags of step {i} are {step[3:5]}, not {(terminal, timeout)}")
        if (
            infos
            and not _same_info(step[5], info, infos, vector=vector)
            and (i < certain or step[5] is not None)
        ):
            problems.append(f"info of step {i} is {step[5]}, not {info}")
        state, total = after, total + float(np.sum(reward, dtype=np.float64))
    if not same(found.final, state):
        problems.append(f"the final state differs: {found.final!r:.80}, not {state!r:.80}")
    *_, terminal, timeout, _ = steps[n - 1]
    end = "terminal" if terminal else "timeout" if timeout else "interrupted"
    if found.end != end:
        problems.append(f"it ended {found.end}, not {end}")
    if found.total != total:
        problems.append(f"its return is {found.total!r}, not {total!r}")
    if seed is not None and found.seed != seed:
        problems.append(f"its seed is {found.seed}, not {seed}")
    if not vector and found.options != options:
        problems.append(f"its options are {found.options}, not {options}")
    if {key: int(value) for key, value in found.reset_info.items()} != reset_info:
        problems.append(f"its reset info is {found.reset_info}, not {reset_info}")
    if found.times[0] > found.times[1]:
        problems.append(f"it ends before it begins: {found.times}")
    return problems


def _plain(reward: Any) -> Any:
    return reward if isinstance(reward, np.ndarray) else float(reward)


def _same_info(found: Any, told: dict[str, Any], infos: Any, *, vector: bool) -> bool:
    if found is None:
        return False
    wanted = told if infos is True else {name: told[name] for name in infos}
    if vector:  # Gymnasium has made arrays of them, and texts of texts
        return {key: str(value) for key, value in found.items()} == {
            key: str(value) for key, value in wanted.items()
        }
    return same(found, wanted)
