"""Runs one episode again and compares it; checks whether its environment is deterministic."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.reexecute.compare import Checker, Tally
from tupli_mcap.reexecute.reapply import EnvironmentFailedError, Moment, Reexecutor, recorded_actions
from tupli_mcap.reexecute.recorded_values import RecordedValues
from tupli_mcap.reexecute.starts import EpisodePlan

Watch = Callable[[int], None]
"""Called with the number of each step whose state agrees, while the environment is in that state; then for the final
state."""

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
    values: RecordedValues,
    checker: Checker,
    watch: Watch | None = None,
) -> Attempt:
    """Runs an episode again and compares it, up to its recorded end or the environment's end; with `watch`, up to the
    first difference."""
    tally = Tally(values.length)
    try:
        moment = reexecutor.start(plan)
        for block in values:
            checker.bind(block.columns, block.start)
            action_of = recorded_actions(recording, block.columns.actions, plain=reexecutor.plain)
            for step in range(block.start, block.stop):
                checker.state(step, moment.state, tally)
                if watch is not None:
                    if tally.first is not None:
                        return Attempt(tally)
                    watch(step)
                moment = reexecutor.step(step, action_of(step - block.start))
                if not checker.result(step, moment, tally) and step + 1 < values.length:
                    tally.ended = step  # the environment ended the episode: no later step can be compared
                    return Attempt(tally)
        final = values.final_state
        if final is not None:
            checker.final_state(values.length, final, moment.state, tally)
            if watch is not None and tally.first is None:
                watch(values.length)
    except EnvironmentFailedError as err:
        return Attempt(tally, err)
    return Attempt(tally)


def repeats_itself(
    recording: Recording,
    plan: EpisodePlan,
    values: RecordedValues,
    reexecutors: tuple[Reexecutor, Reexecutor],
) -> bool:
    """Whether two new environments return the same in the first steps of an episode with a seed."""
    first, second = (_prints(recording, plan, values, reexecutor) for reexecutor in reexecutors)
    return list(first) == list(second)


def _prints(
    recording: Recording, plan: EpisodePlan, values: RecordedValues, reexecutor: Reexecutor
) -> Iterator[bytes]:
    try:
        yield _print(recording.layout, reexecutor.start(plan))
        for block in values:
            action_of = recorded_actions(recording, block.columns.actions, plain=reexecutor.plain)
            for step in range(block.start, min(block.stop, _SAMPLE)):
                moment = reexecutor.step(step, action_of(step - block.start))
                yield _print(recording.layout, moment)
                if moment.terminal or moment.timeout:
                    return
            if block.stop >= _SAMPLE:
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
