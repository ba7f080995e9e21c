"""A query: three filters over a source, the episodes that match them, and the columns read so far."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from tupli_mcap.arrays import Array, map_arrays
from tupli_mcap.dataset.columns.load import Selected, TupleFilter, TupleSelector, read_columns
from tupli_mcap.dataset.items import FIELDS, ListedEpisodes, MemorySteps, RecordedSteps, Steps
from tupli_mcap.dataset.keys import matching
from tupli_mcap.dataset.sources import FilesSource, StorageSource, numbers_by_recording
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader, check_keys


class Query:
    """Three filters over a source, and the columns that were read for them. The filters never change.

    `layout` is that of the steps read last; None before.
    """

    def __init__(
        self,
        source: StorageSource | FilesSource,
        benchmark_filter: BaseFilter | None = None,
        episode_filter: BaseFilter | None = None,
        tuple_filter: TupleFilter | None = None,
    ) -> None:
        if benchmark_filter is not None:
            check_keys(benchmark_filter, BenchmarkHeader)
        if episode_filter is not None:
            check_keys(episode_filter, EpisodeHeader)
        self.source = source
        self.benchmark_filter = benchmark_filter
        self.episode_filter = episode_filter
        self.tuple_filter = None if tuple_filter is None else TupleSelector(tuple_filter)
        self.layout: StepLayout | None = None
        self._benchmarks: list[BenchmarkHeader] | None = None
        self._headers: list[EpisodeHeader] | None = None
        self._selected: Selected | None = None
        self._columns: dict[str, Any] = {}
        self._recorded: RecordedSteps | None = None
        self.cache: dict[str, int] = {}  # arguments of `RecordedSteps`

    def __getstate__(self) -> dict[str, Any]:
        # A copy reads the same episodes itself; a layout cannot be pickled.
        return {**self.__dict__, "layout": None, "_columns": {}, "_recorded": None}

    def narrowed(self, **filters: Any) -> Self:
        """A new query whose filters must hold beside those of this one; None removes one. Names are those of the
        constructor's arguments."""
        made = type(self)(self.source, **filters)
        for name in ("benchmark_filter", "episode_filter", "tuple_filter"):
            own, new = getattr(self, name), getattr(made, name)
            if own is not None and (new is not None or name not in filters):
                setattr(made, name, own if new is None else own & new)
        made.cache = self.cache
        return made

    @property
    def benchmarks(self) -> list[BenchmarkHeader]:
        """The benchmarks that match the benchmark filter."""
        if self._benchmarks is None:
            self._benchmarks = self.source.benchmarks(self.benchmark_filter)
        return self._benchmarks

    @property
    def headers(self) -> list[EpisodeHeader]:
        """The episodes; the first call lists them."""
        return self.refresh() if self._headers is None else self._headers

    @property
    def known(self) -> tuple[list[EpisodeHeader] | None, Selected | None]:
        """The episodes and the wanted steps; None for either if it has not been read."""
        return self._headers, self._selected

    @property
    def selected(self) -> Selected:
        """The steps that match the tuple filter."""
        if self._selected is None:
            self.read(["terminals"])
        assert self._selected is not None  # reading leaves it behind
        return self._selected

    def refresh(self) -> list[EpisodeHeader]:
        """Lists the episodes again; columns are kept if the episodes are the same. FilterError if no episode has the
        metadata that the filter names."""
        episodes = functools.partial(self.source.episodes, benchmark_filter=self.benchmark_filter)
        headers = matching(self.episode_filter, episodes)
        if self._headers is None or _identity(headers) != _identity(self._headers):
            self._selected, self.layout, self._columns, self._recorded = None, None, {}, None
        self._headers, self._benchmarks = headers, None
        return headers

    def steps(self) -> Steps:
        """The wanted steps by number: from columns in memory, else from the recordings, on access."""
        if self._recorded is None:
            headers = self.headers
            mask = None if self.tuple_filter is None else self.selected.mask
            chosen = numbers_by_recording(headers)
            self._recorded = RecordedSteps(
                ListedEpisodes.each(headers),
                lambda name: self.source.open(name, chosen[name]),
                mask,
                **self.cache,
            )
        loaded = {field: column for field, column in self._columns.items() if field in FIELDS}
        return MemorySteps(loaded, self._recorded) if loaded else self._recorded

    def read(self, fields: Sequence[str]) -> dict[str, Any]:
        """Columns by field, read-only; they are kept."""
        found = self._missing(fields)
        self._columns.update({field: map_arrays(column, _frozen, list) for field, column in found.items()})
        return {field: self._columns[field] for field in fields}

    def own(self, fields: Sequence[str]) -> dict[str, Any]:
        """Columns by field that the caller may change; columns that have to be read for this are not kept."""
        found = self._missing(fields)
        return {
            field: found[field] if field in found else map_arrays(self._columns[field], np.copy, list)
            for field in fields
        }

    def columns_of(
        self, headers: Sequence[EpisodeHeader], fields: Sequence[str]
    ) -> tuple[dict[str, Any], Array, StepLayout | None]:
        """Columns of episodes that were listed earlier, the number of steps of each, and their layout."""
        if _identity(headers) == _identity(self.headers):
            columns = self.read(fields)
            return columns, self.selected.lengths, self.layout
        columns, selected, layout = read_columns(self.source, headers, fields, self.tuple_filter)
        return columns, selected.lengths, layout

    def _missing(self, fields: Sequence[str]) -> dict[str, Any]:
        missing = [field for field in fields if field not in self._columns]
        if not missing:
            return {}
        found, self._selected, layout = read_columns(
            self.source, self.headers, missing, self.tuple_filter, self._selected
        )
        self.layout = layout or self.layout
        return found


def _identity(headers: Sequence[EpisodeHeader]) -> list[tuple[str, int, str]]:
    """The facts that the columns of some episodes depend on."""
    return [(header.id, header.n_tuples, header.recording) for header in headers]


def _frozen(array: Array) -> Array:
    array.flags.writeable = False
    return array
