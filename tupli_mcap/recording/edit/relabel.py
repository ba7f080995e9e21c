"""Writes a recording with new rewards, actions or states; everything else stays."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from tupli_mcap import files
from tupli_mcap.arrays import Array, DType
from tupli_mcap.errors import RecordingError, StepError
from tupli_mcap.mcap.container import Container
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.columns.fields import OTHER_NAMES, field_names
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.copy_episodes import NewValues
from tupli_mcap.recording.edit.merge import Excerpt, check_mergeable, merge_excerpts
from tupli_mcap.recording.edit.rewrite import return_of
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.write.rows.variable import final_encoder
from tupli_mcap.spaces.exact import exact_array
from tupli_mcap.spaces.leaves import Leaf

FIELDS = ("rewards", "actions", "states")


def relabel_excerpts(
    excerpts: Sequence[Excerpt],
    target: Path,
    function: Callable[[Episode], Any],
    fields: Sequence[str] = ("rewards",),
    made: Mapping[str, Any] = MappingProxyType({}),
    *,
    overwrite: bool = True,
) -> None:
    """Writes `target` (replaced in one rename) with new values of some fields.

    The other fields of steps, infos, frames, times, seeds, metadata, runs and the environment stay; returns are
    computed from the new rewards. The recording has a new UUID and no signature.

    Args:
        excerpts: the episodes; at least one.
        target: path of the new recording.
        function: takes an episode and returns its new column; with several fields, a dict of columns by field. A column
            has a value for each step, nested as the space is, which the recording's dtype holds exactly. A column of
            states has one more value if the final state is known, like `Episode.all_states`.
        fields: some of "rewards", "actions" and "states".
        made: further facts for `made_of.json`.
        overwrite: replace a target that exists.

    Raises:
        RecordingError: there is no such field, it is no function, or it returns something else.
        SpaceError, FormatError: as `merge_excerpts`.
        StepError: a value of variable size does not fit its space.
    """
    if not callable(function):
        raise RecordingError(f"expected a function of an episode, found {function!r:.80}")
    fields = field_names(fields, FIELDS)
    excerpts, _ = check_mergeable(excerpts)
    with replacing(target, overwrite=overwrite) as (fd, new), ExitStack() as opened:
        changed = []
        for i, excerpt in enumerate(excerpts):
            columns = _NewColumns(excerpt.recording, fields, new.with_name(str(i)), opened)
            changed.append(excerpt._replace(values=_new_values(excerpt, function, fields, columns)))
        made = {"how": "map", **made, "function": function_name(function), "fields": fields}
        merge_excerpts(changed, Container(fd, str(target), "zstd"), made=made)


def function_name(function: Callable[..., Any]) -> str:
    """`module.function`, or the module and the class of another object that can be called."""
    name = getattr(function, "__qualname__", type(function).__name__)
    return f"{getattr(function, '__module__', '')}.{name}"


def _new_values(
    excerpt: Excerpt, function: Callable[[Episode], Any], fields: list[str], new: _NewColumns
) -> NewValues:
    source, returns = excerpt.recording, {}
    places = np.searchsorted(source.index["episode"], excerpt.rows["episode"])
    for place, row in zip(places.tolist(), excerpt.rows, strict=True):
        episode = source.episodes[place]
        made = function(episode)
        is_named = (
            isinstance(made, Mapping) and fields == ["rewards"] and set(made) <= {*FIELDS, *OTHER_NAMES}
        )
        if is_named and field_names(list(made), FIELDS) != fields:
            raise RecordingError(
                f"expected rewards of episode {episode.number}, found a dict of {', '.join(made)}; "
                f"pass fields={list(made)}"
            )
        by_field: Any = {fields[0]: made} if len(fields) == 1 and not is_named else made
        if isinstance(by_field, Mapping):
            by_field = dict(zip(field_names(list(by_field), FIELDS), by_field.values(), strict=True))
        if not isinstance(by_field, Mapping) or set(by_field) != set(fields):
            raise RecordingError(
                f"expected a dict with {', '.join(fields)} of episode {episode.number}, found {made!r:.80}"
            )
        for field in fields:
            columns = new.put(episode, row, field, by_field[field])
            if field == "rewards":
                rewards = source.layout.nest_reward(columns)
                returns[episode.number] = return_of(source.layout, rewards, len(episode))
    return NewValues(new.columns, returns, new.finals)


class _NewColumns:
    """Collects the columns of `NewValues`, episode by episode; columns of constant size are in files `spool.*`, which
    `opened` closes."""

    def __init__(self, source: Recording, fields: Sequence[str], spool: Path, opened: ExitStack) -> None:
        self._layout, self._file = source.layout, source.file
        self._spool, self._opened = spool, opened
        self._leaves = {field: field_leaves(field, source.layout) or [] for field in fields}
        self._encode_final = final_encoder(source.layout)
        self.columns: dict[int, dict[str, list[Any] | _Spool]] = {}
        self.finals: dict[int, bytes] = {}

    def put(self, episode: Episode, row: Any, field: str, made: Any) -> list[Any]:
        """Adds the values of a field, and returns them by leaf. If there is one more state than steps, it is the final
        state."""
        first, channel, steps = int(row["first_row"]), self._file.steps[int(row["env"])], len(episode)
        has_final = field == "states" and int(row["final_row"]) >= 0
        checked = []
        for leaf in self._leaves[field]:
            told = f"{field} of episode {episode.number}"
            values = _checked(made, leaf, self._layout, steps + has_final, told)
            checked.append(values)
            where, name = channel, leaf.name
            if leaf.apart:
                topics = Topics.of_step(self._file.contents.channels[channel].topic)
                where, name = self._file.topics[topics.image(leaf.name)], "data"
            if leaf.frames_last:
                values = np.moveaxis(values, -1, 1)  # as they are stored
            if leaf.size:
                self._column(where, name, leaf)[first : first + steps] = values[:steps]
        if has_final:
            lasts = [values[-1] for values in checked]
            self.finals[episode.number] = self._encode_final(self._layout.nest_state(lasts))
        return checked

    def _column(self, channel: int, name: str, leaf: Leaf) -> list[Any] | _Spool:
        columns = self.columns.setdefault(channel, {})
        if name not in columns:
            if leaf.kind == "variable":
                columns[name] = [None] * self._file.store.count(channel)
            else:
                path = self._spool.with_name(f"{self._spool.name}.{channel}.{name}")
                spool = _Spool(path, self._layout.dtypes[leaf.name], leaf.stored_shape)
                columns[name] = self._opened.enter_context(closing(spool))
        return columns[name]


class _Spool:
    """An array in a file: values of one dtype and shape, written and read by their numbers."""

    def __init__(self, path: Path, dtype: DType, shape: tuple[int, ...]) -> None:
        self._file = os.fdopen(files.create(path), "w+b")
        self._dtype, self._shape = dtype, shape
        self._size = dtype.itemsize * math.prod(shape)

    def __setitem__(self, rows: slice, values: Array) -> None:
        self._file.seek(rows.start * self._size)
        self._file.write(values.tobytes())

    def __getitem__(self, rows: slice | int) -> Any:
        first, stop = (rows.start, rows.stop) if isinstance(rows, slice) else (rows, rows + 1)
        self._file.seek(first * self._size)
        data = self._file.read((stop - first) * self._size)
        values = np.frombuffer(data, self._dtype).reshape(stop - first, *self._shape)
        return values if isinstance(rows, slice) else values[0]

    def close(self) -> None:
        self._file.close()


def _checked(made: Any, leaf: Leaf, layout: StepLayout, count: int, where: str) -> Any:
    """`count` values of a leaf, checked, as they are stored."""
    try:
        if leaf.kind == "variable":  # its values are checked when they are encoded
            values: Sequence[Any] = leaf.get(made)
            if len(values) != count:
                raise RecordingError(f"expected {count} {where}, found {len(values)}{_hint(where)}")
            return values
        given = leaf.get(made)
    except (KeyError, IndexError, TypeError, ValueError) as err:
        raise RecordingError(f"expected {where} as {leaf.path} has them: {err}") from err
    shape, dtype = (count, *leaf.shape), layout.dtypes[leaf.name]
    try:
        return exact_array(given, dtype, shape, where)
    except StepError as err:
        found = (
            "a dict" if isinstance(given, dict) else f"{np.asarray(given).dtype} of shape {np.shape(given)}"
        )
        raise RecordingError(
            f"expected {where} of shape {shape} that {dtype} holds exactly, found {found}"
            + ("; cast them" if np.shape(given) == shape else _hint(where))
        ) from err


def _hint(where: str) -> str:
    return "; the final state is the last one: map episode.all_states" if where.startswith("states") else ""
