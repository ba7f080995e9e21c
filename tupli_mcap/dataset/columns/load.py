"""Reads whole columns: the steps of listed episodes that pass a tuple filter, one block of episodes after the other."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.columns.labels import StepLabels
from tupli_mcap.dataset.columns.tuples import StepMaker, StepTuple
from tupli_mcap.dataset.items import ListedEpisodes
from tupli_mcap.dataset.items.beside import FRAMES, FrameValues
from tupli_mcap.dataset.items.index import positions_of
from tupli_mcap.dataset.items.steps import pick
from tupli_mcap.dataset.sources import EpisodeSource
from tupli_mcap.errors import FilterError, SpaceError, did_you_mean, memory_for, warn
from tupli_mcap.messages.infos import paths_in
from tupli_mcap.messages.shared_dtypes import check_layouts, common_dtype, field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.progress import Progress, progress
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import step_bytes, whole_episodes
from tupli_mcap.recording.columns.fields import FIELD_OF, FIVE, named_parts
from tupli_mcap.recording.frames import Frames
from tupli_mcap.schema import BaseFilter, EpisodeHeader, check_keys, evaluate_columns
from tupli_mcap.schema.facts import comparisons, with_times
from tupli_mcap.schema.filters import path_of
from tupli_mcap.schema.keys import name_within
from tupli_mcap.spaces.labels import Labels

_BLOCK_BYTES = 64 << 20


@dataclass(frozen=True)
class Selected:
    """The wanted steps of the listed episodes: a bool mask over all steps, or None for all.

    `steps` is the number of wanted ones, `lengths` (int64) that of each episode.
    """

    lengths: Array
    mask: Array | None = None

    @property
    def steps(self) -> int:
        return int(self.lengths.sum())

    def reordered(self, listed: Array, order: Array) -> Selected:
        """The selection with the episodes in another order; `listed` are the lengths of whole episodes, in this one."""
        mask = None if self.mask is None else self.mask[_rows_of(listed, order)]
        return Selected(self.lengths[order], mask)


def read_columns(
    source: EpisodeSource,
    headers: Sequence[EpisodeHeader],
    fields: Sequence[str],
    selector: TupleSelector | None = None,
    known: Selected | None = None,
    parts: Sequence[str] = (),
) -> tuple[dict[str, Any], Selected, StepLayout | None]:
    """Columns of the wanted steps by field, the selection of these steps, and the layout of the first recording.

    Fields are those of `Recording.read`, "infos" (a list of dicts) and "steps" (int64, from 0 in each
    episode). Each recording is opened once, in whatever order the episodes are. Memory holds at most the result, one
    block of episodes (64 MiB, or one episode) and the cache of one recording.

    `selector` is the tuple filter, and `known` its result if it was evaluated before. parts: see `StepLayout.only`.

    Raises:
        SpaceError: one array cannot hold a field of two of the recordings, or one of them has no such part.
        NotFoundError: an episode is missing in its recording: the file was changed.
    """
    places = {name: i for i, name in enumerate(dict.fromkeys(header.recording for header in headers))}
    order = np.argsort([places[header.recording] for header in headers], kind="stable")
    if (np.diff(order) >= 0).all():
        return _read_grouped(source, headers, fields, selector, known, parts)
    listed, back = np.array([header.n_tuples for header in headers], np.int64), np.argsort(order)
    known = None if known is None else known.reordered(listed, order)
    grouped = [headers[i] for i in order]
    columns, selected, layout = _read_grouped(source, grouped, fields, selector, known, parts)
    rows = _rows_of(selected.lengths, back)
    columns = {field: pick(column, rows) for field, column in columns.items()}
    return columns, selected.reordered(listed[order], back), layout


def _read_grouped(
    source: EpisodeSource,
    headers: Sequence[EpisodeHeader],
    fields: Sequence[str],
    selector: TupleSelector | None,
    known: Selected | None,
    parts: Sequence[str],
) -> tuple[dict[str, Any], Selected, StepLayout | None]:
    """As `read_columns`, of episodes that follow each other if they are of one recording."""
    total = sum(header.n_tuples for header in headers)
    with (
        memory_for(lambda: f"loading {', '.join(fields)} of {total} steps"),
        progress(total, "Loading") as bar,
    ):
        reader = _Reader(fields, selector, known, total, parts)
        for name, same in itertools.groupby(headers, key=lambda header: header.recording):
            group = list(same)
            with source.open(name, [header.episode for header in group]) as recording:
                reader.read(recording, group, bar)
        return reader.finish(headers)


def _rows_of(lengths: Array, order: Array) -> Array:
    """The rows of episodes of these lengths, in another order."""
    ends = np.cumsum(lengths)
    starts = ends - lengths
    rows: Array = np.concatenate([np.arange(starts[i], ends[i]) for i in order.tolist()])
    return rows


class _Reader:
    """Collects the columns, recording by recording."""

    def __init__(
        self,
        fields: Sequence[str],
        selector: TupleSelector | None,
        known: Selected | None,
        total: int,
        parts: Sequence[str],
    ) -> None:
        self._fields, self._parts = list(dict.fromkeys(fields)), parts
        self._known = known
        self._selector = selector if known is None else None
        extra = [] if self._selector is None else list(self._selector.fields)
        self._needed = list(dict.fromkeys([*self._fields, *extra]))
        self._capacity = total if known is None else known.steps
        self._total = total
        self._done = 0  # listed steps read so far
        self._info_paths: set[tuple[str, ...]] = set()
        self._builders: dict[str, _FieldBuilder] = {}
        self._layout: StepLayout | None = None
        self._first_name = ""
        self._mask = None if self._selector is None else np.empty(total, np.bool_)

    def read(self, recording: Recording, headers: Sequence[EpisodeHeader], bar: Progress) -> None:
        layout = recording.layout.only(self._parts)
        if self._layout is None:
            self._layout, self._first_name = layout, recording.name
            self._builders = {field: _FieldBuilder(field, self._capacity, layout) for field in self._fields}
        else:
            check_layouts(self._layout, self._first_name, layout, recording.name, self._needed)
        listed = ListedEpisodes.of(recording.name, headers)
        positions, lengths = positions_of(recording, listed), listed.lengths
        # frames are large
        most = 1 if FRAMES in self._needed else _BLOCK_BYTES // step_bytes(recording.layout)
        # a filter looks at whole values, of which the parts are taken afterwards
        whole = self._selector is not None and {*self._selector.fields} & {"states", "actions"}
        parts = () if whole else self._parts
        for block in whole_episodes(lengths, max(1, most)):
            columns = _read_block(recording, positions[block], lengths[block], self._needed, parts)
            steps = int(lengths[block].sum())
            frames = FrameValues(lengths[block], partial(_frames_of, recording, positions[block]))
            after = partial(_read_block, recording, positions[block], lengths[block], ["next_states"], ())
            see = partial(StepMaker, columns, recording.layout, frames.seen, after)
            keep = self._keep(columns, steps, recording, see)
            for field, builder in self._builders.items():
                if field != FRAMES:
                    builder.put(columns[field], keep)
                elif len(wanted := np.arange(steps) if keep is None else np.flatnonzero(keep)):
                    builder.put(frames(wanted), None)
            self._done += steps
            bar.advance(steps)

    def _keep(
        self, columns: dict[str, Any], steps: int, recording: Recording, see: Callable[[], StepMaker]
    ) -> Array | None:
        block = slice(self._done, self._done + steps)
        if self._known is not None:
            return None if self._known.mask is None else self._known.mask[block]
        if self._selector is None or self._mask is None:
            return None
        self._mask[block] = self._selector.mask(columns, recording.layout, recording.labels, see)
        self._info_paths.update(*map(paths_in, columns.get("infos", ())))
        return self._mask[block]

    def finish(self, headers: Sequence[EpisodeHeader]) -> tuple[dict[str, Any], Selected, StepLayout | None]:
        selected = self._known
        if selected is None:
            lengths = np.array([header.n_tuples for header in headers], np.int64)
            if self._mask is not None:
                ends = np.concatenate([[0], np.cumsum(lengths)])
                wanted = np.concatenate([[0], np.cumsum(self._mask)])
                lengths = np.diff(wanted[ends])
            selected = Selected(lengths, self._mask)
            if self._selector is not None and self._done and not selected.steps:
                _warn_of_unseen(self._selector.filters, self._info_paths)
        columns = {field: builder.finish() for field, builder in self._builders.items()}
        if self._layout is None:
            columns = {field: _empty_column(field) for field in self._fields}
        return columns, selected, self._layout


def _empty_column(field: str) -> Any:
    """The column of an empty dataset, whose spaces are not known."""
    if field == "infos":
        return []
    if field == FRAMES:
        return np.empty((0, 0, 0, 3), np.uint8)
    dtypes: dict[str, Any] = {
        "terminals": np.bool_,
        "timeouts": np.bool_,
        "steps": np.int64,
        "times": np.int64,
    }
    return np.empty(0, dtypes.get(field, np.float64))


def _read_block(
    recording: Recording, positions: Array, lengths: Array, fields: Sequence[str], parts: Sequence[str]
) -> dict[str, Any]:
    """The fields of some whole episodes; steps that were recorded after the listing are left out."""
    recorded = [field for field in fields if field not in ("steps", FRAMES)]
    # None for all episodes is cheaper than a list of them: it leaves the cache alone.
    everything = len(positions) == len(recording) and (np.diff(positions) == 1).all()
    named = [name for field in recorded for name in named_parts(field, parts)]
    found = recording.read(named, episodes=None if everything else positions)
    columns = {field: getattr(found, field) for field in recorded}
    now = found.episode_lengths
    if "steps" in fields:
        columns["steps"] = steps_within(now)
    if (now > lengths).any():
        listed = steps_within(now) < np.repeat(lengths, now)
        columns = {field: pick(column, np.flatnonzero(listed)) for field, column in columns.items()}
    return columns


def _frames_of(recording: Recording, positions: Array, place: int) -> Frames:
    return recording.frames(int(positions[place]))


def steps_within(lengths: Array) -> Array:
    """The numbers of the steps of episodes of these lengths, from 0 in each."""
    starts: Array = np.repeat(np.cumsum(lengths) - lengths, lengths)
    return np.arange(int(lengths.sum())) - starts


# ---- columns that are filled, recording after recording

Keep = Array | None  # a bool mask of rows; None for all


class _LeafBuilder:
    """One array (a list for a leaf of variable size) that grows up to `capacity` rows.

    A capacity that is too large costs nothing: memory that is not written to takes no pages.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._array: Array | None = None
        self._items: list[Any] = []
        self._filled = 0

    def put(self, values: Any, keep: Keep) -> None:
        """Appends those rows of `values` that `keep` is True of; all if it is None."""
        if isinstance(values, list):
            self._items += values if keep is None else [values[i] for i in np.flatnonzero(keep)]
            return
        rows = values if keep is None else values[keep]
        if self._array is None:
            if len(rows) == self._capacity and rows.base is None:
                self._array, self._filled = rows, len(rows)  # all rows at once: nothing to copy
                return
            self._array = np.empty((self._capacity, *rows.shape[1:]), rows.dtype)
        dtype = common_dtype(self._array.dtype, rows.dtype) or self._array.dtype
        if dtype != self._array.dtype:
            wider = np.empty(self._array.shape, dtype)
            wider[: self._filled] = self._array[: self._filled]
            self._array = wider
        if rows.shape[1:] != self._array.shape[1:]:  # other columns are checked by their layouts
            sizes = f"{self._array.shape[1:3]} and {rows.shape[1:3]}"
            raise SpaceError(f"expected frames of one size, found {sizes}; choose episodes by a filter")
        self._array[self._filled : self._filled + len(rows)] = rows
        self._filled += len(rows)

    def finish(self) -> Any:
        """The rows so far; the builder is empty afterwards."""
        array, self._array = self._array, None
        if array is None:
            return self._items
        if self._filled < len(array):
            array.resize((self._filled, *array.shape[1:]), refcheck=False)  # frees the rest in place
        return array


