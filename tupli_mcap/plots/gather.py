"""What a report shows of one recording: measured in one pass over its steps, a few megabytes at a time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import EpisodeStart
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.plots.series import LARGEST
from tupli_mcap.plots.trace import Trace
from tupli_mcap.plots.values import LeafValues
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import blocks, step_bytes
from tupli_mcap.recording.description import RecordingDescription, describe
from tupli_mcap.spaces.element_names import short_path

__all__ = ["Measured", "measure"]

READ_BYTES = 2 << 30
"""Steps that are read at most, in bytes of their messages; of longer recordings, randomly chosen episodes."""
READ_VARIABLE = 50_000
"""The same for steps of variable size, which are decoded one by one."""
SAMPLE_STEPS = 1 << 16
_SAMPLE_BYTES = 32 << 20


@dataclass
class Measured:
    """One recording.

    rows: the index rows of its chosen episodes. read_episodes, read_steps: how many of those the values are from.
    states, actions, rewards: their leaves. seeds: of the chosen episodes, each once, ascending.
    trace: one episode, step by step; None without any.
    """

    name: str
    facts: RecordingDescription
    rows: Array
    all_episodes: int
    layout: StepLayout | None
    step_seconds: float | None = None
    read_episodes: int = 0
    read_steps: int = 0
    states: list[LeafValues] = field(default_factory=list)
    actions: list[LeafValues] = field(default_factory=list)
    rewards: list[LeafValues] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)
    trace: Trace | None = None

    @property
    def steps(self) -> int:
        """Steps of the chosen episodes."""
        return int(self.rows["length"].sum())

    @property
    def leaves(self) -> list[LeafValues]:
        return [*self.states, *self.actions, *self.rewards]

    def notes(self) -> list[str]:
        """What the report leaves out, and what it takes a sample of; sentences."""
        found = []
        if self.read_steps < self.steps:
            found.append(
                f"Values are those of {self.read_episodes:,} randomly chosen episodes ({self.read_steps:,} steps)."
            )
        sampled = min(
            (len(leaf.sample) for leaf in self.leaves if len(leaf.elements)), default=self.read_steps
        )
        if sampled < self.read_steps:
            found.append(
                f"Histograms of numbers show {sampled:,} randomly chosen steps; counts of choices, means and "
                "ranges are exact."
            )
        for leaf in self.leaves:
            found += _notes_of(leaf)
        return found


def measure(recording: Recording, positions: Array) -> Measured:
    """Everything but the trace.

    Raises:
        FormatError: the recording is damaged.
    """
    layout = recording.layout if recording.num_envs else None
    rows = recording.index[positions]
    found = Measured(recording.name, describe(recording), rows, len(recording.index), layout)
    if layout is None:
        return found
    found.seeds = _seeds(recording, rows)
    labels = recording.labels
    found.step_seconds = labels.step_seconds
    found.states = [LeafValues(leaf, labels) for leaf in layout.state]
    found.actions = [LeafValues(leaf, labels) for leaf in layout.action]
    found.rewards = [LeafValues(leaf, labels) for leaf in layout.reward]
    chosen, steps = _read_positions(layout, positions, rows["length"].astype(np.int64))
    sample = _sample(steps, layout)
    for block in blocks(recording, chosen, images=False, finals=False):
        size = min(len(block), steps - found.read_steps)
        first, last = np.searchsorted(sample, (found.read_steps, found.read_steps + size))
        sampled = sample[first:last] - found.read_steps
        for leaf in found.leaves:
            if not leaf.leaf.apart:
                leaf.put(block.leaves[leaf.leaf.name][:size], sampled)
        found.read_steps += size
        found.read_episodes += int((block.lengths > 0).sum()) if block.first_step == 0 else 0
        if found.read_steps >= steps:
            break
    for leaf in found.leaves:
        leaf.finish()
    return found


def _seeds(recording: Recording, rows: Array) -> list[int]:
    """The seeds of some episodes, each once: those of the index, and the larger ones, which only starts hold."""
    known = rows["has_seed"] != 0
    found = set(rows["seed"][known].tolist())
    starts = rows["start_row"][~known].astype(np.int64)
    if len(starts):
        first, wanted = int(starts.min()), set(starts.tolist())
        bodies = recording._store.bodies(
            recording._channel("/episode_start"), first, int(starts.max()) + 1 - first
        )
        for row, body in enumerate(bodies, first):
            if row in wanted and (seed := EpisodeStart.decode(body).seed_number) is not None:
                found.add(seed)
    return sorted(found)


def _read_positions(layout: StepLayout, positions: Array, lengths: Array) -> tuple[Array, int]:
    """The episodes to read, and how many of their steps."""
    limit = READ_BYTES // step_bytes(layout, images=False) if layout.constant else READ_VARIABLE
    total = int(lengths.sum())
    if total <= limit:
        return positions, total
    order = np.random.default_rng(0).permutation(len(positions))
    fitting = max(1, int(np.searchsorted(np.cumsum(lengths[order]), limit, side="right")))
    chosen = np.sort(order[:fitting])
    return positions[chosen], min(limit, int(lengths[chosen].sum()))


def _sample(steps: int, layout: StepLayout) -> Array:
    """Which of the steps the sample holds: all, or randomly chosen ones, always the same; sorted."""
    most = min(SAMPLE_STEPS, max(1, _SAMPLE_BYTES // step_bytes(layout, images=False)))
    if steps <= most:
        return np.arange(steps)
    return np.sort(np.random.default_rng(0).choice(steps, most, replace=False, shuffle=False))


def _notes_of(leaf: LeafValues) -> list[str]:
    name = short_path(leaf.leaf)
    if leaf.kind == "variable":
        return [f"{name} is of variable size ({type(leaf.leaf.space).__name__}) and not shown."]
    if leaf.kind == "empty":
        return [f"{name} has no elements (shape {leaf.leaf.shape})."]
    notes = []
    if leaf.elements.size and len(leaf.elements) < leaf.leaf.size:
        notes.append(
            f"Of the {leaf.leaf.size:,} elements of {name}, {len(leaf.elements)} at even distances are shown."
        )
    odd = [
        f"{int(counts.sum()):,} {word}"
        for counts, word in (
            (leaf.nan, "NaN"),
            (leaf.infinite, "infinite"),
            (leaf.outside, "outside of the space"),
        )
        if counts.sum()
    ]
    with np.errstate(invalid="ignore"):
        if (np.maximum(np.abs(leaf.least), np.abs(leaf.most)) > LARGEST).any():
            notes.append(f"{name}: values beyond {LARGEST:g} are not drawn.")
    if odd:
        notes.append(f"{name}: {', '.join(odd)} values are left out.")
    return notes
