"""Reads steps by number from recordings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.index import ListedEpisodes, StepIndex
from tupli_mcap.dataset.items.kept import NumberedRows
from tupli_mcap.dataset.items.segments import Segments
from tupli_mcap.dataset.items.steps import FIELDS, SamplingError, checked_count, checked_fields, rows_of_runs
from tupli_mcap.errors import FormatError, memory_for, plural
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.columns.chunk_store import ChunkCache
from tupli_mcap.recording.columns.gather import EPISODE, Plan, final_rows, image_rows, put, step_rows

CACHE_BYTES = 512 << 20
THREADS = min(4, os.cpu_count() or 1)
_STATES = ("states",)


def cache_options(cache_bytes: int, threads: int | None) -> dict[str, int]:
    """The arguments of `RecordedSteps` for a budget (bytes), and a number of threads if there is one.
    SamplingError if a number is no integer, or too small."""
    options = {"cache_bytes": checked_count(cache_bytes, 0, "a budget in bytes")}
    if threads is not None:
        options["threads"] = checked_count(threads, 1, "a number of threads")
    return options


class RecordedSteps:
    """The steps of episodes in recordings, by number (see `Steps`); a chunk is read when one of its steps is.

    It caches decoded columns if all columns read so far fit into the budget, else the chunks used last. Opening reads
    the indexes of all recordings; few files are open at any time. Thread-safe; a forked child goes on with its own
    copy, and a pickled copy opens the files itself, with an empty cache.

    Args:
        listed: the episodes, in order.
        open_recording: a context manager that opens a recording by its name.
        mask: the wanted ones of the listed steps (bool); None for all.

    Raises:
        NotFoundError: an episode is missing in its recording: the file was changed.
    """

    fields: tuple[str, ...] = FIELDS

    def __init__(
        self,
        listed: Iterable[ListedEpisodes],
        open_recording: Callable[[str], AbstractContextManager[Recording]],
        mask: Array | None = None,
        *,
        cache_bytes: int = CACHE_BYTES,
        threads: int = THREADS,
    ) -> None:
        self.cache_bytes = cache_bytes
        self.threads = threads
        self._parts: Sequence[str] = ()
        self._cache = ChunkCache(cache_bytes)
        self._index = StepIndex.of(listed, open_recording, self._cache)
        self._wanted = None if mask is None else np.flatnonzero(mask)
        self._ends = np.cumsum(self._index.lengths)
        self._select()
        self._prepare()

    def _select(self) -> None:
        """Facts about the wanted steps."""
        index, wanted = self._index, self._wanted
        has_steps = index.lengths > 0
        last, unknown = self._ends[has_steps] - 1, self._ends[has_steps & index.unknown] - 1
        if wanted is None:
            self.episode_lengths, self.breaks, self.open_ends = index.lengths, last, unknown
            self.identity = index.digest
            return
        self.episode_lengths = np.diff(np.searchsorted(wanted, np.concatenate([[0], self._ends])))
        broken = np.isin(wanted, last)
        broken[:-1] |= np.diff(wanted) > 1
        broken[-1:] = True
        self.breaks = np.flatnonzero(broken)
        self.open_ends = np.flatnonzero(np.isin(wanted, unknown))
        self.identity = hashlib.sha256(index.digest.encode() + wanted.tobytes()).hexdigest()

    def _prepare(self) -> None:
        index = self._index
        self.layout: StepLayout | None = index.layouts[0].only(self._parts) if index.layouts else None
        self._rows: list[NumberedRows] = []  # steps, images, final states
        if index.layouts:
            files = index.files
            images = [NumberedRows(image_rows(files, name), at) for name, at in index.images.items()]
            finals = NumberedRows(final_rows(files), index.finals)
            self._rows = [NumberedRows(step_rows(files), index.steps), *images, finals]
        self._used: list[set[str]] = [set() for _ in self._rows]
        self._plans: dict[tuple[str, ...], Plan] = {}

    def __getstate__(self) -> dict[str, Any]:
        rest = ("layout", "_rows", "_used", "_plans")
        return {key: value for key, value in self.__dict__.items() if key not in rest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def only(self, parts: Sequence[str]) -> RecordedSteps:
        """As `Steps.only`; of images, those of these parts alone are read."""
        made = RecordedSteps.__new__(RecordedSteps)
        made.__setstate__({**self.__getstate__(), "_parts": parts})
        return made

    def __len__(self) -> int:
        return int(self._index.lengths.sum()) if self._wanted is None else len(self._wanted)

    def __repr__(self) -> str:
        return f"<{plural(len(self), 'step')} of {plural(len(self.episode_lengths), 'episode')}>"

    def blocks(self, rows: Array) -> Array:
        """The chunk of each row: that of the image if states have one."""
        listed = rows if self._wanted is None else self._wanted[rows]
        where = self._largest
        return where.units[where.of(listed)]

    @property
    def _largest(self) -> Segments:
        """Where the images of the states are; the steps, if states have none."""
        names = {leaf.name for leaf in self.layout.state} if self.layout is not None else set()
        images = (found for name, found in self._index.images.items() if name in names)
        return next(images, self._index.steps)

    @property
    def block_bytes(self) -> int:
        """Average size of a decompressed chunk (bytes); 0 without a chunk."""
        index = self._index
        units = self._largest
        sizes = [
            index.stores[file]
            .table["uncompressed"][units.chunk_of[units.file_of == file]]
            .sum(dtype=np.int64)
            for file in range(len(index.stores))
        ]
        return int(sum(sizes)) // max(1, len(units.chunk_of))

    def limit(self, cache_bytes: int, threads: int) -> None:
        """As `Steps.limit`."""
        self.cache_bytes, self.threads = cache_bytes, threads
        self._cache.clear()
        for rows in self._rows:
            rows.hold(())
        self._share_budget()

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        """As `Steps.read`; only the chunks of these rows are decompressed."""
        n = len(self)
        if len(rows) and (rows.min() < 0 or rows.max() >= n):
            wrong = rows[(rows < 0) | (rows >= n)][0]
            raise IndexError(f"expected steps from 0 to {n - 1}, found {wrong}")
        listed = rows if self._wanted is None else self._wanted[rows]
        return self._columns(
            fields, lambda rows, names: rows.read(names, listed, self.threads), lambda: listed
        )

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        """As `Steps.read_runs`."""
        if self._wanted is not None:  # the next wanted step is not always in the next row
            return self.read(fields, rows_of_runs(starts, length))
        return self._columns(
            fields,
            lambda rows, names: rows.read_runs(names, starts, length, self.threads),
            lambda: rows_of_runs(starts, length),
        )

    def _columns(
        self,
        fields: Sequence[str],
        read: Callable[[NumberedRows, Sequence[str]], dict[str, Any]],
        listed: Callable[[], Array],
    ) -> dict[str, Any]:
        """The columns of some listed steps; `read` returns their leaves."""
        if self.layout is None:
            return {field: np.empty(0) for field in checked_fields(fields)}
        with memory_for(lambda: f"reading {', '.join(fields)} of {len(listed())} steps"):
            plan = self._plans.get(tuple(fields)) or self._plan(self.layout, fields)
            leaf_columns: dict[str, Any] = {}
            for i, leaves in plan.sources:
                leaf_columns.update(read(self._rows[i], leaves))
            columns = plan.nest(leaf_columns)
            if "next_states" not in fields:
                return columns
            columns["next_states"] = self._next_states(listed())
            return {field: columns[field] for field in checked_fields(fields)}

    def _plan(self, layout: StepLayout, fields: Sequence[str]) -> Plan:
        """The plan to read some fields, whose columns then share the budget."""
        names = checked_fields(fields)
        self._index.check(names, self._parts)
        kinds = [rows.columns for rows in self._rows[:-1]]
        plan = Plan.of([field for field in names if field != "next_states"], layout, kinds)
        for i, leaves in plan.sources:
            self._used[i].update(leaves)
        if "next_states" in names:
            states = self._plans[_STATES] = Plan.of(["states"], layout, kinds)
            for i, leaves in states.sources:
                self._used[i].update(leaves)
            self._used[-1].update(leaf.name for leaf in layout.state)
            self._used[-1].add(EPISODE)
        self._share_budget()
        self._plans[tuple(fields)] = plan
        return plan

    def _share_budget(self) -> None:
        """Decides which of the columns read so far are kept decoded."""
        sizes = {i: rows.nbytes(self._used[i]) for i, rows in enumerate(self._rows)}
        if sum(sizes.values()) > self.cache_bytes:
            sizes = {i: size for i, size in sizes.items() if i in (0, len(self._rows) - 1)}  # without images
            if sum(sizes.values()) > self.cache_bytes // 2:
                sizes = {}
        for i, rows in enumerate(self._rows):
            rows.hold(self._used[i] if i in sizes else ())
        self._cache.budget = self.cache_bytes - sum(sizes.values())

    def _next_states(self, listed: Array) -> Any:
        index = self._index
        episodes = np.searchsorted(self._ends, listed, side="right")
        after = np.where(listed == self._ends[episodes] - 1, index.after[episodes], listed + 1)
        at_end = np.flatnonzero(after < 0)
        rows = np.where(after < 0, listed, after)
        plan = self._plans[_STATES]
        columns: dict[str, Any] = {}
        for i, names in plan.sources:
            columns.update(self._rows[i].read(names, rows, self.threads))
        if len(at_end):
            finals = self._finals(list(columns), -1 - after[at_end])
            for name, column in columns.items():
                put(column, at_end, finals[name])
        return plan.nest(columns)["states"]

    def _finals(self, names: Sequence[str], rows: Array) -> dict[str, Any]:
        finals = self._rows[-1].read([*names, EPISODE], rows, self.threads)
        expected = self._index.final_numbers[rows]
        wrong = np.flatnonzero(finals[EPISODE] != expected)
        if len(wrong):
            i = int(wrong[0])
            raise FormatError(
                f"expected the final state of episode {expected[i]}, found that of {finals[EPISODE][i]}; "
                "verify the recordings"
            )
        return finals


def steps_of(
    recording: Recording, *, cache_bytes: int = CACHE_BYTES, threads: int = THREADS
) -> RecordedSteps:
    """All steps of one recording, for example for `Windows(steps_of(recording), 32)`; `cache_bytes` and `threads` as
    for `RecordedSteps.limit`.

    Raises:
        RecordingError: it has no step yet.
        SamplingError: it is no `Recording`.
    """
    if not isinstance(recording, Recording):
        raise SamplingError(f"expected a Recording, found {recording!r:.80}; open it, or take dataset.steps")
    numbers, lengths = (recording.index[name].astype(np.int64) for name in ("episode", "length"))
    listed = ListedEpisodes(recording.name, numbers, lengths)
    return RecordedSteps([listed], lambda _: nullcontext(recording), cache_bytes=cache_bytes, threads=threads)