class _FieldBuilder:
    """The leaves of a field; `finish` nests them as its space is."""

    def __init__(self, field: str, capacity: int, layout: StepLayout) -> None:
        self._field = field
        self._leaves = field_leaves(field, layout)
        self._layout = layout
        self._builders = [
            _LeafBuilder(capacity) for _ in range(1 if self._leaves is None else len(self._leaves))
        ]

    def put(self, column: Any, keep: Keep) -> None:
        if self._leaves is None:
            self._builders[0].put(column, keep)
            return
        for leaf, builder in zip(self._leaves, self._builders, strict=True):
            builder.put(leaf.get(column), keep)

    def finish(self) -> Any:
        values = [builder.finish() for builder in self._builders]
        if self._leaves is None:
            return values[0] if len(values[0]) else _empty_column(self._field)
        if self._field == "rewards":
            return self._layout.nest_reward(values)
        return (self._layout.nest_action if self._field == "actions" else self._layout.nest_state)(values)


# ---- tuple filters

STEP_KEYS: Mapping[str, str] = {
    **{name: field for name, field in FIELD_OF.items() if field != "frames"},
    "step": "steps",
}
"""Name in an expression -> column; `step` counts from 0 within its episode."""
_TIME_KEYS = [key for key, field in STEP_KEYS.items() if field == "times"]

