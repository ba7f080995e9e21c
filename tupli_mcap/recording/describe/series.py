"""Sums a recording up in a few short series of numbers, for `info`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.errors import TupliError
from tupli_mcap.messages.infos import numbers_in, with_text_keys
from tupli_mcap.messages.topics import INFO
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.recording.columns.read import Columns
from tupli_mcap.recording.recording import Recording
from tupli_mcap.spaces.labels import element_names
from tupli_mcap.spaces.leaves import Leaf

READ_BYTES = 4 << 20
"""Bytes of steps that are read at most; of longer recordings, steps at a few places are read."""
_PLACES, _AT_EACH = 16, 256
MOST_INFOS = _PLACES * _AT_EACH
"""Infos that are read at most."""
_VARIABLE_PLACES, _VARIABLE_AT_EACH = 8, 32  # steps of variable size are decoded one by one
_FIELDS = ("states", "actions", "rewards")
_MOST_REWARDS, _MOST_STATES, _MOST_ACTIONS, _MOST_INFOS = 2, 12, 6, 6


class Series(NamedTuple):
    """A short series of numbers; NaN stands for a missing one.

    Attributes:
        least, most: of a course, the smallest and the largest number; of a distribution, the range of the values.
        odd: number of values that are left out because they are not finite.
        each: one number is the mean of at most this many episodes.
    """

    name: str
    values: tuple[float, ...]
    least: float
    most: float
    odd: int
    each: int = 1


class Sketch(NamedTuple):
    """The series of a recording.

    Attributes:
        courses: means of consecutive episodes.
        distributions: counts of steps, from the smallest value to the largest.
        sampled: number of steps that the distributions count.
        hidden: number of dimensions that are left out.
        infos_hidden: keys of infos without a distribution, or with more numbers than have one.
        error: why the steps could not be read; empty if there was no error.
    """

    courses: tuple[Series, ...]
    distributions: tuple[Series, ...]
    sampled: int
    hidden: int
    infos_hidden: tuple[str, ...] = ()
    error: str = ""


def sketch(recording: Recording, points: int, positions: Array | None = None) -> Sketch:
    """Series of at most `points` numbers, of the episodes at some positions (all by default).

    If the recording is a local file, a few steps are read, without images.
    """
    positions = np.arange(len(recording.index)) if positions is None else positions
    rows = recording.index[positions]
    courses = tuple(
        found
        for name in ("return", "length")
        if (found := _course(name, rows[name].astype(np.float64), points)) is not None
    )
    if not recording.num_envs or recording.path is None or not rows["length"].sum():
        return Sketch(courses, (), 0, 0)
    try:
        pieces = list(_pieces(recording, positions))
        infos = sampled_infos(recording, positions)
    except TupliError as err:  # a damaged chunk must not hide the other series
        return Sketch(courses, (), 0, 0, error=str(err))
    layout = recording.layout
    shown = tuple(
        series
        for leaves, field, most in (
            (layout.reward, "rewards", _MOST_REWARDS),
            (layout.state, "states", _MOST_STATES),
            (layout.action, "actions", _MOST_ACTIONS),
        )
        for series in itertools.islice(_distributions(recording, leaves, field, pieces, points), most)
    )
    dimensions = sum(leaf.size for leaf in layout.leaves if leaf.kind != "variable" and not leaf.apart)
    hidden = dimensions - len(shown)
    numbers = numbers_in(infos)
    drawn, left = numbers[:_MOST_INFOS], {one.key for one in numbers[_MOST_INFOS:]}
    shown += tuple(_distribution(None, one.name, one.values.compressed(), points) for one in drawn)
    others = {key for info in infos for key in info} - {one.key for one in drawn} | left
    return Sketch(courses, shown, sum(len(piece) for piece in pieces), hidden, tuple(sorted(others)))


def sampled_infos(recording: Recording, positions: Array, most: int = MOST_INFOS) -> list[dict[str, Any]]:
    """Infos of steps of these episodes, by the texts of their keys: all, or of a recording with more than `most` or
    with large ones some at even distances; none of a URL."""
    if recording.path is None:
        return []
    wanted = set(recording.index["episode"][positions].tolist())
    _, infos = infos_at_places(recording, most, READ_BYTES, _PLACES)
    return [with_text_keys(info) for episode, info in infos if episode in wanted]


def infos_at_places(
    recording: Recording, most: int, most_bytes: int, places: int
) -> tuple[int, list[tuple[int, dict[str, Any]]]]:
    """How many infos a recording has, and all of them, or about `most` that take `most_bytes`, at `places` at even
    distances: (number of the episode, info)."""
    file = recording.file
    codec, channel = file.info_codec, file.topics.get(INFO, 0)
    total = file.store.count(channel)
    if codec is None or not total:
        return 0, []
    table = file.contents.table
    size = int(table["uncompressed"][table["channel"] == channel].sum())
    most = max(1, min(most, most_bytes * total // max(1, size)))
    places = 1 if total <= most else min(places, most)
    each = min(most, total) // places
    starts = np.linspace(0, total - each, places).astype(np.int64).tolist()
    bodies = itertools.chain.from_iterable(file.store.bodies(channel, start, each) for start in starts)
    return total, [(episode, info) for episode, _, info in map(codec.decode, bodies)]


def _course(name: str, values: Array, points: int) -> Series | None:
    if not np.isfinite(values).any():
        return None
    edges = np.linspace(0, len(values), min(points, len(values)) + 1).round().astype(np.int64)
    known = np.isfinite(values)
    odd = int((~known).sum())
    counts = np.add.reduceat(known.astype(np.float64), edges[:-1])
    with np.errstate(invalid="ignore", over="ignore"):
        means = np.add.reduceat(np.where(known, values, 0.0), edges[:-1]) / np.where(counts, counts, np.nan)
    finite, each = means[np.isfinite(means)], int(np.diff(edges).max())
    least, most = (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)
    return Series(name, tuple(means.tolist()), least, most, odd, each)


def _pieces(recording: Recording, positions: Array) -> Iterator[Columns]:
    """All steps of these episodes, or some at even distances."""
    total = int(recording.index["length"][positions].sum())
    constant = recording.layout.constant
    most = READ_BYTES // step_bytes(recording.layout, images=False)
    if total <= most and constant:
        yield recording.read(episodes=positions, fields=_FIELDS, images=False)
        return
    places, each = (_PLACES, _AT_EACH) if constant else (_VARIABLE_PLACES, _VARIABLE_AT_EACH)
    each = max(1, min(each, most // places))
    if total <= places * each:
        places, each = 1, total
    for begin in np.linspace(0, total - each, places).astype(np.int64).tolist():
        yield from _consecutive(recording, positions, begin, begin + each)


def _consecutive(recording: Recording, positions: Array, begin: int, stop: int) -> Iterator[Columns]:
    """The steps `begin:stop` of these episodes, numbered across them."""
    lengths = recording.index["length"][positions].astype(np.int64)
    ends = np.cumsum(lengths)
    first, last = np.searchsorted(ends, [begin, stop - 1], side="right").tolist()
    for i in range(first, last + 1):
        length, before = int(lengths[i]), int(ends[i] - lengths[i])
        start, end = max(begin - before, 0), min(stop - before, length)
        yield recording.read_steps(int(positions[i]), start, end, _FIELDS, images=False)


def _distributions(
    recording: Recording, leaves: list[Leaf], field: str, pieces: list[Columns], points: int
) -> Iterator[Series]:
    # a depth image, say, must not hide the joints
    for leaf in sorted(leaves, key=lambda leaf: leaf.size > _MOST_STATES):
        if leaf.kind == "variable" or leaf.apart or not leaf.size:
            continue
        columns = [leaf.get(getattr(piece, field)) for piece in pieces]
        flat = np.concatenate([column.reshape(len(column), -1) for column in columns])
        for i, name in enumerate(element_names(leaf, recording.labels)):
            yield _distribution(leaf, name, flat[:, i].astype(np.float64), points)


def _distribution(leaf: Leaf | None, name: str, values: Array, points: int) -> Series:
    known = np.isfinite(values)
    odd = int((~known).sum())
    values = values[known]
    if not len(values):
        return Series(name, (), np.nan, np.nan, odd)
    least, most = float(values.min()), float(values.max())
    if leaf is not None and isinstance(leaf.space, spaces.Discrete):  # values that never occur are shown, too
        least = min(least, float(leaf.space.start))
        most = max(most, float(leaf.space.start + leaf.space.n - 1))
    bins, end = points, most
    # each bin has the same number of whole numbers
    if np.array_equal(values, np.round(values)) and most - least < 2**52:
        width = np.ceil((most - least + 1) / points)
        bins = int(np.ceil((most - least + 1) / width))
        end = least + width * bins
    if not most > least or not np.isfinite(most - least):
        return Series(name, (float(len(values)),), least, most, odd)
    with np.errstate(over="ignore"):
        at = np.minimum((values - least) / (end - least) * bins, bins - 1).astype(np.int64)
    counts = np.bincount(np.maximum(at, 0), minlength=bins)
    return Series(name, tuple(counts.astype(np.float64).tolist()), least, most, odd)
