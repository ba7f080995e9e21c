"""Checks of episodes: unfinished files, missing terminals, one step, repeated seeds, wrong resets, duplicates."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Place, Severity, share
from tupli_mcap.doctor.measurements import Measurements, Statistic, StepPlace, value_bytes
from tupli_mcap.errors import plural
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.blocks import Block
from tupli_mcap.recording.describe.description import state_of
from tupli_mcap.recording.index import HAS_SEED, cut_off
from tupli_mcap.spaces.statistics import element_bounds

_STARTS = 4096  # episode starts that are decoded at a time
_DIGEST_BYTES = 16


def unfinished(measured: Measurements) -> Iterator[Finding]:
    """A recording that its writer did not finish, or is still writing to."""
    state = state_of(measured.recording)
    if state == "recording":
        message, advice = "a process is writing to it", "examine it again when that has finished"
    elif state == "unfinished":
        message = "its writer did not finish it; all steps of its chunks and its journal were examined"
        advice = "finish it with 'tupli-mcap recover --in-place'"
    elif state == "incomplete":
        message = "its writer did not finish it and its journal is missing; only the steps of its chunks were examined"
        advice = "copy the journal beside it if you have it, or save these steps with 'tupli-mcap recover'"
    else:
        return
    yield measured.finding("unfinished", Severity.INFO, message, advice)


def missing_terminals(measured: Measurements) -> Iterator[Finding]:
    """No episode ends in a terminal state.

    An info if episodes end by timeout, which is usual for tasks without an end. A warning if several episodes have
    neither flag: a learner may take them for one long episode, or bootstrap wrongly. The last episode of each
    sub-environment of a run may be interrupted.
    """
    ends: Array = measured.rows["end"]
    total, timeouts = len(ends), int((ends == TIMEOUT).sum())
    if (ends == TERMINAL).any() or total == 0:
        return
    if not timeouts and _cut_off(measured).all():
        return
    if timeouts:
        severity, ended = Severity.INFO, f"{timeouts:,} by timeout"
        advice = "bootstrap from the final state at each timeout; do not treat a timeout as a terminal"
    else:
        severity, ended = Severity.WARNING, "all are interrupted"
        advice = "record how each episode ends: terminal or timeout at its last step, as the environment says"
    message = f"none of {plural(total, 'episode')} ends in a terminal state: {ended}"
    places = () if timeouts else measured.episodes(ends == INTERRUPTED)
    yield measured.finding("missing-terminals", severity, message, advice, total, total, places)


def one_step_episodes(
    measured: Measurements, *, part: float = 0.01, usual_length: float = 10
) -> Iterator[Finding]:
    """Episodes of one step, if they are at least `part` of all and the median length is `usual_length` or more.

    Short episodes are usual in card games and bandits. The last episode of a sub-environment of a run does not count if
    it is interrupted.
    """
    one_step = (measured.lengths == 1) & ~_cut_off(measured)
    count, total = int(one_step.sum()), len(measured.rows)
    median = float(np.median(measured.lengths)) if count else 0.0
    if not count or median < usual_length or count < part * total:
        return
    message = f"{count:,} of {plural(total, 'episode')} ({share(count, total)}) have one step; the median is {median:g}"
    advice = "look at how they ended: usual causes are a reset in the wrong place, and an autoreset recorded as a step"
    places = measured.episodes(one_step)
    yield measured.finding("one-step-episodes", Severity.WARNING, message, advice, count, total, places)


def _cut_off(measured: Measurements) -> Array:
    return cut_off(measured.rows, measured.recording.readable_places[measured.positions])


def repeated_seed(measured: Measurements, *, least: int = 3, part: float = 0.5) -> Iterator[Finding]:
    """The same seed at the start of several episodes.

    A warning if one seed starts at least `least` episodes and `part` of all: with `reset(seed=...)` in the loop, every
    episode starts in the same way. Else an info: evaluations use the same seeds for several policies, but a test set
    must not share seeds with a training set.
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
        severity = Severity.INFO
        advice = "put all episodes of a seed into the same set when you split the data"
    places = measured.episodes(seeded & (measured.rows["seed"] == seed))
    yield measured.finding("repeated-seed", severity, message, advice, count, total, places)