TupleFilter = BaseFilter | Callable[[StepTuple], bool]
Mask = np.ndarray[Any, np.dtype[np.bool_]]


class TupleSelector:
    """Tuple filters that must all hold, and the `fields` of the columns that they need.
    FilterError if one is neither an expression nor a function, or if it names an unknown field of a step."""

    def __init__(self, *filters: TupleFilter) -> None:
        needed = {"terminals"}
        for one in filters:
            if isinstance(one, BaseFilter):
                if any(FIELD_OF.get(path_of(comparison)[0]) == FRAMES for comparison in comparisons(one)):
                    raise FilterError(
                        "expressions compare no pictures; a function of a step has its picture: "
                        "lambda step: step.frame is not None and step.frame.mean() > 100"
                    )
                check_keys(one, STEP_KEYS)
                needed |= {STEP_KEYS[path_of(comparison)[0]] for comparison in comparisons(one)}
            elif callable(one):
                needed |= {*FIVE, "infos", "steps", "times"}
            else:
                raise FilterError(
                    f"expected a function of one tuple or an expression like F('reward') > 0, found {one!r:.80}"
                )
        self.filters = filters
        self.fields = tuple(sorted(needed))
        self._tests = [with_times(one, _TIME_KEYS) if isinstance(one, BaseFilter) else one for one in filters]

    def __and__(self, other: TupleSelector) -> TupleSelector:
        return TupleSelector(*self.filters, *other.filters)

    def mask(
        self, columns: Mapping[str, Any], layout: StepLayout, labels: Labels, see: Callable[[], StepMaker]
    ) -> Mask:
        """A mask of the wanted steps of `columns` of a recording (by field, at least `self.fields`); `see` returns what
        makes them steps for functions.
        FilterError if an expression does not fit the columns, or a function returned no flag."""
        names = StepLabels(layout, labels)
        mask = np.ones(len(columns["terminals"]), np.bool_)
        for test in self._tests:
            if isinstance(test, BaseFilter):
                steps = {key: columns[field] for key, field in STEP_KEYS.items() if field in self.fields}
                mask &= evaluate_columns(names.applied(test), steps)
            else:
                maker, rows = see(), np.flatnonzero(mask)
                mask[rows] = [_flag(test(maker.step_of_row(row))) for row in rows.tolist()]
        return mask


