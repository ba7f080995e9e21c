"""The check for episodes that occur more than once, in one recording or in several."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Place, Severity
from tupli_mcap.doctor.measurements import Measurements, Statistic
from tupli_mcap.doctor.message_text import share
from tupli_mcap.errors import plural
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.blocks import Block
from tupli_mcap.recording.columns.statistics import element_bounds

_SIZE = 16


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
        self._empty = hashlib.blake2b(head, digest_size=_SIZE)
        self._running = self._empty.copy()
        self._digests: list[bytes] = []

    @classmethod
    def start(cls, measured: Measurements) -> Sequence[Digests]:
        return [cls(measured)]

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
        return np.frombuffer(b"".join(self._digests), np.dtype((np.void, _SIZE)))


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