def missing_reset(measured: Measurements) -> Iterator[Finding]:
    """Episodes that begin with a step after the end of another one: the environment was not reset, or resets itself.

    The first episode of a file does not count: it may continue one of the file before.
    """
    missing = _continued(measured) & (measured.rows["first_row"] > 0)
    count, total = int(missing.sum()), len(missing)
    if not count:
        return
    verb = "begins" if count == 1 else "begin"
    message = f"{plural(count, 'episode')} of {total:,} {verb} without a reset after the end of another one"
    advice = (
        "call reset once terminated or truncated is true, or put the recorder inside of the wrapper that resets; leave "
        "these episodes out"
    )
    places = measured.episodes(missing)
    yield measured.finding("missing-reset", Severity.WARNING, message, advice, count, total, places)


def _continued(measured: Measurements) -> Array:
    """Whether each episode began without a reset (bool)."""
    parts = (measured.positions[i : i + _STARTS] for i in range(0, len(measured.positions), _STARTS))
    return np.array(
        [start.continued for part in parts for start in measured.recording.episode_starts(part)], np.bool_
    )


class FinalStates(Statistic):
    """Final states that equal the first state of the next episode of the same sub-environment.

    compared: the number of compared pairs. equal: how many of them are equal; places: the first of these. A pair of
    episodes that start in the same state is not compared: its states may be equal by chance. Nor is one whose second
    begins without a reset: its first state is the final state of the first.
    """

    def __init__(self, measured: Measurements) -> None:
        self._layout = measured.layout
        self._without_reset = set(measured.rows["episode"][_continued(measured)].tolist())
        self._first = b""  # the first state of the running episode
        # By sub-environment, for the last episode that ended: place of its final state, first state, final state.
        self._ended: dict[int, tuple[StepPlace, bytes, bytes | None]] = {}
        self.compared = self.equal = 0
        self.places: list[StepPlace] = []

    def put(self, block: Block) -> None:
        finals = {int(at): i for i, at in enumerate(block.finals_of)}
        rows = block.rows[["episode", "env", "length"]].tolist()
        for i, ((episode, env, length), start) in enumerate(zip(rows, block.starts.tolist(), strict=True)):
            if block.first_step == 0:
                self._first = self._state(block.leaves, start)
                if episode not in self._without_reset:
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

    A wrapper that resets by itself inside of the recorder makes them: the true last observation is lost, and
    bootstrapping at a timeout takes the value of another episode. A warning if at least `least` episodes and `part` of
    the compared ones are affected. Episodes that start in the same state, or without a reset (see "missing-reset"), are
    not compared.
    """
    for finals in measured.statistics(FinalStates):
        count, total = finals.equal, finals.compared
        if count < max(least, part * total):
            continue
        message = (
            f"the final state of {plural(count, 'episode')} of {total:,} is the first state of the next one"
        )
        advice = (
            "put the recorder inside of the wrapper that resets; do not bootstrap from these final states"
        )
        places = measured.places(finals.places)
        yield measured.finding(
            "final-state-is-reset", Severity.WARNING, message, advice, count, total, places
        )


# ---- episodes that occur more than once


class Digests(Statistic):
    """A BLAKE2b-128 of each episode: of its states, actions, rewards and flags, not of its number, seed and times.

    log_choices: the logarithm of the number of different actions; infinite if states or actions are floats or of
    variable size: equal episodes are then no chance.
    """

    def __init__(self, measured: Measurements) -> None:
        self.path, self.lengths = measured.path, measured.lengths
        self.numbers = measured.rows["episode"].copy()
        self.log_choices = _log_choices(measured.layout)
        self._arrays = [leaf.name for leaf in measured.layout.leaves if leaf.kind != "variable"]
        self._variable = measured.layout.variable
        # The leaves belong to the content: equal bytes of other leaves are another episode.
        head = repr([(leaf.path, leaf.kind, leaf.shape) for leaf in measured.layout.leaves]).encode()
        self._empty = hashlib.blake2b(head, digest_size=_DIGEST_BYTES)
        self._running = self._empty.copy()
        self._digests: list[bytes] = []

    def put(self, block: Block) -> None:
        columns = [np.ascontiguousarray(block.leaves[name]) for name in self._arrays]
        columns += [block.columns.terminals, block.columns.timeouts]
        steps = np.concatenate([c.reshape(len(block), -1).view(np.uint8) for c in columns], axis=1)
        for i, (start, length) in enumerate(zip(block.starts.tolist(), block.lengths.tolist(), strict=True)):
            self._running.update(steps[start : start + length].data)
            for name, field in self._variable.items():
                encoded = bytearray()
                for value in block.leaves[name][start : start + length]:
                    field.encode(value, encoded, 0)
                self._running.update(encoded)
            if block.whole or i + 1 < len(block.lengths):
                self._digests.append(self._running.digest())
                self._running = self._empty.copy()

    @property
    def digests(self) -> Array:
        """A 16-byte void for each episode, in the order of reading."""
        return np.frombuffer(b"".join(self._digests), np.dtype((np.void, _DIGEST_BYTES)))


def duplicate_episodes(recordings: Sequence[Digests], *, rarity: float = 1000) -> Iterator[Finding]:
    """Episodes that are equal in every state, action, reward and flag, within a recording or across recordings.

    A learner counts them twice, and a test set with copies of training episodes measures nothing. If states and
    actions are discrete, short episodes may be equal by chance: n episodes of L steps with A choices give about
    n^2 / A^L pairs (the birthday problem, for uniform actions in a deterministic environment). Copies with
    `rarity` * n^2 >= A^L are ignored.
    """
    if not recordings:
        return
    digests, numbers, lengths = (
        np.concatenate([getattr(recording, name) for recording in recordings])
        for name in ("digests", "numbers", "lengths")
    )
    counts = [len(recording.numbers) for recording in recordings]
    owners = np.repeat(np.arange(len(recordings)), counts)
    log_choices = np.repeat([recording.log_choices for recording in recordings], counts)
    total = len(digests)
    _, first, group = np.unique(digests, return_index=True, return_inverse=True)
    by_chance = lengths * log_choices <= np.log(rarity) + 2 * np.log(total)
    copies = (np.arange(total) != first[group]) & ~by_chance
    count = int(copies.sum())
    if not count:
        return
    across = int((owners[copies] != owners[first[group[copies]]]).sum())
    equal = np.flatnonzero(group == group[np.argmax(copies)])[:MAX_PLACES]
    places = tuple(Place(recordings[owners[i]].path, int(numbers[i])) for i in equal)
    message = (
        f"{plural(count, 'episode')} of {total:,} ({share(count, total)}) "
        f"{'is an exact copy' if count == 1 else 'are exact copies'} of another one"
        f"{f', {across:,} of them across recordings' if across else ''}"
    )
    advice = "keep one of each, and no copies of training episodes in a test set"
    path = places[0].path
    yield Finding(
        "duplicate-episodes", Severity.WARNING, path, message, advice, count=count, total=total, places=places
    )


def _log_choices(layout: StepLayout) -> float:
    if any(leaf.dtype is None or leaf.dtype.kind == "f" for leaf in (*layout.state, *layout.action)):
        return math.inf
    limits = (element_bounds(leaf) for leaf in layout.action)
    return sum(float(np.log(high.astype(np.float64) - low + 1).sum()) for low, high in limits)
