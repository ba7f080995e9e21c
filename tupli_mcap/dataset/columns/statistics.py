"""Statistics of a dataset's values, for normalisation; computed one block of steps after the other."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items import Steps
from tupli_mcap.dataset.sources import DatasetError
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.recording.columns.fields import step_name
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.spaces.statistics import ElementStatistics

STATISTICAL = ("states", "actions", "rewards", "next_states")
QUANTILES = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
_SAMPLED = 1 << 16  # steps that quantiles are computed from, at even distances
_BLOCK = 1 << 16  # steps


@dataclass(frozen=True, repr=False)
class FieldStatistics:
    """Statistics of a leaf; each array has the leaf's shape.

    Attributes:
        count: number of finite values (int64).
        mean, std: float64; the standard deviation is that of the population.
        min, max: of the finite values.
        quantiles: by fraction (0.5 is the median); exact up to 65,536 steps, else of 65,536 steps at even distances.
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
    if steps.layout is None or not len(steps):
        raise DatasetError("expected steps to take statistics of, found none")
    steps.read(
        fields, np.empty(0, np.int64)
    )  # SpaceError, also where the first recording's leaves have no statistics
    layout, total = steps.layout, len(steps)
    leaves = [(field, leaf) for field in fields for leaf in field_leaves(field, layout) or ()]
    leaves = [(field, leaf) for field, leaf in leaves if leaf.kind != "variable" and not leaf.apart]
    names = [name_within(step_name(field), *leaf.keys) for field, leaf in leaves]
    known = {
        name: ElementStatistics(leaf, layout.dtypes[leaf.name])
        for name, (_, leaf) in zip(names, leaves, strict=True)
    }
    sampled = np.unique(np.linspace(0, total - 1, min(total, _SAMPLED)).round().astype(np.int64))
    samples: dict[str, list[Array]] = {path: [] for path in known}
    for first in range(0, total, _BLOCK):
        rows = np.arange(first, min(first + _BLOCK, total))
        columns = steps.read(list(dict.fromkeys(field for field, _ in leaves)), rows)
        here = sampled[(sampled >= rows[0]) & (sampled <= rows[-1])] - first
        for name, (field, leaf) in zip(names, leaves, strict=True):
            values = leaf.get(columns[field]).reshape(len(rows), leaf.size)
            known[name].add(np.ascontiguousarray(values.T))
            samples[name].append(values[here])
    found: dict[str, dict[str, FieldStatistics]] = {field: {} for field in fields}
    for name, (field, leaf) in zip(names, leaves, strict=True):
        found[field][name] = _of(leaf, known[name], np.concatenate(samples[name]))
    return found


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
