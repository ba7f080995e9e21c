"""Checks of episodes: unfinished files, missing terminals, episodes of one step, repeated seeds, wrong resets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Severity
from tupli_mcap.doctor.measurements import Measurements, Statistic, StepPlace, value_bytes
from tupli_mcap.doctor.message_text import plural, share
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.blocks import Block
from tupli_mcap.recording.description import state_of
from tupli_mcap.recording.index import HAS_SEED

_STARTS = 4096  # episode starts that are decoded at a time


def unfinished(measured: Measurements) -> Iterator[Finding]:
    """A recording that its writer did not finish, or still works on."""
    state = state_of(measured.recording)
    if state == "recording":
        message, advice = "a writer is at work on it", "examine it again when the writer is done"
    elif state == "recovered":
        message = "its writer did not finish it; what its chunks and its journal hold is there"
        advice = "finish it with 'tupli-mcap recover'"
    elif state == "incomplete":
        message = "its writer did not finish it, and its journal is missing; what its chunks hold is there"
        advice = "copy the journal beside it, if there is one; or finish it with 'tupli-mcap recover'"
    else:
        return
    yield measured.finding("unfinished", Severity.INFO, message, advice)


def missing_terminals(measured: Measurements) -> Iterator[Finding]:
    """No episode ends in a terminal state.

    Usual where the task goes on for ever (information), if episodes end by timeout; a warning where several episodes
    have neither flag: a learner takes them for one long episode, or bootstraps from nothing. The last episode of each
    sub-environment may be interrupted.
    """
    ends: Array = measured.rows["end"]
    total, timeouts = len(ends), int((ends == TIMEOUT).sum())
    if (ends == TERMINAL).any() or total == 0:
        return
    if not timeouts and _last_interrupted(measured).all():
        return
    if timeouts:
        severity, ended = Severity.INFO, f"{timeouts:,} by timeout"
        advice = "bootstrap from the final state of each timeout; do not treat it as a terminal"
    else:
        severity, ended = Severity.WARNING, "all are interrupted"
        advice = "record terminated and truncated as the environment returns them, and step until one is true"
    message = f"none of {plural(total, 'episode')} ends in a terminal state: {ended}"
    places = () if timeouts else measured.episodes(ends == INTERRUPTED)
    yield measured.finding("missing-terminals", severity, message, advice, total, total, places)


def one_step_episodes(
    measured: Measurements, *, part: float = 0.01, usual_length: float = 10
) -> Iterator[Finding]:
    """Episodes of one step, at least `part` of all, where the median length is `usual_length` or more.

    In card games and bandits, episodes are short anyway. The last episode of a sub-environment does not count if it
    is interrupted.
    """
    one_step = (measured.lengths == 1) & ~_last_interrupted(measured)
    count, total = int(one_step.sum()), len(measured.rows)
    median = float(np.median(measured.lengths)) if count else 0.0
    if not count or median < usual_length or count < part * total:
        return
    message = f"{count:,} of {plural(total, 'episode')} ({share(count, total)}) have one step; the median is {median:g}"
    advice = (
        "look at how these ended: a reset in the wrong place, or an autoreset recorded as a step, makes them"
    )
    places = measured.episodes(one_step)
    yield measured.finding("one-step-episodes", Severity.WARNING, message, advice, count, total, places)


def _last_interrupted(measured: Measurements) -> Array:
    """The interrupted episodes that are the last of their sub-environment (bool)."""
    is_last = np.zeros(len(measured.rows), np.bool_)
    _, from_end = np.unique(measured.rows["env"][::-1], return_index=True)
    is_last[len(is_last) - 1 - from_end] = True
    mask: Array = is_last & (measured.rows["end"] == INTERRUPTED)
    return mask


def repeated_seed(measured: Measurements, *, least: int = 3, part: float = 0.5) -> Iterator[Finding]:
    """The same seed at the start of several episodes.

    A warning where one seed starts `least` or more episodes and `part` of all: `reset(seed=...)` in the loop makes
    every episode start alike. Else information: evaluations use the same seeds for several policies, but a test set
    must not share them with a training set.
    """
    seeded = measured.rows["has_seed"] == HAS_SEED
    seeds, counts = np.unique(measured.rows["seed"][seeded], return_counts=True)
    repeated = int((counts > 1).sum())
    if not repeated:
        return
    seed, count, total = seeds[np.argmax(counts)], int(counts.max()), len(measured.rows)
    more = f"; {repeated:,} seeds start more than one" if repeated > 1 else ""
    message = f"seed {seed} starts {count:,} of {plural(total, 'episode')}{more}"
    if count >= max(least, part * total):
        severity, advice = Severity.WARNING, "pass a seed to the first reset only, so that episodes differ"
    else:
        severity, advice = Severity.INFO, "keep the episodes of a seed on one side of a split into sets"
    places = measured.episodes(seeded & (measured.rows["seed"] == seed))
    yield measured.finding("repeated-seed", severity, message, advice, count, total, places)


def missing_reset(measured: Measurements) -> Iterator[Finding]:
    """Episodes that began with a step after an end: nobody reset the environment, or it does so by itself.

    The first one of a file goes on from another file, in which it was cut when that was full.
    """
    missing = _continued(measured) & (measured.rows["first_row"] > 0)
    count, total = int(missing.sum()), len(missing)
    if not count:
        return
    verb = "begins" if count == 1 else "begin"
    message = f"{plural(count, 'episode')} of {total:,} {verb} with a step after an end, without a reset"
    advice = "call reset when terminated or truncated is true; leave these episodes out"
    places = measured.episodes(missing)
    yield measured.finding("missing-reset", Severity.WARNING, message, advice, count, total, places)


def _continued(measured: Measurements) -> Array:
    """Which episodes began without a reset (bool)."""
    parts = (measured.positions[i : i + _STARTS] for i in range(0, len(measured.positions), _STARTS))
    return np.array(
        [start.continued for part in parts for start in measured.recording.episode_starts(part)], np.bool_
    )


class FinalStates(Statistic):
    """Final states that equal the first state of the next episode of the same sub-environment.

    compared: how many pairs were; equal: how many of them are, and the places of the first. Where both episodes start
    in the same state the pair is left out: an equal final state may be chance there.
    """

    def __init__(self, layout: StepLayout) -> None:
        self._layout = layout
        self._first = b""  # the first state of the running episode
        # By sub-environment, of the last episode that ended: place of the final state, first and final state.
        self._ended: dict[int, tuple[StepPlace, bytes, bytes | None]] = {}
        self.compared = self.equal = 0
        self.places: list[StepPlace] = []

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[FinalStates]:
        return [cls(measured.layout)]

    def put(self, block: Block) -> None:
        finals = {int(at): i for i, at in enumerate(block.finals_of)}
        rows = block.rows[["episode", "env", "length"]].tolist()
        for i, ((episode, env, length), start) in enumerate(zip(rows, block.starts.tolist(), strict=True)):
            if block.first_step == 0:
                self._first = self._state(block.leaves, start)
                self._compare(env)
            if block.whole:
                final = self._state(block.finals, finals[i]) if i in finals else None
                self._ended[env] = ((episode, length), self._first, final)

    def _state(self, columns: dict[str, Any], i: int) -> bytes:
        layout = self._layout
        return b"".join(value_bytes(layout, leaf, columns[leaf.name][i]) for leaf in layout.state)

    def _compare(self, env: int) -> None:
        place, first, final = self._ended.get(env, ((0, 0), b"", None))
        if final is None or first == self._first:
            return
        self.compared += 1
        if final == self._first:
            self.equal += 1
            if len(self.places) < MAX_PLACES:
                self.places.append(place)


def final_state_is_reset(measured: Measurements, *, least: int = 3, part: float = 0.5) -> Iterator[Finding]:
    """Final states that are the first observation of the next episode.

    An autoreset inside of the recorder makes them: the true last observation is lost, and bootstrapping at a timeout
    takes the value of a fresh episode. A warning from `least` episodes and `part` of those that can be compared on;
    episodes that all start in the same state cannot.
    """
    for finals in measured.statistics(FinalStates):
        count, total = finals.equal, finals.compared
        if count < max(least, part * total):
            continue
        message = (
            f"the final state of {plural(count, 'episode')} of {total:,} is the first state of the next one"
        )
        advice = (
            "record inside of the wrapper that resets by itself; do not bootstrap from these final states"
        )
        places = measured.places(finals.places)
        yield measured.finding(
            "final-state-is-reset", Severity.WARNING, message, advice, count, total, places
        )
