"""`Dataset`: episodes of files, directories and servers; filtered, sorted, read and saved."""

from __future__ import annotations

import bisect
import copy
import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, overload

import numpy as np

from tupli_mcap.arrays import Array, ShortList
from tupli_mcap.dataset import curate, display
from tupli_mcap.dataset.access import RandomAccess
from tupli_mcap.dataset.columns import tables
from tupli_mcap.dataset.columns.load import Selected, TupleFilter, TupleSelector, read_columns, steps_within
from tupli_mcap.dataset.columns.saved import save_columns
from tupli_mcap.dataset.columns.statistics import (
    STATISTICAL,
    FieldStatistics,
    images_of,
    part_of,
    statistics_of,
    statistics_of_image,
    statistics_of_infos,
)
from tupli_mcap.dataset.items import ListedEpisodes, RecordedSteps, Steps
from tupli_mcap.dataset.items.beside import INFOS, FrameValues, info_columns, info_keys
from tupli_mcap.dataset.items.index import positions_of
from tupli_mcap.dataset.items.recorded import cache_options
from tupli_mcap.dataset.keys import check_metadata, keys_of, matching, values_at
from tupli_mcap.dataset.sources import (
    DatasetError,
    EpisodeSource,
    FilesSource,
    JoinedSource,
    OpenRecordings,
    StorageSource,
    checked_whole,
    numbers_by_recording,
    place_of,
)
from tupli_mcap.dataset.which import as_filter, text_of
from tupli_mcap.errors import FilterError, RecordingError, warn
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Columns, Episode, Recording
from tupli_mcap.recording.columns.fields import (
    FIELD_OF,
    FIELDS,
    FIVE,
    ColumnDict,
    field_names,
    fields_and_parts,
    split_name,
    step_name,
)
from tupli_mcap.recording.edit.relabel import function_name
from tupli_mcap.recording.frames import Frames
from tupli_mcap.recording.verbs import EpisodeViews
from tupli_mcap.remote import is_url
from tupli_mcap.schema import BaseFilter, EpisodeHeader, F, check_keys, compile_predicate
from tupli_mcap.schema.facts import path_in
from tupli_mcap.storage.base import numbers_by_file, uuid_of

if TYPE_CHECKING:
    import gymnasium as gym
    import pandas as pd
    import pyarrow as pa

    from tupli_mcap.dataset.columns.tables import Level
    from tupli_mcap.recording.about.annotations import Annotation
    from tupli_mcap.storage import TupliStorage

_SHOWN = 100  # numbers of episodes, in a text
# A storage has an index of these, and the order of `Dataset.sort`, also of equal and of large values.
_SORTED_BY_STORAGES = (("episode_return",), ("n_tuples",), ("created_at",))

Test: TypeAlias = "str | F | BaseFilter | Callable[[Episode], bool]"


