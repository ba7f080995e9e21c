"""Small lines beside the episodes of a table, each of one value over the steps of the episode."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import TupliError
from tupli_mcap.page.charts import line_path
from tupli_mcap.page.shelf import Shelf
from tupli_mcap.plots.measure import thinned_to
from tupli_mcap.plots.statistics import drawable_numbers
from tupli_mcap.recording import Recording
from tupli_mcap.schema import EpisodeHeader
from tupli_mcap.spaces.labels import element_names

_MOST_STEPS: Final = 400_000  # most steps that are read for one table
_POINTS: Final = 120


class Sparks(NamedTuple):
    """The name of the drawn value, and by episode id the SVG path (`d`) of its line in a drawing of 1000 x 100."""

    name: str
    lines: Mapping[str, str]


def sparks_of(shelf: Shelf, headers: Sequence[EpisodeHeader]) -> Sparks:
    """Draws the rewards of some episodes; if all rewards are equal, the first number of the states instead."""
    found: dict[str, Array] = {}
    name = "reward"
    for column in (_rewards, _first_state):
        found, name = _read(shelf, headers, column)
        if len(np.unique(np.concatenate([values[:-1] for values in found.values()] or [np.empty(0)]))) > 1:
            break
    lines = {}
    for uri, values in found.items():
        known = values[np.isfinite(values)]
        if len(known):
            thin = thinned_to(_POINTS, values)
            at = np.arange(len(thin), dtype=np.float64)
            up = float(known.min()), float(known.max())
            lines[uri] = line_path(at, thin, (0.0, max(1.0, len(thin) - 1.0)), up)
    return Sparks(name if lines else "", lines)


Column = Callable[[Recording, Array], tuple[Any, str]]


def _read(shelf: Shelf, headers: Sequence[EpisodeHeader], column: Column) -> tuple[dict[str, Array], str]:
    found: dict[str, Array] = {}
    name, steps = "", 0
    for recording_name, group in itertools.groupby(headers, key=lambda header: header.recording):
        some = list(group)
        steps += sum(header.n_tuples for header in some)
        if steps > _MOST_STEPS:
            break
        try:
            recording = shelf.open(recording_name)
            numbers = recording.index["episode"]
            positions = numbers.searchsorted([header.episode for header in some])
            if (
                numbers[np.minimum(positions, len(numbers) - 1)] != [header.episode for header in some]
            ).any():
                continue  # the file has changed since the query
            values, name = column(recording, positions)
        except TupliError:
            continue
        if values is not None:
            lengths = recording.index["length"][positions].astype(np.int64)
            parts = np.split(drawable_numbers(values), np.cumsum(lengths)[:-1])
            found |= {header.id: part for header, part in zip(some, parts, strict=True)}
    return found, name


def _rewards(recording: Recording, positions: Array) -> tuple[Any, str]:
    leaf = recording.layout.reward[0]
    if leaf.size != 1 or leaf.kind == "variable":
        return None, ""
    return np.asarray(leaf.get(recording.read(positions, ["rewards"]).rewards)).reshape(-1), "reward"


def _first_state(recording: Recording, positions: Array) -> tuple[Any, str]:
    leaf = next(
        (leaf for leaf in recording.layout.state if leaf.kind in ("array", "scalar") and leaf.size), None
    )
    if leaf is None:
        return None, ""
    column = leaf.get(recording.read(positions, ["states"], images=False).states)
    return np.asarray(column).reshape(len(column), -1)[:, 0], element_names(leaf, recording.labels, [0])[0]
