"""Statistics of a dataset's values, for normalisation; computed one block of steps after the other."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array, DType
from tupli_mcap.dataset.items import MemorySteps, Steps
from tupli_mcap.dataset.items.beside import INFOS, info_columns
from tupli_mcap.dataset.sources import DatasetError
from tupli_mcap.errors import SpaceError, did_you_mean
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.fields import step_name
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.spaces.statistics import ElementStatistics

STATISTICAL = ("states", "actions", "rewards", "next_states")
QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_SAMPLED = 1 << 16  # steps that quantiles are computed from, at even distances
_BLOCK = 1 << 16  # steps
_IMAGES = 8 << 20  # bytes of images in memory at once


@dataclass(frozen=True, repr=False)
class FieldStatistics:
    """Statistics of a leaf; each array has the leaf's shape. Those of an image are of all pixels of each channel: the
    other axes have the length 1, so that `(images - mean) / std` fits.

    Attributes:
        count: number of finite values (int64).
        mean, std: float64; the standard deviation is that of the population.
        min, max: of the finite values.
        quantiles: by fraction (0.5 is the median); exact for images and up to 65,536 steps, else of 65,536 steps at
            even distances.
    """

    count: Array
    mean: Array
    std: Array
    min: Array
    max: Array
    quantiles: dict[float, Array]

    def __repr__(self) -> str:
        told = ", ".join(f"{name} {_brief(getattr(self, name))}" for name in ("mean", "std", "min", "max"))
        return f"<FieldStatistics: {told}>"


def _brief(values: Array) -> str:
    text = np.array2string(values, precision=4, threshold=8, edgeitems=2, max_line_width=1000)
    return " ".join(text.split())


def statistics_of(steps: Steps, fields: Sequence[str]) -> dict[str, dict[str, FieldStatistics]]:
    """The statistics of each leaf, by field. See `Dataset.stats`."""
    layout = _layout_of(steps)
    steps.read(
        fields, np.empty(0, np.int64)
    )  # SpaceError, also where the first recording's leaves have no statistics
    leaves = [
        _Named(name_within(step_name(field), *leaf.keys), field, leaf, layout.dtypes[leaf.name])
        for field in fields
        for leaf in field_leaves(field, layout) or ()
        if leaf.kind != "variable" and not leaf.apart
    ]
    found = _statistics(steps, leaves)
    return {field: {one.name: found[one.name] for one in leaves if one.field == field} for field in fields}


def images_of(steps: Steps, fields: Sequence[str]) -> dict[str, tuple[str, Leaf]]:
    """The field and the leaf of each image in some fields, by name."""
    layout = _layout_of(steps)
    return {
        name_within(step_name(field), *leaf.keys): (field, leaf)
        for field in fields
        for leaf in field_leaves(field, layout) or ()
        if leaf.apart
    }


def statistics_of_image(steps: Steps, field: str, leaf: Leaf) -> FieldStatistics:
    """The statistics of each channel of an image, or of a stack of them, from how often each value occurs in it."""
    steps = _only(steps, [leaf])
    n_channels = leaf.stored_shape[-1] if leaf.kind == "image" or len(leaf.shape) == 4 else 1
    counts = np.zeros((n_channels, 256), np.int64)
    block = max(1, _IMAGES // leaf.size)
    for first in range(0, len(steps), block):
        column = leaf.get(steps.read([field], np.arange(first, min(first + block, len(steps))))[field])
        stored = np.moveaxis(column, -1, 1) if leaf.frames_last else column
        for own, values in zip(counts, stored.reshape(-1, n_channels).T, strict=True):
            own += np.bincount(values, minlength=256)
    total, levels = counts.sum(axis=1), np.arange(256)
    mean = counts @ levels / total
    variance = (counts * (levels - mean[:, None]) ** 2).sum(axis=1) / total

    def shaped(values: Array) -> Array:
        found: Array = leaf.as_values(values.reshape(*[1] * (len(leaf.shape) - 1), n_channels))
        return found

    def ranked(ranks: Array) -> Array:
        """The values at places (from 0) among the sorted ones of each channel."""
        found: Array = (counts.cumsum(axis=1) <= ranks[:, None]).sum(axis=1)
        return found

    quantiles = {}
    for q in QUANTILES:
        at = q * (total - 1)
        low = np.floor(at)
        quantiles[q] = shaped(ranked(low) + (ranked(np.ceil(at)) - ranked(low)) * (at - low))
    least, most = (shaped(ranked(ranks).astype(np.float64)) for ranks in (0 * total, total - 1))
    return FieldStatistics(shaped(total), shaped(mean), shaped(np.sqrt(variance)), least, most, quantiles)


def statistics_of_infos(
    steps: Steps, infos: Sequence[Mapping[str, Any]], keys: Sequence[str]
) -> dict[str, dict[str, FieldStatistics]]:
    """The statistics of entries of infos, by `info.<key>`; the empty key stands for all entries that are numbers. See
    `Dataset.stats`."""
    _layout_of(steps)
    found = {}
    for key in keys:
        columns = info_columns(infos, [key] if key else None)
        numbers = {entry: column for entry, column in columns.items() if isinstance(column, np.ndarray)}
        if key and not numbers:
            raise DatasetError(
                f"expected a number as info.{key:.80} of each step that has it, or arrays of one shape, found others; "
                "see them with read(['infos'])"
            )
        leaves = [
            _Named(
                f"info.{key}" if key else name_within("info", entry),
                INFOS,
                _info_leaf(entry, column),
                column.dtype,
            )
            for entry, column in numbers.items()
        ]
        found[f"info.{key}"] = _statistics(MemorySteps({INFOS: numbers}, steps), leaves)
    return found


def _info_leaf(key: str, column: Array) -> Leaf:
    """A leaf that finds a column among those of infos; it allows all numbers."""
    shape = column.shape[1:]
    return Leaf((key,), "info", "", spaces.Box(-np.inf, np.inf, shape), "array", column.dtype, shape)


def part_of(field: str, part: str, leaves: Mapping[str, FieldStatistics]) -> dict[str, FieldStatistics]:
    """Those of a field's leaves that are in a part of it (`.arm`); all if the part is empty. DatasetError if there is
    none."""
    own = f"{step_name(field)}{part}"
    found = {
        name: leaf for name, leaf in leaves.items() if name == own or name.startswith((f"{own}.", f"{own}["))
    }
    if part and not found:
        raise DatasetError(
            f"expected a part of {field} that has numbers, or the name of an image, such as "
            f"{', '.join(leaves) or 'none'}, found {own!r:.80}"
            f"{did_you_mean(own, leaves)}"
        )
    return found


def _layout_of(steps: Steps) -> StepLayout:
    if steps.layout is None or not len(steps):
        raise DatasetError("expected steps to take statistics of, found none")
    return steps.layout


class _Named(NamedTuple):
    """A leaf with its name, its field, and the dtype of its values."""

    name: str
    field: str
    leaf: Leaf
    dtype: DType


def _statistics(steps: Steps, leaves: Sequence[_Named]) -> dict[str, FieldStatistics]:
    """The statistics of leaves, by their names."""
    steps, total, fields = (
        _only(steps, [one.leaf for one in leaves if one.field in ("states", "next_states", "actions")]),
        len(steps),
        list(dict.fromkeys(one.field for one in leaves)),
    )
    known = {one.name: ElementStatistics(one.leaf, one.dtype) for one in leaves}
    sampled = np.unique(np.linspace(0, total - 1, min(total, _SAMPLED)).round().astype(np.int64))
    samples: dict[str, list[Array]] = {path: [] for path in known}
    for first in range(0, total, _BLOCK):
        rows = np.arange(first, min(first + _BLOCK, total))
        columns = steps.read(fields, rows)
        here = sampled[(sampled >= rows[0]) & (sampled <= rows[-1])] - first
        for name, field, leaf, _ in leaves:
            values = leaf.get(columns[field]).reshape(len(rows), leaf.size)
            known[name].add(np.ascontiguousarray(values.T))
            samples[name].append(values[here])
    return {name: _of(leaf, known[name], np.concatenate(samples[name])) for name, _, leaf, _ in leaves}


def _only(steps: Steps, leaves: Sequence[Leaf]) -> Steps:
    """The steps with only these leaves of states and actions, so that images beside them are not read; with all, where
    one is in a Tuple, of which no part can be read alone."""
    with contextlib.suppress(SpaceError):
        return steps.only([leaf.path for leaf in leaves])
    return steps


def _of(leaf: Leaf, known: ElementStatistics, sample: Array) -> FieldStatistics:
    def shaped(values: Array) -> Array:
        return values.reshape(leaf.shape)

    numbers = sample.astype(np.float64)
    numbers[~np.isfinite(numbers)] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # an element that is never finite has NaN
        quantiles = np.nanquantile(numbers, QUANTILES, axis=0) if leaf.size else np.empty((len(QUANTILES), 0))
    finite = known.finite > 0
    return FieldStatistics(
        count=shaped(known.finite),
        mean=shaped(known.mean),
        std=shaped(known.std),
        min=shaped(np.where(finite, known.least, np.nan)),
        max=shaped(np.where(finite, known.most, np.nan)),
        quantiles={q: shaped(values) for q, values in zip(QUANTILES, quantiles, strict=True)},
    )
