"""Checks of what is there more than once: episodes, and seeds."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tupli_mcap.doctor.chart import Chart
from tupli_mcap.doctor.findings import MAX_PLACES, Finding, Place, Severity
from tupli_mcap.doctor.words import plural, share
from tupli_mcap.recording.blocks import Array

__all__ = ["Contents", "duplicate_episodes", "repeated_seed"]


@dataclass(frozen=True)
class Contents:
    """What stays of a chart to compare recordings: arrays of one entry an episode.

    choices: how many actions there are; 0 where chance makes no equal episodes (states or actions of floats).
    """

    path: str
    digests: Array
    numbers: Array
    lengths: Array
    choices: int

    @classmethod
    def of(cls, chart: Chart) -> Contents | None:
        """None for a recording of which no step was read."""
        if chart.digests is None or not len(chart.rows):
            return None
        numbers = chart.rows["episode"].copy()
        return cls(chart.path, chart.digests.values, numbers, chart.lengths, _choices(chart))


def duplicate_episodes(recordings: Sequence[Contents], *, rarity: float = 1000) -> Iterator[Finding]:
    """Episodes that are equal in every state, action, reward and flag, within a recording and across recordings.

    Where states and actions are discrete, short episodes are equal by chance: n episodes of L steps with A choices give
    about n^2 / A^L pairs (the birthday problem, for uniform actions in a deterministic environment). Copies with
    `rarity` * n^2 >= A^L are information, others a warning: a learner counts them twice, and a test set with
    copies of the training set measures nothing.
    """
    if not recordings:
        return
    digests = np.concatenate([found.digests for found in recordings])
    total = len(digests)
    _, first, inverse = np.unique(digests, return_index=True, return_inverse=True)
    copies = np.arange(total) != first[inverse]
    if not copies.any():
        return
    lengths = np.concatenate([found.lengths for found in recordings]).astype(np.float64)
    choices = np.concatenate([np.full(len(found.digests), float(found.choices)) for found in recordings])
    alike = np.array([(choices == found.choices).sum() for found in recordings], np.float64)
    pairs = 2 * np.log(np.repeat(alike, [len(found.digests) for found in recordings]))
    chance = (choices > 0) & (lengths * np.log(np.maximum(choices, 1)) <= np.log(rarity) + pairs)
    owners = np.repeat(np.arange(len(recordings)), [len(found.digests) for found in recordings])
    numbers = np.concatenate([found.numbers for found in recordings])
    for severity, chosen in ((Severity.WARNING, copies & ~chance), (Severity.INFO, copies & chance)):
        count = int(chosen.sum())
        if not count:
            continue
        group = inverse[np.flatnonzero(chosen)[0]]
        members = np.flatnonzero(inverse == group)
        apart = owners[chosen] != owners[first[inverse[chosen]]]
        files = f", {int(apart.sum()):,} of them across recordings" if apart.any() else ""
        places = [Place(recordings[owners[i]].path, int(numbers[i])) for i in members[:MAX_PLACES]]
        yield Finding(
            "duplicate-episodes",
            severity,
            places[0].path,
            f"{plural(count, 'episode')} of {total:,} ({share(count, total)}) "
            f"{'is an exact copy' if count == 1 else 'are exact copies'} of another one{files}"
            + ("; short episodes are equal by chance" if severity is Severity.INFO else ""),
            "keep one of each, or split by content: copies in training and test set make the test worthless"
            if severity is Severity.WARNING
            else "nothing, if the environment is small and discrete",
            count=count,
            total=total,
            places=tuple(places),
        )


def _choices(chart: Chart) -> int:
    """How many actions there are; 0 where states or actions are continuous, and chance makes no equal episodes."""
    if any(_is_continuous(leaf.space) for leaf in chart.leaves("state")):
        return 0
    total = 1
    for leaf in chart.leaves("action"):
        if isinstance(leaf.space, spaces.Discrete):
            total *= int(leaf.space.n)
        elif isinstance(leaf.space, spaces.MultiDiscrete):
            total *= math.prod(int(n) for n in leaf.space.nvec.flat)
        elif isinstance(leaf.space, spaces.MultiBinary):
            total *= 2 ** min(leaf.size, 62)
        else:
            return 0
    return min(total, 1 << 60)


def _is_continuous(space: gym.Space[Any] | None) -> bool:
    """Whether there are floats in it, at any depth."""
    if isinstance(space, spaces.Box):
        return space.dtype.kind == "f" and space.low.size > 0
    if isinstance(space, spaces.Dict):
        return any(_is_continuous(part) for part in space.values())
    if isinstance(space, spaces.Tuple | spaces.OneOf):
        return any(_is_continuous(part) for part in space.spaces)
    if isinstance(space, spaces.Sequence):
        return _is_continuous(space.feature_space)
    if isinstance(space, spaces.Graph):
        return _is_continuous(space.node_space) or _is_continuous(space.edge_space)
    return False


def repeated_seed(chart: Chart, *, least: int = 3, part: float = 0.5) -> Iterator[Finding]:
    """The same seed at the start of several episodes.

    A warning where one seed starts `least` or more episodes and `part` of all: `reset(seed=...)` in the loop makes
    every episode start alike. Else information: evaluations use the same seeds for several policies.
    """
    seeded = chart.rows["has_seed"].astype(np.bool_)
    values, inverse, counts = np.unique(chart.rows["seed"][seeded], return_inverse=True, return_counts=True)
    again = int((counts > 1).sum())
    if not again:
        return
    group = int(np.argmax(counts))
    most, total = int(counts[group]), len(chart.rows)
    chosen = np.zeros(total, np.bool_)
    chosen[np.flatnonzero(seeded)[inverse == group]] = True
    looped = most >= max(least, part * total)
    yield Finding(
        "repeated-seed",
        Severity.WARNING if looped else Severity.INFO,
        chart.path,
        f"seed {values[group]} starts {most:,} of {plural(total, 'episode')}"
        + (f"; {again:,} seeds start more than one" if again > 1 else ""),
        "pass a seed to the first reset only, so that episodes differ"
        if looped
        else "nothing, if several policies were evaluated on the same seeds",
        count=most,
        total=total,
        places=chart.episodes(chosen),
    )
