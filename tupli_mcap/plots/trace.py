"""One episode, step by step; a long one is thinned to its highest and lowest values."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.episodes import END_NAMES
from tupli_mcap.plots.series import drawn
from tupli_mcap.plots.values import LeafValues
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import blocks
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["Pictures", "Trace", "trace"]

MAX_POINTS = 4000
FRAMES = 6
_MEAN_OF = 48  # frames that make up the mean picture


@dataclass
class Pictures:
    """Frames of a picture leaf (uint8, H x W or H x W x 3|4) at some steps, and the mean of `averaged` frames."""

    leaf: Leaf
    steps: list[int]
    frames: list[Array]
    mean: Array
    averaged: int


@dataclass
class Trace:
    """One episode.

    values: leaf name -> (points, elements), float64, at the steps `at` (points); NaN for what cannot be
    drawn. thinned: where it is more than 1, two points stand for so many steps: the smallest and the largest value
    among them. totals: the running return.
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
    totals: Array
    pictures: list[Pictures] = field(default_factory=list)


def trace(recording: Recording, position: int, leaves: list[LeafValues]) -> Trace:
    """The episode at a position; `leaves` are those of the recording's states, actions and rewards.

    Raises:
        FormatError: the recording is damaged.
    """
    row = recording.index[position]
    length = int(row["length"])
    width = 1 if length <= MAX_POINTS else -(-length // (MAX_POINTS // 2))
    shown = [leaf for leaf in leaves if len(leaf.elements)]
    parts: dict[str, list[Array]] = {leaf.leaf.name: [] for leaf in shown}
    totals: list[Array] = []
    thinners = {name: _Thinner(width) for name in [*parts, ""]}
    total = 0.0
    for block in blocks(recording, np.array([position]), images=False, finals=False):
        for leaf in shown:
            column = block.leaves[leaf.leaf.name]
            flat = column.reshape(len(column), -1)[:, leaf.elements]
            parts[leaf.leaf.name] += thinners[leaf.leaf.name].put(drawn(flat))
        running = total + _step_rewards(block.leaves, leaves).cumsum()
        total = float(running[-1])
        totals += thinners[""].put(drawn(running)[:, None])
    values = {name: np.concatenate([*found, *thinners[name].rest()]) for name, found in parts.items()}
    running = np.concatenate([*totals, *thinners[""].rest()])[:, 0]
    seed = recording.episode_start(position).seed_number  # the index holds none beyond 64 bits
    at = np.arange(length) if width == 1 else np.repeat(np.arange(0, length, width), 2)
    if width > 1:
        at[1::2] = np.minimum(at[1::2] + width // 2, length - 1)
    return Trace(
        int(row["episode"]), int(row["env"]), length, float(row["return"]), END_NAMES[row["end"]], seed, width, at,
        values, running, _pictures(recording, position, length, leaves),
    )  # fmt: skip


def _step_rewards(columns: dict[str, Any], leaves: list[LeafValues]) -> Array:
    """The sum of all elements of a step's reward, as the return is defined."""
    found = [np.asarray(columns[v.leaf.name], np.float64) for v in leaves if v.leaf.path.startswith("reward")]
    total: Array = np.sum([column.reshape(len(column), -1).sum(axis=1) for column in found], axis=0)
    return total


class _Thinner:
    """Puts the smallest and the largest of every `width` steps in their place; NaN counts as nothing."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._left: Array | None = None

    def put(self, values: Array) -> list[Array]:
        if self._width == 1:
            return [values]
        if self._left is not None:
            values = np.concatenate([self._left, values])
        whole = len(values) // self._width * self._width
        self._left = values[whole:]
        return [_ends(values[:whole].reshape(-1, self._width, values.shape[1]))] if whole else []

    def rest(self) -> list[Array]:
        left = self._left
        return [_ends(left[None])] if left is not None and len(left) else []


def _ends(values: Array) -> Array:
    """(bins, steps, elements) to (2 * bins, elements)."""
    ends = np.stack([np.fmin.reduce(values, axis=1), np.fmax.reduce(values, axis=1)], axis=1)
    return ends.reshape(-1, values.shape[2])


def _pictures(recording: Recording, position: int, length: int, leaves: list[LeafValues]) -> list[Pictures]:
    chosen = [values.leaf for values in leaves if values.kind == "picture"]
    if not chosen or not length:
        return []
    shown = np.unique(np.linspace(0, length - 1, FRAMES).astype(np.int64)).tolist()
    averaged = np.unique(np.linspace(0, length - 1, _MEAN_OF).astype(np.int64)).tolist()
    found = [Pictures(leaf, shown, [], np.zeros(0), len(averaged)) for leaf in chosen]
    for step in sorted({*shown, *averaged}):
        states = recording.read_steps(position, step, step + 1, ("states",)).states
        for pictures in found:
            frame = _picture(pictures.leaf, pictures.leaf.get(states)[0])
            if step in shown:
                pictures.frames.append(frame)
            if step in averaged:
                pictures.mean = frame.astype(np.float64) + (pictures.mean if pictures.mean.size else 0)
    for pictures in found:
        pictures.mean = (pictures.mean / pictures.averaged).astype(np.uint8)
    return found


def _picture(leaf: Leaf, value: Array) -> Array:
    """H x W or H x W x 3|4: the last of a stack; one channel becomes none."""
    if leaf.kind == "stack":
        value = value[..., -1] if leaf.frames_last else value[-1]
    if value.ndim == 3 and value.shape[2] in (3, 4):
        return value
    if value.ndim == 3 and value.shape[2] == 1:
        return value[:, :, 0]
    return value[-1] if value.ndim == 3 else value