def _warn_of_unseen(filters: Sequence[TupleFilter], seen: Collection[tuple[str, ...]]) -> None:
    """Warns of infos that an expression names and that no step has; `seen` are the `paths_in` those that steps have."""
    dicts = {path[:-1] for path in seen} | {()}
    expressions = (one for one in filters if isinstance(one, BaseFilter))
    for comparison in itertools.chain.from_iterable(map(comparisons, expressions)):
        name, *inside = path_of(comparison)
        parts = [tuple(inside[:end]) for end in range(len(inside) + 1)]
        unseen = next((part for part in parts[1:] if part not in seen and part[:-1] in dicts), None)
        if STEP_KEYS[name] == "infos" and unseen:
            names = [name_within(name, *path) for path in seen]
            known = sorted(path[-1] for path in seen if path[:-1] == unseen[:-1])
            has = (
                f"{name_within(name, *unseen[:-1])} has {', '.join(known)}"
                if known
                else "no infos are recorded"
            )
            warn(f"no step has {comparison.key}{did_you_mean(name_within(name, *unseen), names)}; {has}")


def _flag(value: object) -> bool:
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, np.ndarray) and value.shape == () and value.dtype == np.bool_:
        return bool(value)
    raise FilterError(
        f"expected True or False from a tuple filter, found {value!r:.80}; compare one number of a step"
    )