class Dataset(RandomAccess, EpisodeViews):
    """Episodes of files, directories and servers, in an order.

    Nothing is read before it is needed, and the episodes are listed once. `filter`, `filter_steps`, `sort`, `head`,
    `sample`, `split` and an index return another dataset and do not change this one. Iteration gives episodes, and
    `len` counts them. Not thread-safe; a pickled copy opens the files itself.

    Of an episode that was still being recorded when it was listed, columns, windows, tables and statistics have the
    steps up to then. The `Episode` itself, and what `save`, `map` and `trim` write of it, may have more: those that
    were recorded before its file was opened.

    Use `tupli_mcap.open` to make one.
    """

    def __init__(self, source: EpisodeSource, headers: Sequence[EpisodeHeader] | None = None) -> None:
        if isinstance(source, str | os.PathLike):
            raise DatasetError(f"tupli_mcap.open({os.fspath(source)!r:.200}) makes a dataset of it")
        self._source = source
        self._filter: BaseFilter | None = None  # by which episodes are listed, and all that came after it
        self.chosen_by: tuple[str, ...] = ()
        """How the episodes were chosen, in the order in which that was done; `save` notes it."""
        self._order: tuple[str, bool] | None = None  # in which they are listed: a key, and whether it falls
        self._listed = None if headers is None else ShortList(headers)
        self._selector: TupleSelector | None = None  # of steps
        self._known: Selected | None = None  # what it has found
        self._recordings = OpenRecordings(source.open)
        self._steps: RecordedSteps | None = None
        self._cache: dict[str, int] = {}  # arguments of `RecordedSteps`
        self._stats: dict[str, Mapping[str, FieldStatistics]] = {}

    def __getstate__(self) -> dict[str, Any]:
        # A copy finds the steps itself: the files may have been written anew.
        return {**self.__dict__, "_steps": None}

    # ---- episodes

    @property
    def headers(self) -> Sequence[EpisodeHeader]:
        """The facts about the episodes, in their order, without their steps."""
        if self._listed is None:
            found = matching(self._filter, self._source.episodes)
            self._listed = ShortList(found if self._order is None else self._sorted(found, *self._order))
        return self._listed

    @property
    def _headers(self) -> Sequence[EpisodeHeader]:
        return self.headers

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self.headers)

    @property
    def n_steps(self) -> int:
        """The number of steps of all episodes, after `filter_steps`."""
        return self._selected.steps

    @property
    def lengths(self) -> Array:
        """Steps of each episode, after `filter_steps`: int64 (episodes,)."""
        return self._selected.lengths.copy()

    @property
    def returns(self) -> Array:
        """The sum of all rewards of each episode: float64 (episodes,), NaN if a reward is."""
        return np.array([header.episode_return for header in self.headers], np.float64)  # None becomes NaN

    @overload
    def __getitem__(self, chosen: int | np.integer[Any]) -> Episode: ...
    @overload
    def __getitem__(self, chosen: slice | Sequence[int] | Array) -> Dataset: ...
    def __getitem__(self, chosen: int | np.integer[Any] | slice | Sequence[int] | Array) -> Episode | Dataset:
        """`ds[3]` is an episode; `ds[-5:]`, `ds[[4, 2]]` and `ds[mask]` are datasets. What is missing in a mask of
        pandas counts as False; that of a table which was sorted is put in order by its index.

        Raises:
            IndexError: there is no such episode.
            DatasetError: it is no number, slice, list of numbers or mask.
        """
        headers = self.headers
        if isinstance(chosen, int | np.integer) and not isinstance(chosen, bool):
            try:
                return self._episode(headers[int(chosen)])
            except IndexError as err:
                if not headers:
                    raise IndexError(f"an empty dataset has no episode {chosen}") from err
                raise IndexError(f"expected an episode from 0 to {len(headers) - 1}, found {chosen}") from err
        if isinstance(chosen, slice):
            bounds = ["" if at is None else str(at) for at in (chosen.start, chosen.stop, chosen.step)]
            return self._of(headers[chosen], f"index: [{':'.join(bounds[: 2 + bool(bounds[2])])}]")
        places = _places(chosen, len(headers))
        return self._of([headers[i] for i in places], f"index: [{_some(places)}]")

    def __iter__(self) -> Iterator[Episode]:
        for header in self.headers:
            yield self._episode(header)

    def _episodes(self, filter: BaseFilter | None) -> tuple[EpisodeSource, Sequence[EpisodeHeader]]:
        """The source that opens its recordings, and its episodes that match the filter."""
        whole = self._whole()
        return self._source, (whole if filter is None else whole.filter(filter)).headers

    def _episode(self, header: EpisodeHeader) -> Episode:
        recording = self._open(header.recording, [header.episode])
        numbers = recording.index["episode"]
        position = bisect.bisect_left(numbers, header.episode)  # numpy's search would copy all numbers first
        if (
            recording.uuid != uuid_of(header)
            or not (numbers[position : position + 1] == header.episode).any()
        ):
            positions_of(recording, ListedEpisodes.of(header.recording, [header]))  # says what has changed
        episode = recording.episodes[position]
        episode.listed = header
        episode.alone = partial(Dataset, self._source, [header])
        return episode

    @property
    def example(self) -> Recording | None:
        """One of the recordings, for its spaces and labels; for an empty dataset, one that filters left out; None if
        there is none."""
        if self.headers:
            return self._open(self.headers[0].recording)
        left_out = self._source.episodes(None)
        return self._source.open(left_out[0].recording, [left_out[0].episode]) if left_out else None

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The space of the states, that of `example`; RecordingError if it has no step, or there is no recording."""
        return self._demand_example().observation_space

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space of the actions, as `observation_space`."""
        return self._demand_example().action_space

    def _demand_example(self) -> Recording:
        if (recording := self.example) is None:
            raise RecordingError(f"{self._source!r} has no episode, so its spaces are not known")
        return recording

    @property
    def made_of(self) -> dict[str, dict[str, Any]]:
        """`Recording.made_of` of those of the recordings that were made of others, by their names.

        Raises:
            FormatError: one says something else.
        """
        said = ((name, recording.made_of) for name, recording in self.opened())
        return {name: document for name, document in said if document is not None}

    @cached_property
    def _chosen(self) -> Mapping[str, Sequence[int]]:
        """The numbers of the episodes, by recording."""
        return numbers_by_recording(self.headers)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes its files, but those of episodes that somebody holds; what needs a file later opens it again. Without
        it, they are closed when nobody holds the dataset."""
        self._steps = None
        self._recordings.forget()

    def opened(self) -> Iterator[tuple[str, Recording]]:
        """The recordings and their names, each opened when it is its turn; other episodes may be missing in them."""
        for name in self._chosen:
            yield name, self._open(name)

    def _open(self, name: str, needed: Sequence[int] | None = None) -> Recording:
        """A recording with the dataset's episodes in it, or at least the `needed` ones."""
        return self._recordings.get(name, self._chosen[name], needed)

    def _of(self, headers: Sequence[EpisodeHeader] | None, *chosen_by: str) -> Dataset:
        made = Dataset(self._source, headers)
        made.chosen_by = (*self.chosen_by, *chosen_by)
        made._recordings = self._recordings
        made._filter, made._order = self._filter, self._order
        made._selector, made._cache = self._selector, self._cache
        return made

    def _whole(self) -> Dataset:
        """The dataset. DatasetError if `filter_steps` narrowed it: then its episodes have lost steps."""
        if self._selector is not None:
            raise DatasetError(
                f"expected whole episodes, found {self!r}; choose episodes by filter, not by filter_steps, or do this "
                "before filter_steps"
            )
        return self

    def __add__(self, other: Dataset | Recording) -> Dataset:
        """The episodes of both, these first. An episode that is in both counts once.

        Raises:
            DatasetError: two of their recordings have the same name and differ, or `filter_steps` narrowed one.
        """
        if not isinstance(other, Dataset | Recording):
            return NotImplemented
        if isinstance(other, Recording):
            other = Dataset(FilesSource([place_of(other)]))
        ids = {header.id for header in self._whole().headers}
        more = [header for header in other._whole().headers if header.id not in ids]
        if self._source is other._source:
            made = self._of([*self.headers, *more])
            made._filter = None
        else:
            joined = JoinedSource([(self._source, self.headers), (other._source, more)])
            made = Dataset(joined, [*self.headers, *more])
            made._cache = self._cache
        by = ["; ".join(one.chosen_by) or "all" for one in (self, other)]
        made.chosen_by = () if by == ["all", "all"] else (f"({by[0]}) + ({by[1]})",)
        return made

    # ---- narrowing

    def filter(self, test: Test) -> Dataset:
        """The episodes that match a test, in the same order.

        Args:
            test: a text ("success and return > 100"), an expression (`F("return") > 100`; `F("metadata.good")`
                is true where that is true), or a function of an `Episode`. Keys are those of `Dataset.keys`.

        Raises:
            FilterError: the test names an unknown key (also of metadata, if nothing matches), compares a key with a
                value that it can never have, or is neither a text, an expression nor a function.
        """
        if callable(test) and not isinstance(test, BaseFilter):
            passing = [header for header in self.headers if test(self._episode(header))]
            return self._of(passing, f"filter: {function_name(test)}")
        wanted = as_filter(test)
        if hasattr(wanted, "__len__"):
            raise FilterError(
                f"expected a filter such as 'return > 100', found a {type(wanted).__name__}; by a mask: dataset[mask]"
            )
        check_keys(wanted, EpisodeHeader)
        narrowed = wanted if self._filter is None else self._filter & wanted
        found = None  # listed later, by this filter too
        if self._listed is not None:
            matches = compile_predicate(wanted, EpisodeHeader)
            found = [header for header in self._listed if matches(header)]
            if not found:
                check_metadata(narrowed, self._source.episodes(None))
        made = self._of(found, text_of(wanted))
        made._filter = narrowed
        return made

    def filter_steps(self, test: TupleFilter | F | str) -> Dataset:
        """The episodes with only those of their steps that match a test.

            dataset.filter_steps("reward > 0 and state[0] < 1").read()
            dataset.filter_steps(F("step") >= 10).windows(8)  # of steps that follow each other

        It narrows what is read of steps: `read`, `windows`, `transitions`, `loader`, `stats`, `to_pandas("steps")`,
        `lengths`, `n_steps`. The episodes stay, also without a step, and each by itself has all of its steps. What
        needs whole episodes (`save`, `map`, `trim`, `annotate`, `delete`, `plot`, `+`) refuses.

        Args:
            test: an expression or a text over state, action, reward, terminal, timeout, info, next_state, time (ns) and
                step (counted from 0 in each episode), or the names of their columns (states, times), or Gymnasium's
                (observation, terminated, truncated), such as `F("state[0]") > 1`, which is evaluated on whole columns.
                Labels mean what they stand for: 'state."Pole Angle" > 0.1', 'action = "left"'. Or a function of one
                step that returns True or False, called for every step that earlier tests chose. Its step is an
                `RLTuple` that has `next_state`, `time` and `step` as well, and `frame`, its picture, or None:
                `lambda step: step.frame is not None`. Evaluated once, when steps are needed.

        Raises:
            FilterError: it is no expression, text or function, or names an unknown field.
        """
        found = TupleSelector(as_filter(test))
        made = self._of(self._listed)
        made._selector = found if self._selector is None else self._selector & found
        return made

    def sort(self, key: str | Callable[[Episode], Any], *, descending: bool = False) -> Dataset:
        """The episodes in the order of a key ("return", "steps", "metadata.score"), or of a function of an `Episode`.

        Equal episodes keep their order; episodes without the value come last.

        Raises:
            FilterError: the key is unknown, also among metadata.
            DatasetError: two of the values cannot be ordered, or the key begins with "-".
        """
        if isinstance(key, str) and key.startswith("-"):
            raise DatasetError(
                f"expected a key, found {key!r:.80}; write sort({key[1:]!r:.80}, descending=True)"
            )
        if not isinstance(key, str) and not callable(key):
            raise DatasetError(
                f"expected a key to sort by, such as 'return', or a function, found {key!r:.80}"
            )
        by = f"sort: {function_name(key) if callable(key) else key}{', descending' if descending else ''}"
        lists = self._order is None and self._unlisted is not None
        if lists and isinstance(key, str) and path_in(key, EpisodeHeader) in _SORTED_BY_STORAGES:
            made = self._of(None, by)  # listed later, maybe only the first
            made._order = key, descending
            return made
        return self._of(self._sorted(self.headers, key, descending), by)

    def _sorted(
        self, headers: Sequence[EpisodeHeader], key: str | Callable[[Episode], Any], descending: bool
    ) -> list[EpisodeHeader]:
        if isinstance(key, str):
            values = values_at(key, headers, self._source.episodes)
        else:
            values = [key(self._episode(header)) for header in headers]
        try:
            places = [i for i, value in enumerate(values) if value is not None and value == value]
            ordered = sorted(places, key=lambda i: values[i], reverse=descending)
        except (TypeError, ValueError) as err:
            raise DatasetError(f"cannot sort by {key!r}: {err}") from err
        rest = sorted(set(range(len(values))) - set(places))
        return [headers[i] for i in [*ordered, *rest]]

    @property
    def _unlisted(self) -> TupliStorage | None:
        """The storage that has yet to list its episodes."""
        return (
            self._source.storage if self._listed is None and isinstance(self._source, StorageSource) else None
        )

    def head(self, n: int = 5) -> Dataset:
        """The first `n` episodes, or as many as there are. A storage finds those of the largest or smallest `return`,
        `steps` or `ended` without a list of all: `open("lab").sort("return", descending=True).head(10)`."""
        most, found = checked_whole(n, 0, "a number of episodes"), None
        if most and (storage := self._unlisted) is not None:
            key, descending = self._order or ("", False)
            order = f"-{key}" if descending else key
            found = storage.list_episodes(self._filter, limit=most, sort=order or None)
        return self._of(found or self.headers[:most], f"head: {n}")

    def sample(self, n: int, *, seed: int | None = None) -> Dataset:
        """`n` different episodes (or as many as there are), drawn at random, in the order of drawing."""
        chosen = None if seed is None else checked_whole(seed, 0, "a seed")
        drawn = np.random.default_rng(chosen).permutation(len(self))
        places = drawn[: checked_whole(n, 0, "a number of episodes")]
        by = f"sample: {n}{'' if seed is None else f', seed {seed}'}"
        return self._of([self.headers[i] for i in places], by)

    def split(self, fraction: float, *, seed: int = 0, by: str | None = None) -> tuple[Dataset, Dataset]:
        """Two datasets: about `fraction` of the episodes, and the others. No episode is in both.

        The side of an episode depends on its id and the seed alone, so it stays the same when others are added.

        Args:
            fraction: expected share of the episodes in the first dataset.
            seed: of the draw.
            by: a key ("run", "metadata.task", "seed"): episodes with the same value stay together. With few different
                values, all may fall on one side, which warns.

        Raises:
            DatasetError: the fraction is not between 0 and 1, the seed is no integer from 0, or `by` is no key.
            FilterError: an unknown key.
        """
        if not isinstance(fraction, int | float | np.number) or not 0 <= fraction <= 1:
            hint = "; for three parts, split one of two again" * isinstance(fraction, list | tuple)
            raise DatasetError(f"expected a fraction from 0 to 1, found {fraction!r:.80}{hint}")
        if not isinstance(by, str | None):
            raise DatasetError(f"expected by=KEY, such as 'run', found {by!r:.80}")
        seed = checked_whole(seed, 0, "a seed")
        values = None if by is None else values_at(by, self.headers, self._source.episodes)
        parts: tuple[list[EpisodeHeader], list[EpisodeHeader]] = ([], [])
        for i, header in enumerate(self.headers):
            name = header.id if values is None else _same_text(values[i])
            digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
            parts[int.from_bytes(digest[:8], "big") >= float(fraction) * 2**64].append(header)
        if by is not None and 0 < fraction < 1 and len(self) and not all(parts):
            warn(f"all episodes are on one side of split(by={by!r}): it has few values; try another seed")
        said = f"split: {fraction:g}{'' if by is None else f' by {by}'}, seed {seed}"
        return self._of(parts[0], f"{said}, first part"), self._of(parts[1], f"{said}, second part")

    @property
    def keys(self) -> list[str]:
        """The keys that filters, `sort` and `split` understand: facts about episodes, and keys of their metadata."""
        return keys_of(self.headers)

    # ---- reading

    def read(self, fields: Sequence[str] = FIVE) -> Columns:
        """Columns of all steps, episode after episode; `episode_lengths` has the length of each.

        Args:
            fields: of states, actions, rewards, terminals, timeouts, next_states, times, infos, frames. The names of
                their values in a step (state), and Gymnasium's (observations, terminations, truncations), mean the
                same. "infos" is a dict for each step; "info.<key>" makes `infos` a dict of columns, as in `windows`.
                "info.contact.left" is a value in a dict.
                "state.arm" or "action.grip", a part of a Dict, leaves the others out of `states` and `next_states`, or
                of `actions`; images that are left out are not read.
                If an episode's final state is not known, `next_states` repeats its last state; `transitions` leaves
                that step out, or masks it.

        Raises:
            DatasetError: a field is unknown.
            SpaceError: one array cannot hold a field of two of the recordings; the message names them. Or a recording
                has no such part of a state or an action.
        """
        keys, others = info_keys(fields)
        if any(keys):
            found = self.read([*others, INFOS])
            found.infos = info_columns(found.infos, keys if all(keys) else None)
            return found
        wanted, parts = fields_and_parts(fields, FIELDS, DatasetError)
        if not self.headers and (example := self.example) is not None:
            return example.read(fields, episodes=[])
        columns, _ = self._read(wanted, parts)
        return Columns(self.lengths, **columns)

    def _read(
        self, fields: Sequence[str], parts: Sequence[str] = ()
    ) -> tuple[dict[str, Any], StepLayout | None]:
        """Columns by field, and the layout of the first recording."""
        columns, self._known, layout = read_columns(
            self._source, self.headers, fields, self._selector, self._known, parts
        )
        return columns, layout

    @property
    def _selected(self) -> Selected:
        """The steps that `filter_steps` chose; without one, all."""
        if self._known is None:
            if self._selector is None:
                self._known = Selected(self._whole_lengths())
            else:
                self._read(["terminals"])
        assert self._known is not None  # reading leaves it behind
        return self._known

    def _whole_lengths(self) -> Array:
        return np.array([header.n_tuples for header in self.headers], np.int64)

    @property
    def step_numbers(self) -> Array:
        """The number of each step (after `filter_steps`) within its episode, from 0: int64 (steps,)."""
        numbers, mask = steps_within(self._whole_lengths()), self._selected.mask
        return numbers if mask is None else numbers[mask]

    @property
    def steps(self) -> Steps:
        """All steps (after `filter_steps`) by number, from 0, episode after episode; windows and samplers read them."""
        if self._steps is None:
            self._steps = RecordedSteps(
                ListedEpisodes.each(self.headers),
                lambda name: nullcontext(self._open(name)),
                self._selected.mask,
                **self._cache,
            )
        return self._steps

    def with_cache(self, cache_bytes: int, threads: int | None = None) -> Dataset:
        """The dataset with another budget for what `windows`, `transitions` and `loader` keep decoded.

        It is in bytes, 512 MiB by default. `threads` read chunks; by default as many as there are cores, at most 4.

        Raises:
            SamplingError: a number is no integer, or too small.
        """
        made = self._of(self._listed)
        made._cache = {**self._cache, **cache_options(cache_bytes, threads)}
        return made

    def _infos(self) -> Sequence[Mapping[str, Any]]:
        infos: Sequence[Mapping[str, Any]] = self.read(["infos"]).infos
        return infos

    def _frames(self) -> FrameValues:
        return FrameValues(self._whole_lengths(), self._frames_of, self._selected.mask)

    def _frames_of(self, place: int) -> Frames:
        return self._episode(self.headers[place]).frames

    def _step_seconds(self) -> float | None:
        known = {recording.labels.step_seconds for _, recording in self.opened()}
        return known.pop() if len(known) == 1 else None

    def loader(
        self,
        *,
        length: int | None = None,
        batch_size: int = 64,
        shuffle: bool = True,
        num_workers: int = 0,
        fields: Sequence[str] | None = None,
        seed: int | None = None,
        drop_last: bool = False,
        **chosen: Any,
    ) -> Any:
        """A PyTorch `DataLoader` of batches: dicts of tensors (`batch["states"]`, shape (batch, length, ...)), in which
        Gymnasium's names find the same columns (`batch["observations"]`).

        It cannot go on within an epoch; `tupli_mcap.torch.StreamDataset` with a `StatefulDataLoader` can.

        Args:
            length: number of consecutive steps of each window; without it, items are single transitions.
            fields: as for `windows`, or for `transitions`.
            seed: of the order; None draws one.
            drop_last: leaves out the last batch if it is not full.
            chosen: further arguments of `windows` (stride, pad, history) or `transitions` (n_step, discount).

        Raises:
            MissingExtraError: PyTorch is not installed.
            SamplingError: no episode has that many steps, or, with `drop_last`, there is no full batch.
            TypeError: there is no such argument, or it goes with the other kind of item.
        """
        from tupli_mcap.torch.mapped import check_arguments, loader

        check_arguments(chosen, of_windows=length is not None)
        if fields is not None:
            chosen["fields"] = fields
        items = self.transitions(**chosen) if length is None else self.windows(length, **chosen)
        return loader(
            items,
            batch_size=batch_size,
            shuffle=shuffle,
            num_workers=num_workers,
            seed=seed,
            drop_last=drop_last,
            remote=any(map(is_url, {header.recording for header in self.headers})),
        )

    def stats(self, fields: Sequence[str] | None = None) -> Mapping[str, FieldStatistics]:
        """Count, mean, std, min, max and quantiles of each leaf by name: `state`, or `state.arm`; `action`, `reward`.

        The names of columns (`states.arm`) and Gymnasium's find them, too. Steps are read once, one block after the
        other, and the result is kept. Leaves of variable size (texts, graphs) have no statistics. An image has those of
        its channels, only if it is named itself ("state.camera"; "state" if states are images): it is decoded for them.

        Args:
            fields: of states, actions, rewards, next_states, infos; also a part of one, such as "state.arm" or
                "info.contact.left". Infos are all read into memory; steps without an info do not count. By default,
                states, actions and rewards, without images.

        Raises:
            DatasetError: a field has no numbers, or there is no step.
            SamplingError: no step has such an info.
            SpaceError: one array cannot hold a field of two of the recordings.
        """
        keys, given = info_keys(("states", "actions", "rewards") if fields is None else fields)
        parts = [split_name(name) if isinstance(name, str) else (name, "") for name in given]
        names = field_names([word for word, _ in parts], (*STATISTICAL, INFOS), DatasetError)
        images = {} if fields is None else images_of(self.steps, names)
        wanted = {f"{step_name(FIELD_OF[word])}{part}": (FIELD_OF[word], part) for word, part in parts}
        numbers = {field: None for name, (field, _) in wanted.items() if name not in images}
        if missing := [field for field in numbers if field not in self._stats]:
            self._stats |= statistics_of(self.steps, missing)
        if missing := [name for name in wanted if name in images and name not in self._stats]:
            self._stats |= {name: {name: statistics_of_image(self.steps, *images[name])} for name in missing}
        if missing := [key for key in keys if f"info.{key}" not in self._stats]:
            self._stats |= statistics_of_infos(self.steps, self._infos(), missing)
        found: dict[str, Any] = {}
        for name, (field, part) in wanted.items():
            found |= self._stats[name] if name in images else part_of(field, part, self._stats[field])
        for key in keys:
            found |= self._stats[f"info.{key}"]
        return ColumnDict(copy.deepcopy(found))  # the caller may change the arrays

    # ---- out

    def to_pandas(self, level: Level = "steps", *, frames: bool = False) -> pd.DataFrame:
        """One row per step or per episode, one column per dimension, with its label if the recordings agree on one.

        Infos and metadata have a column for each key: `info.x`, `metadata.score`. Metadata in dicts have one for each
        value: `run.metadata.opt.lr`, as in filters. An info that is an array of numbers of one shape, or a dict of
        those and of numbers, has one for each number: `info.contact.left[0]`. An image, or an array of more than 500
        numbers, is one column, with an array in each cell. Times are in UTC, with their zone.

        Args:
            level: "steps" or "episodes".
            frames: a column `frames` with the recorded picture of each step, as `read` gives it: uint8 (height, width,
                3). All of them are in memory then.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        return tables.dataframe(self, level, frames=frames)

    def to_arrow(self, level: Level = "steps", *, frames: bool = False) -> pa.Table:
        """The same as an Arrow table, in which null is what is missing. Where Arrow has no type for all values of a
        column, they are texts of JSON.

        Raises:
            MissingExtraError: pandas or pyarrow is not installed.
        """
        return tables.arrow(self, level, frames=frames)

    def save(self, target: str | os.PathLike[str], *, overwrite: bool = False) -> Path:
        """Writes the episodes to a new recording, with everything that belongs to them, in the order of their times.

        Episodes of one recording keep their ids; episodes of several get new ones. `Recording.made_of` of the new one
        says how they were chosen: {"query": "return > 50; sample: 3, seed 0"}.

        Raises:
            DatasetError: there is no episode, one occurs twice, the target exists (without `overwrite`), or it is one
                of the sources.
            RecordingError: it cannot be written.
            SpaceError: two recordings have different spaces.
        """
        return curate.save(self._whole(), target, overwrite=overwrite)

    def save_columns(self, directory: str | os.PathLike[str]) -> None:
        """Writes the steps to an unused directory as plain `.npy` files, which `tupli_mcap.dataset.open_columns` reads
        mapped into memory.

        The directory also holds `manifest.json`; see docs/howto/columns.md. It is written atomically: a killed process
        leaves none. It holds no infos, and does not depend on the recordings. Steps are read a few at a time, within
        the budget of `with_cache`.

        Raises:
            DatasetError: there is no step, values differ in size (texts, graphs), or the directory is no path.
            SpaceError: one array cannot hold the steps of two recordings; the message names them.
            StorageError: the path is used, the disk is full, ...
        """
        save_columns(directory, self.steps, self.headers, self._step_seconds())

    def map(
        self,
        function: Callable[[Episode], Any],
        target: str | os.PathLike[str],
        *,
        fields: Sequence[str] = ("rewards",),
        overwrite: bool = False,
    ) -> Path:
        """Writes the episodes to a new recording with new values of some fields; everything else stays.

        `ds.map(lambda episode: episode.rewards - 1, "relabelled.mcap")` gives other rewards,
        `ds.map(lambda episode: episode.all_states.clip(-1, 1), "clipped.mcap", fields=["states"])` other states.

        Args:
            function: takes an `Episode` and returns its new column (a value for each step, nested as the space is; of
                states one more if the final state is known); with several fields, a dict of columns.
            fields: some of "rewards", "actions", "states".

        Raises:
            DatasetError: there is no episode, one occurs twice, the target exists (without `overwrite`), or it is one
                of the sources.
            SpaceError: two recordings have different spaces.
            RecordingError: the function returns values that the recording's dtype cannot hold exactly, or the target
                cannot be written.
            StepError: a value of variable size is not in its space.
        """
        path = curate.file_path(target)
        return curate.relabel(self._whole(), function, path, fields, overwrite=overwrite).path

    def trim(
        self,
        steps: slice | Callable[[Episode], slice],
        target: str | os.PathLike[str],
        *,
        overwrite: bool = False,
    ) -> Path:
        """Writes the episodes to a new recording, each with only some consecutive steps; everything else stays.

        `ds.trim(slice(10, -5), "trimmed.mcap")` leaves out the first ten steps of each episode and the last five.

        Args:
            steps: the steps that stay, or a function from an `Episode` to them.

        An episode that loses its end ends as interrupted, the state that followed is its final state, and it keeps no
        recorded `success`; one that loses its beginning has no seed, because no reset leads to its first state.

        Raises:
            DatasetError: there is no episode, one occurs twice, the target exists (without `overwrite`), or it is one
                of the sources.
            RecordingError: no step of an episode would stay, the slice has a stride, or the target cannot be written.
        """
        return curate.trim(self._whole(), steps, target, overwrite=overwrite).path

    def annotate(self, **values: Any) -> None:
        """Adds metadata to the episodes, in their files: `ds.filter("return > 100").annotate(success=True)`.

        Values take precedence over the metadata that were recorded; None removes a key. `undo_annotation` takes them
        back. If one recording cannot be changed, none is. The episodes of this dataset have the values; one
        that was listed apart from it has to be opened again.

        Raises:
            RecordingError: there are no values, JSON cannot hold one, one is an array with a value for each episode, or
                a recording is at a URL or on a server, is not finished, or cannot be written.
            NotFoundError: a recording has not the listed episodes any more.
            FormatError: a recording is damaged.
        """
        curate.annotate(self._whole(), values)

    def undo_annotation(self) -> list[Annotation]:
        """Takes the last annotation of each of its recordings back, from all its episodes, and returns them.

        Recordings without an annotation stay as they are. If one recording cannot be changed, none is.

        Raises:
            RecordingError: no recording has an annotation, or as `annotate`.
            FormatError: a recording is damaged.
        """
        return curate.undo_annotation(self._whole())

    def delete(self, *, dry_run: bool = False) -> int:
        """Deletes the episodes where they are stored: `ds.filter("return < 0").delete()`; returns their number.

        Files are not touched: a file beside each (FILE.json) lists its deleted episodes, and `restore_episodes` brings
        them back until `compact` frees their space. Episodes on a server are gone. A dataset that was listed before
        still lists them; open it again.

        Args:
            dry_run: delete nothing, but return the number.

        Raises:
            RecordingError: a file is at a URL; then none is deleted.
            StorageError: an episode on a server is somebody else's, the server cannot be reached, the notes beside a
                file cannot be written, ...
        """
        return curate.delete(self._source, numbers_by_file(self._whole().headers), dry_run=dry_run)

    def __repr__(self) -> str:
        return display.text("Dataset", self._facts())

    def __str__(self) -> str:
        """As `repr`, but lists the episodes first."""
        _ = self.headers
        return repr(self)

    def _repr_html_(self) -> str:
        return self._html("Dataset")

    def _html(self, name: str) -> str:
        _ = self.headers
        return display.html(name, self._facts())

    def _facts(self) -> display.Facts:
        filters = {"steps": None if self._selector is None else self._selector.filters}
        steps = None if self._known is None else self._known.steps
        return display.Facts(repr(self._source), self._listed, steps, filters)


def _places(chosen: Any, count: int) -> list[int]:
    """The places that a mask or a list of numbers names."""
    if hasattr(chosen, "fillna") and chosen.ndim == 1 and chosen.dtype.kind == "b":
        array = _mask_of_pandas(chosen)
    else:
        try:
            array = np.asarray(chosen)
        except ValueError:  # lists of different lengths
            array = np.empty(())
    if array.ndim == 1 and array.dtype == np.bool_:
        if len(array) != count:
            raise DatasetError(f"expected a mask of {count} episodes, found one of {len(array)}")
        return np.flatnonzero(array).tolist()
    if array.ndim != 1 or (len(array) and array.dtype.kind not in "iu"):
        columns = "; read() has columns of steps, to_pandas('episodes') those of episodes"
        raise DatasetError(
            f"expected a number, a slice, a list of numbers or a mask of {count} episodes, found {chosen!r:.80}"
            + columns * isinstance(chosen, str)
        )
    if len(array) and not -count <= array.min() <= array.max() < count:
        raise IndexError(f"expected episodes from 0 to {count - 1}, found {chosen!r:.80}")
    return [int(i) % count for i in array]


def _some(places: Sequence[int]) -> str:
    shown = ", ".join(map(str, places[:_SHOWN]))
    return shown if len(places) <= _SHOWN else f"{shown}, … ({len(places):,} episodes)"


def _mask_of_pandas(mask: Any) -> Array:
    """The flags of the episodes in their order; a Series of a sorted table says by its index which is whose."""
    array: Array = np.asarray(mask.fillna(False), np.bool_)
    index = getattr(mask, "index", None)
    if index is None or index.dtype.kind not in "iu":
        return array
    order = np.argsort(np.asarray(index), kind="stable")
    return array[order] if np.array_equal(index[order], np.arange(len(array))) else array


def _same_text(value: Any) -> str:
    """One text for values that filters take for equal, such as 1 and 1.0."""
    return repr(int(value) if isinstance(value, float) and value.is_integer() else value)
