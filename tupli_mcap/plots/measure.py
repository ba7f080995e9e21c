"""Reads a recording for a report: numbers of its episodes, values of its steps, and some episodes step by step."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from tupli_mcap import jsonvalue
from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.messages.infos import numbers_in, with_text_keys
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.plots.statistics import LARGEST, LeafValues, drawable_numbers
from tupli_mcap.recording import Columns, Recording, Run
from tupli_mcap.recording.about.success import KEYS, success_of
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.recording.describe.description import RecordingDescription, describe, nan_text
from tupli_mcap.recording.describe.series import infos_at_places
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.leaves import Leaf

READ_BYTES = 128 << 20  # as messages, of the steps that a report reads at most; their values stay in memory
MAX_POINTS = 4000  # of a trace
INFO_STEPS, INFO_BYTES = 20_000, 16 << 20  # of the infos that are read at most: each is JSON
_INFO_PLACES, _MOST_KEYS, _MOST_NAMED = 40, 64, 8
# a key of `Measured.numbers`, and how others begin
SUCCESS, INFO, METADATA = "success", "info.", "metadata."
_FIELDS = ("states", "actions", "rewards")
_FRAMES, _AVERAGED = 6, 48  # that are shown, that make up the mean picture


@dataclass
class Measured:
    """One recording.

    index: the index rows of all episodes of the run. positions: of the chosen episodes in `index`. run: their run.
    is_recorded: see `Recording.is_recorded`. spaces: those of states and of actions; None of a file without spaces.
    numbers: numbers of each chosen episode, NaN if missing: `success` (0 or 1), `metadata.key`, and `info.key`, the
    mean over those of its steps that are read. info_steps, read_infos: how many steps have an info, and are read.
    other_infos: names of infos without a finite number, or with many.
    read_episodes, read_steps: how many episodes and steps the values are from.
    states, actions, rewards: the values of their leaves. seeds: the different seeds of the chosen episodes, ascending.
    """

    name: str
    facts: RecordingDescription
    run: Run
    is_recorded: bool
    index: Array
    positions: Array
    spaces: tuple[gym.Space[Any], gym.Space[Any]] | None
    numbers: dict[str, Array] = field(default_factory=dict)
    info_steps: int = 0
    read_infos: int = 0
    other_infos: list[str] = field(default_factory=list)
    step_seconds: float | None = None
    read_episodes: int = 0
    read_steps: int = 0
    states: list[LeafValues] = field(default_factory=list)
    actions: list[LeafValues] = field(default_factory=list)
    rewards: list[LeafValues] = field(default_factory=list)
    seeds: list[int] = field(default_factory=list)

    @property
    def rows(self) -> Array:
        """The index rows of the chosen episodes."""
        return self.index[self.positions]

    @property
    def steps(self) -> int:
        """Steps of the chosen episodes."""
        return int(self.rows["length"].sum())

    @property
    def leaves(self) -> list[LeafValues]:
        """The values of the leaves of states, actions and rewards."""
        return [*self.states, *self.actions, *self.rewards]

    def notes(self) -> list[str]:
        """Sentences about what the report leaves out, and what it samples."""
        notes = []
        if self.read_steps < self.steps:
            notes.append(
                f"Values are those of {self.read_episodes:,} randomly chosen episodes ({self.read_steps:,} steps)."
            )
        if self.read_infos < self.info_steps:
            notes.append(f"Infos are those of {self.read_infos:,} of {self.info_steps:,} steps.")
        if self.other_infos:
            more = len(self.other_infos) - _MOST_NAMED
            names = ", ".join(key[:40] for key in self.other_infos[:_MOST_NAMED])
            names += f" and {more:,} more" if more > 0 else ""
            notes.append(f"Infos that are no numbers, or many, are not shown: {names}.")
        for leaf in self.leaves:
            notes += leaf.notes()
        odd = int(np.isnan(self.rows["return"]).sum())
        if odd:
            notes.append(f"return: {nan_text(odd, len(self.rows))}.")
        if not len(self.rows):
            notes.append("There is no episode.")
        return notes


def measure(recording: Recording, positions: Array, read_bytes: int = READ_BYTES) -> list[Measured]:
    """Reads the episodes at some positions, those of each run by themselves; if they have more than `read_bytes`, a
    random choice of them. Without episodes, the first run has none. Raises FormatError if the recording is damaged."""
    facts, places = describe(recording), recording.readable_places
    runs = dict.fromkeys(places[positions].tolist()) or [0]
    return [
        _measure(recording, facts, run, positions[places[positions] == run], read_bytes // len(runs))
        for run in runs
    ]


def _measure(
    recording: Recording, facts: RecordingDescription, run: int, positions: Array, read_bytes: int
) -> Measured:
    layout = recording.layout if recording.num_envs else None
    spaces = None if layout is None else (layout.observation_space, layout.action_space)
    rows, of_run = recording.index[positions], np.flatnonzero(recording.readable_places == run)
    measured = Measured(
        recording.name, facts, recording.readable_runs[run], recording.is_recorded, recording.index[of_run],
        np.searchsorted(of_run, positions), spaces, _metadata_numbers(recording, positions),
    )  # fmt: skip
    if layout is None:
        return measured
    _add_infos(recording, measured)
    labels = recording.labels
    seeds, measured.step_seconds = recording.seeds, labels.step_seconds
    measured.seeds = sorted({seed for i in positions.tolist() if (seed := seeds[i]) is not None})
    most = max(1, read_bytes // step_bytes(layout, images=False))
    chosen = _random_episodes(positions, rows["length"].astype(np.int64), most)
    columns, measured.read_steps, measured.read_episodes = read_numbers(recording, chosen, most)
    measured.states, measured.actions, measured.rewards = (
        [LeafValues(leaf, labels, columns.pop(leaf.name, None)) for leaf in leaves]
        for leaves in (layout.state, layout.action, layout.reward)
    )
    return measured


def read_numbers(recording: Recording, positions: Array, most: int) -> tuple[dict[str, Array], int, int]:
    """The steps of the first of some episodes that have at most `most` (> 0) steps together, or the beginning of a
    longer one: by leaf as `number_columns`; and how many steps and episodes they are."""
    lengths = recording.index["length"][positions].astype(np.int64)
    fitting = max(1, int(np.searchsorted(np.cumsum(lengths), most, side="right")))
    positions, lengths = positions[:fitting], lengths[:fitting]
    if len(positions) == 1 and lengths[0] > most:
        columns = recording.read_steps(int(positions[0]), 0, most, _FIELDS, images=False)
    else:
        columns = recording.read(_FIELDS, episodes=positions, images=False)
    found = {leaf.name: column for _, leaf, column in number_columns(recording.layout, columns)}
    return found, len(columns), len(positions)


def number_columns(layout: StepLayout, columns: Columns) -> Iterator[tuple[str, Leaf, Array]]:
    """The leaves that are neither texts nor images: "state", "action" or "reward", and the values (steps, size)."""
    for root, leaves, values in (
        ("state", layout.state, columns.states),
        ("action", layout.action, columns.actions),
        ("reward", layout.reward, columns.rewards),
    ):
        for leaf in leaves:
            if leaf.kind != "variable" and not leaf.apart:
                yield root, leaf, np.asarray(leaf.get(values)).reshape(len(columns), leaf.size)


def _metadata_numbers(recording: Recording, positions: Array) -> dict[str, Array]:
    """The numbers in the metadata of some episodes, and whether the episodes succeeded."""
    texts = recording.all_metadata()
    numbers: dict[str, Array] = {}
    for at, position in enumerate(positions.tolist()):
        if texts[position] == "{}":
            continue
        said = jsonvalue.loads(texts[position])
        found = {SUCCESS: success_of(said), **dict(_metadata_entries(said))}
        for key, value in found.items():
            if value is not None and (key in numbers or len(numbers) < _MOST_KEYS):
                numbers.setdefault(key, np.full(len(positions), np.nan))[at] = float(value)
    return numbers


def _metadata_entries(said: Any) -> Iterator[tuple[str, float]]:
    """The entries of metadata that are numbers, by their names, except those for success."""
    for key, value in said.items() if isinstance(said, Mapping) else ():
        # an integer may be too large for a float
        if key not in KEYS and isinstance(value, int | float) and -LARGEST <= value <= LARGEST:
            yield name_within("metadata", key), float(value)


def drawable_infos(infos: Sequence[Mapping[Any, Any]]) -> list[tuple[str, str, Array]]:
    """The key, name and values of each column of infos that can be drawn (float64, NaN for what cannot), without those
    for success."""
    columns = [
        (key, name, drawable_numbers(values.filled(np.nan)))
        for key, name, values in numbers_in(list(map(with_text_keys, infos)))
        if key not in KEYS
    ]
    return [column for column in columns if np.isfinite(column[2]).any()]


def _add_infos(recording: Recording, measured: Measured) -> None:
    """Means over the steps of each episode; of many steps, over those at a few places of the recording.

    A step whose info does not have the key does not count.
    """
    at = {episode: i for i, episode in enumerate(measured.rows["episode"].tolist())}
    measured.info_steps, read = infos_at_places(recording, INFO_STEPS, INFO_BYTES, _INFO_PLACES)
    measured.read_infos = len(read)
    infos = [info for episode, info in read if episode in at]
    of = np.array([at[episode] for episode, _ in read if episode in at], np.int64)
    found = drawable_infos(infos)
    others = {str(key) for info in infos for key in info} - {key for key, *_ in found} - {*KEYS}
    measured.other_infos = sorted(name_within("info", key) for key in others)
    for _, name, values in found[:_MOST_KEYS]:
        known = np.isfinite(values)
        sums = np.bincount(of[known], values[known], len(at))
        with np.errstate(invalid="ignore"):
            measured.numbers[name] = sums / np.bincount(of[known], minlength=len(at))


def _random_episodes(positions: Array, lengths: Array, most: int) -> Array:
    """All positions if they have at most so many steps; else a random choice (always the same) of at least one."""
    order = np.random.default_rng(0).permutation(len(positions))
    fitting = max(1, int(np.searchsorted(np.cumsum(lengths[order]), most, side="right")))
    return positions[np.sort(order[:fitting])]


class Trace(NamedTuple):
    """One episode, step by step; of a long one, the smallest and the largest of every `thinned` (> 1) steps.

    values: leaf name -> (points, elements), float64, at the steps `at` (points); NaN for what cannot be drawn.
    infos: `info.key` -> (points), as well; only where all infos of the recording are read.
    totals: the running return. pictures: some recorded frames ("frame"), and some images of each leaf that holds them,
    by its name (H x W or H x W x 1|3|4), with their titles.
    """

    episode: int
    env: int
    length: int
    total: float
    end: str
    seed: int | None
    thinned: int
    at: Array
    values: dict[str, Array]
    infos: dict[str, Array]
    totals: Array
    pictures: dict[str, list[tuple[str, Array]]]


def trace(recording: Recording, number: int, measured: Measured) -> Trace:
    """The episode with a number, of a recording that was measured; of one of more than `READ_BYTES`, the first steps.
    Raises FormatError if the recording is damaged."""
    position = int(np.flatnonzero(recording.index["episode"] == number)[0])
    row = recording.index[position]
    length = int(row["length"])
    width = 1 if length <= MAX_POINTS else -(-length // (MAX_POINTS // 2))
    most = max(1, READ_BYTES // step_bytes(recording.layout, images=False))
    columns, steps, _ = read_numbers(recording, np.array([position]), most)
    rewards = np.concatenate([columns[leaf.leaf.name] for leaf in measured.rewards], axis=1)
    with np.errstate(over="ignore", invalid="ignore"):  # returns beyond all floats are not drawn
        totals = drawable_numbers(rewards.astype(np.float64).sum(axis=1).cumsum())
    values = {
        leaf.leaf.name: thinned(drawable_numbers(columns[leaf.leaf.name][:, leaf.elements]), width)
        for leaf in measured.leaves
        if len(leaf.elements)
    }
    infos: dict[str, Array] = {}
    if measured.info_steps and measured.read_infos == measured.info_steps:
        said = [info or {} for info in recording.infos(position) or ()]
        infos = {name: values for _, name, values in drawable_infos(said)}
    pictures = {"frame": _frames(recording, position)}
    pictures |= {
        leaf.leaf.path: _pictures(recording, position, length, leaf.leaf)
        for leaf in measured.leaves
        if leaf.kind == "picture"
    }
    return Trace(
        int(row["episode"]), int(row["env"]), length, float(row["return"]), END_NAMES[row["end"]],
        recording.episode_start(position).seed_number, width, thinned(np.arange(steps)[:, None], width)[:, 0],
        values, {key: thinned(column[:steps, None], width)[:, 0] for key, column in infos.items()},
        thinned(totals[:, None], width)[:, 0],
        {name: shown for name, shown in pictures.items() if shown},
    )  # fmt: skip


def thinned(values: Array, width: int) -> Array:
    """(steps, elements) to (points, elements): the smallest and the largest of every `width` steps; NaN is neither."""
    if width == 1:
        return values
    starts = np.arange(0, len(values), width)
    ends = [np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)]
    return np.stack(ends, axis=1).reshape(-1, values.shape[1])


def thinned_to(most: int, values: Array) -> Array:
    """At most about `most` of many values (steps), as `thinned`."""
    width = 1 if len(values) <= most else -(-len(values) // (most // 2))
    return thinned(values[:, None], width)[:, 0]


def _frames(recording: Recording, position: int) -> list[tuple[str, Array]]:
    """Recorded frames of an episode at even distances; none if none were recorded."""
    frames = recording.frames(position)
    chosen = np.unique(np.linspace(0, len(frames) - 1, _FRAMES).astype(np.int64)) if len(frames) else ()
    return [(f"step {frames.steps[i]}", frames[int(i)]) for i in chosen]


def _pictures(recording: Recording, position: int, length: int, leaf: Leaf) -> list[tuple[str, Array]]:
    """The pictures of a leaf in an episode at even distances, and the mean of more of them, without gaps (NaN, inf)."""
    shown, averaged = (
        np.unique(np.linspace(0, length - 1, count).astype(np.int64)).tolist()
        for count in (_FRAMES, _AVERAGED)
    )
    pictures = []
    total, counts = np.zeros(()), np.zeros(())  # of each pixel, over the steps where it is a number
    for step in sorted({*shown, *averaged}):
        field = f"{leaf.root}s"
        value = leaf.get(recording.read_steps(position, step, step + 1, (field,))[field])[0]
        if leaf.kind == "stack":
            value = leaf.newest(value)
        frame = value if value.ndim == 2 or value.shape[2] in (1, 3, 4) else value[-1]
        frame = frame if leaf.dtype == np.uint8 else drawable_numbers(frame)
        if step in shown:
            pictures.append((f"step {step}", frame))
        if step in averaged:
            known = np.isfinite(frame)
            total, counts = total + np.where(known, frame, 0), counts + known
    mean = np.divide(total, counts, out=np.full(total.shape, np.nan), where=counts > 0)
    pictures.append((f"mean of {len(averaged)}", mean))
    titles, frames = zip(*pictures, strict=True)
    return list(zip(titles, _shades(np.stack(frames), leaf), strict=True))


def _shades(values: Array, leaf: Leaf) -> Array:
    """Values of pictures as uint8; those that are no bytes, such as depths, from the smallest to the largest of
    them."""
    if leaf.dtype == np.uint8:
        return values.astype(np.uint8)
    known = values[np.isfinite(values)]
    low, high = (known.min(), known.max()) if len(known) else (0.0, 0.0)
    scaled = (np.where(np.isfinite(values), values, low) - low) * (255 / (high - low) if high > low else 0)
    return scaled.astype(np.uint8)
