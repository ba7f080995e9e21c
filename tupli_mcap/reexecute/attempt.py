"""Runs one episode again and compares it; checks whether its environment is deterministic."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Columns, Recording
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.reexecute.compare import Checker, Tally
from tupli_mcap.reexecute.reapply import EnvironmentFailedError, Moment, Reexecutor, recorded_actions
from tupli_mcap.reexecute.starts import EpisodePlan

Watch = Callable[[int], None]
"""Called with the number of each step whose state agrees, while the environment is in that state; then for the final
state."""

_BLOCK = 8 << 20  # bytes of columns that are read at a time
_SAMPLE = 2000  # most steps that are compared to see whether an environment is deterministic


class Attempt(NamedTuple):
    """The differences of an episode; `error` is set if the environment raised."""

    tally: Tally
    error: EnvironmentFailedError | None = None

    @property
    def agrees(self) -> bool:
        return self.tally.first is None and self.error is None


def attempt(
    recording: Recording,
    reexecutor: Reexecutor,
    plan: EpisodePlan,
    checker: Checker,
    watch: Watch | None = None,
) -> Attempt:
    """Runs an episode again and compares it, up to its recorded end or the environment's end; with `watch`, up to the
    first difference."""
    length = int(recording.index["length"][plan.position])
    tally = Tally(length)
    try:
        moment = reexecutor.start(plan)
        for start, columns in _blocks(recording, plan.position):
            checker.bind(columns, start)
            action_of = recorded_actions(recording, columns.actions, plain=reexecutor.plain)
            for step in range(start, start + len(columns)):
                checker.state(step, moment.state, tally)
                if watch is not None:
                    if tally.first is not None:
                        return Attempt(tally)
                    watch(step)
                moment = reexecutor.step(step, action_of(step - start))
                if not checker.result(step, moment, tally) and step + 1 < length:
                    tally.ended = step  # the environment ended the episode: no later step can be compared
                    return Attempt(tally)
        final = recording.final_state(plan.position)
        if final is not None:
            checker.final_state(length, final, moment.state, tally)
            if watch is not None and tally.first is None:
                watch(length)
    except EnvironmentFailedError as err:
        return Attempt(tally, err)
    return Attempt(tally)


def _blocks(recording: Recording, position: int) -> Iterator[tuple[int, Columns]]:
    """The number of a step and the columns from there on, until all steps of an episode have been read."""
    length, most = int(recording.index["length"][position]), max(1, _BLOCK // step_bytes(recording.layout))
    for start in range(0, length, most):
        yield start, recording.read_steps(position, start, min(length, start + most))


def repeats_itself(
    recording: Recording, plan: EpisodePlan, reexecutors: tuple[Reexecutor, Reexecutor]
) -> bool:
    """Whether two new environments return the same in the first steps of an episode with a seed."""
    first, second = (_prints(recording, plan, reexecutor) for reexecutor in reexecutors)
    return list(first) == list(second)


def _prints(recording: Recording, plan: EpisodePlan, reexecutor: Reexecutor) -> Iterator[bytes]:
    try:
        yield _print(recording.layout, reexecutor.start(plan))
        for start, columns in _blocks(recording, plan.position):
            action_of = recorded_actions(recording, columns.actions, plain=reexecutor.plain)
            for step in range(start, start + len(columns)):
                moment = reexecutor.step(step, action_of(step - start))
                yield _print(recording.layout, moment)
                if moment.terminal or moment.timeout or step + 1 == _SAMPLE:
                    return
    except EnvironmentFailedError as err:
        yield str(err).encode()


def _print(layout: StepLayout, moment: Moment) -> bytes:
    digest = hashlib.sha256(repr((moment.reward, moment.terminal, moment.timeout)).encode())
    for leaf in layout.state:
        try:
            value = leaf.get(moment.state)
        except (KeyError, IndexError, TypeError):
            value = None
        known = isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "biuf"
        digest.update(value.tobytes() if known else repr(value).encode())
    return digest.digest()
