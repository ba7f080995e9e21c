"""A recording with other rewards or actions: everything else of it is kept."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.edit.copy_episodes import NewValues
from tupli_mcap.recording.edit.made_of import say_made_of
from tupli_mcap.recording.edit.replacing import replacing
from tupli_mcap.recording.edit.rewrite import new_metadata, return_of, write
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.signature_file import STATEMENTS
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["relabel_recording"]

_FIELDS = ("rewards", "actions")


def relabel_recording(
    source: Recording,
    target: Path,
    function: Callable[[Episode], Any],
    fields: Sequence[str] = ("rewards",),
    *,
    sources: Sequence[Recording] = (),
) -> None:
    """Writes `target` (replaced in one rename) with new values of some fields.

    States, flags, infos, frames, times, seeds, metadata, runs and the environment stay; returns follow the rewards. The
    recording has a UUID of its own, and no signature.

    Args:
        function: from an episode to its new column; with several fields, to a dict of columns by field. A column has a
            value for each step, nested as the space is, which the recording's dtype holds exactly.
        fields: "rewards", "actions", or both.
        sources: what the recording is made of, where that is not `source`.

    Raises:
        RecordingError: another field; the function returns something else.
        StepError: a value of variable size is none of its space.
    """
    for field in fields:
        if field not in _FIELDS:
            raise RecordingError(f"expected fields among {', '.join(_FIELDS)}, found {field!r:.80}")
    values = _new_values(source, function, list(fields))
    name = (
        f"{getattr(function, '__module__', '')}.{getattr(function, '__qualname__', type(function).__name__)}"
    )
    said = say_made_of(sources or [source], "map", function=name, fields=list(fields))
    with replacing(target) as (fd, _):
        container = Container(fd, str(target), "zstd")
        write(
            source,
            container,
            new_metadata(source),
            None,
            said,
            values=values,
            signed=False,
            left_out=STATEMENTS,
        )


def _new_values(source: Recording, function: Callable[[Episode], Any], fields: list[str]) -> NewValues:
    layout, rows = source.layout, source.index
    leaves = {field: field_leaves(field, layout) or [] for field in fields}
    columns = {
        channel: {
            leaf.name: _empty(leaf, layout, source.file.store.count(channel))
            for found in leaves.values()
            for leaf in found
        }
        for channel in source.file.steps
    }
    returns: dict[int, float] = {}
    for episode, row in zip(source.episodes, rows, strict=True):
        made = function(episode)
        by_field: Mapping[str, Any] = {fields[0]: made} if len(fields) == 1 else made
        if not isinstance(by_field, Mapping) or set(by_field) != set(fields):
            raise RecordingError(
                f"expected a dict with {', '.join(fields)} of episode {episode.number}, found {made!r:.80}"
            )
        first, channel = int(row["first_row"]), source.file.steps[int(row["env"])]
        for field in fields:
            for leaf in leaves[field]:
                column = _checked(by_field[field], leaf, layout, episode, field)
                columns[channel][leaf.name][first : first + len(episode)] = column
        if "rewards" in fields:
            returns[episode.number] = return_of(layout, by_field["rewards"], len(episode))
    return NewValues(columns, returns)


def _empty(leaf: Leaf, layout: StepLayout, rows: int) -> Array | list[Any]:
    return (
        [None] * rows if leaf.kind == "variable" else np.zeros((rows, *leaf.shape), layout.dtypes[leaf.name])
    )


def _checked(
    made: Any, leaf: Leaf, layout: StepLayout, episode: Episode, field: str
) -> Array | Sequence[Any]:
    where = f"{field} of episode {episode.number}"
    try:
        if leaf.kind == "variable":  # its values are looked at when they are encoded
            values: Sequence[Any] = leaf.get(made)
            if len(values) != len(episode):
                raise RecordingError(f"expected {len(episode)} {where}, found {len(values)}")
            return values
        given = np.asarray(leaf.get(made))
    except (KeyError, IndexError, TypeError, ValueError) as err:
        raise RecordingError(f"expected {where} as {leaf.path} has them: {err}") from err
    shape, dtype = (len(episode), *leaf.shape), layout.dtypes[leaf.name]
    if given.shape != shape or given.dtype.kind not in "biuf":
        raise RecordingError(f"expected {where} of shape {shape}, found {given.shape} of {given.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):
        stored = given.astype(dtype)
    if not np.array_equal(stored.astype(given.dtype), given, equal_nan=given.dtype.kind == "f"):
        raise RecordingError(f"expected {where} that {dtype} holds exactly, found {given.dtype}; cast them")
    return stored
