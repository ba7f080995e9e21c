"""Steps read out of recordings, as they are asked for."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.items.files import OpenFiles
from tupli_mcap.dataset.items.gather import TIME, ConstantRows, Rows
from tupli_mcap.dataset.items.index import ListedEpisodes, StepIndex
from tupli_mcap.dataset.items.kinds import EPISODE, final_rows, image_rows, step_rows
from tupli_mcap.dataset.items.steps import SamplingError, checked_fields, rows_of_runs
from tupli_mcap.errors import FormatError, memory_for
from tupli_mcap.messages.shared_dtypes import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.columns.chunk_store import ChunkCache

__all__ = ["CACHE_BYTES", "THREADS", "RecordedSteps", "steps_of"]

CACHE_BYTES = 512 << 20
THREADS = min(4, os.cpu_count() or 1)
_PLAIN = {"terminals": "terminal", "timeouts": "timeout", "times": TIME}


class _Plan(NamedTuple):
    """How to read some fields: the leaves to read of each kind of rows, then how the fields are made of them."""

    sources: list[tuple[Rows, list[str]]]
    fields: list[tuple[str, Callable[[list[Any]], Any], list[str]]]


class RecordedSteps:
    """The steps of episodes in recordings, by number (see `Steps`); each chunk is read when a step of it is asked for.

    What is read is kept: decoded columns, where those asked for so far fit into the budget all together, else the
    chunks used last. Opening reads the indexes of all recordings; few files are open at any time. Safe from several
    threads; a forked child goes on with its own copy, and a pickled copy opens the files itself, with nothing kept.

    Args:
        listed: the episodes, in order.
        open_recording: opens a recording by its name; it is left when it has been looked at.
        mask: which of the listed steps are wanted (bool); None for all.
        cache_bytes: budget for what is kept.
        threads: how many read chunks.

    Raises:
        SpaceError: two recordings do not fit into one array.
        NotFoundError: an episode is not in its recording any more.
    """

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
        self._cache = ChunkCache(cache_bytes)
        self._index = StepIndex.of(listed, open_recording, OpenFiles(), self._cache)
        self._wanted = None if mask is None else np.flatnonzero(mask)
        self._ends = np.cumsum(self._index.lengths)
        self._select()
        self._prepare()

    def _select(self) -> None:
        """Facts about the wanted steps."""
        index, wanted = self._index, self._wanted
        some = index.lengths > 0
        last, unknown = self._ends[some] - 1, self._ends[some & index.unknown] - 1
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
        self.layout: StepLayout | None = index.layouts[0] if index.layouts else None
        self._rows: list[Rows] = []
        if index.layouts:
            self._rows = [
                step_rows(index),
                *(image_rows(index, name) for name in index.images),
                final_rows(index),
            ]
        self._used: list[set[str]] = [set() for _ in self._rows]
        self._plans: dict[tuple[str, ...], _Plan] = {}

    def __getstate__(self) -> dict[str, Any]:
        rest = ("layout", "_rows", "_used", "_plans")
        return {key: value for key, value in self.__dict__.items() if key not in rest}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def __len__(self) -> int:
        return int(self._index.lengths.sum()) if self._wanted is None else len(self._wanted)

    def blocks(self, rows: Array) -> Array:
        """The chunk that each row lies in: that of the image, where a state has one."""
        listed = rows if self._wanted is None else self._wanted[rows]
        where = next(iter(self._index.images.values()), self._index.steps)
        return where.units[where.of(listed)]

    @property
    def block_bytes(self) -> int:
        """Bytes of a chunk once it is decompressed, on average; 0 where there is none."""
        index = self._index
        units = next(iter(index.images.values()), index.steps)
        sizes = [
            index.stores[file]
            .table["uncompressed"][units.chunk_of[units.file_of == file]]
            .sum(dtype=np.int64)
            for file in range(len(index.stores))
        ]
        return int(sum(sizes)) // max(1, len(units.chunk_of))

    def limit(self, cache_bytes: int, threads: int) -> None:
        """Forgets what is kept, and keeps to another budget, and to other threads, from now on."""
        self.cache_bytes, self.threads = cache_bytes, threads
        self._cache.clear()
        for rows in self._rows:
            if isinstance(rows, ConstantRows):
                rows.hold(())
        self._share_budget()

    @property
    def room(self) -> int:
        """How many steps are in the chunks that fit into half the cache."""
        stored = sum(int(store.table["uncompressed"].sum()) for store in self._index.stores)
        images = (
            sum(leaf.size for leaf in self.layout.images) if self.layout else 0
        )  # stored smaller, some of them
        return int(self.cache_bytes / 2 / max(1, stored / max(1, len(self)), images))

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        n = len(self)
        if len(rows) and (rows.min() < 0 or rows.max() >= n):
            wrong = rows[(rows < 0) | (rows >= n)][0]
            raise IndexError(f"expected steps from 0 to {n - 1}, found {wrong}")
        listed = rows if self._wanted is None else self._wanted[rows]
        return self._columns(
            fields,
            lambda source, names: source.read(names, listed, self.threads),
            lambda: listed,
        )

    def read_runs(self, fields: Sequence[str], starts: Array, length: int) -> dict[str, Any]:
        if self._wanted is not None:  # what follows a step is not always in the next row
            return self.read(fields, rows_of_runs(starts, length))
        return self._columns(
            fields,
            lambda source, names: source.read_runs(names, starts, length, self.threads),
            lambda: rows_of_runs(starts, length),
        )

    def _columns(
        self,
        fields: Sequence[str],
        read: Callable[[Rows, Sequence[str]], dict[str, Any]],
        listed: Callable[[], Array],
    ) -> dict[str, Any]:
        """The columns of some listed steps, whose leaves `read` gives."""
        with memory_for(lambda: f"reading {', '.join(fields)} of {len(listed())} steps"):
            return self._planned(fields, read, listed)

    def _planned(
        self,
        fields: Sequence[str],
        read: Callable[[Rows, Sequence[str]], dict[str, Any]],
        listed: Callable[[], Array],
    ) -> dict[str, Any]:
        plan = self._plans.get(tuple(fields)) or self._plan(fields)
        found: dict[str, Any] = {}
        for source, names in plan.sources:
            found.update(read(source, names))
        columns: dict[str, Any] = {}
        for field, nest, names in plan.fields:
            if field == "next_states":
                columns[field] = self._next_states(nest, names, listed())
            else:
                columns[field] = nest([found[name] for name in names])
        return columns

    def _plan(self, fields: Sequence[str]) -> _Plan:
        """What has to be read for some fields; from now on, the budget is shared with it."""
        names = checked_fields(fields)
        layout = self.layout
        plan = _Plan([], [])
        if layout is None:
            plan.fields.extend((field, lambda _: np.empty(0), []) for field in names)
            return plan
        nests = {"actions": layout.nest_action, "rewards": layout.nest_reward, "times": _times}
        for field in names:
            leaves = field_leaves(field, layout)
            own = [_PLAIN[field]] if leaves is None else [leaf.name for leaf in leaves]
            nest = nests.get(field, _only if leaves is None else layout.nest_state)
            plan.fields.append((field, nest, own))
        needed = [name for field, _, own in plan.fields if field != "next_states" for name in own]
        for source in self._rows[:-1]:
            chosen = [name for name in needed if name in source.columns]
            if chosen:
                plan.sources.append((source, chosen))
        self._use(plan)
        self._plans[tuple(fields)] = plan
        return plan

    def _use(self, plan: _Plan) -> None:
        wanted = list(plan.sources)
        for field, _, names in plan.fields:
            if field == "next_states":
                wanted += [(source, [n for n in names if n in source.columns]) for source in self._rows[:-1]]
                wanted.append((self._rows[-1], [*names, EPISODE]))
        for source, names in wanted:
            self._used[self._rows.index(source)].update(names)
        self._share_budget()

    def _share_budget(self) -> None:
        """Decides which columns are kept decoded, out of those that were asked for so far."""
        sizes = {
            i: rows.nbytes(self._used[i])
            for i, rows in enumerate(self._rows)
            if isinstance(rows, ConstantRows)
        }
        if sum(sizes.values()) > self.cache_bytes:
            sizes = {i: size for i, size in sizes.items() if i in (0, len(self._rows) - 1)}  # without images
            if sum(sizes.values()) > self.cache_bytes // 2:
                sizes = {}
        for i, rows in enumerate(self._rows):
            if isinstance(rows, ConstantRows):
                rows.hold(self._used[i] if i in sizes else ())
        self._cache.budget = self.cache_bytes - sum(sizes.values())

    def _next_states(self, nest: Callable[[list[Any]], Any], names: Sequence[str], listed: Array) -> Any:
        index = self._index
        episodes = np.searchsorted(self._ends, listed, side="right")
        after = np.where(listed == self._ends[episodes] - 1, index.after[episodes], listed + 1)
        at_end = np.flatnonzero(after < 0)
        rows = np.where(after < 0, listed, after)
        found: dict[str, Any] = {}
        for source in self._rows[:-1]:
            chosen = [name for name in names if name in source.columns]
            found.update(source.read(chosen, rows, self.threads) if chosen else {})
        if len(at_end):
            finals = self._finals(names, -1 - after[at_end])
            for name in names:
                _put(found[name], at_end, finals[name])
        return nest([found[name] for name in names])

    def _finals(self, names: Sequence[str], rows: Array) -> dict[str, Any]:
        found = self._rows[-1].read([*names, EPISODE], rows, self.threads)
        expected = self._index.final_numbers[rows]
        wrong = np.flatnonzero(found[EPISODE] != expected)
        if len(wrong):
            i = int(wrong[0])
            raise FormatError(
                f"expected the final state of episode {expected[i]}, found that of {found[EPISODE][i]}; "
                "verify the recordings"
            )
        return found


def _put(column: Any, places: Array, values: Any) -> None:
    if isinstance(column, list):
        for place, value in zip(places.tolist(), values, strict=True):
            column[place] = value
    else:
        column[places] = values


def _only(values: list[Any]) -> Any:
    return values[0]


def _times(values: list[Any]) -> Array:
    signed: Array = values[0].view(np.int64)
    if (signed < 0).any():
        raise FormatError(f"expected times of steps below 2**63 ns, found {values[0].max()}")
    return signed


def steps_of(
    recording: Recording, *, cache_bytes: int = CACHE_BYTES, threads: int = THREADS
) -> RecordedSteps:
    """All steps of one recording, for `Windows(steps_of(recording), 32)` and the like.

    Raises:
        RecordingError: it has no step yet.
        SamplingError: it is no `Recording`.
    """
    if not isinstance(recording, Recording):
        raise SamplingError(f"expected a Recording, found {recording!r:.80}; open it, or take dataset.steps")
    numbers, lengths = (recording.index[name].astype(np.int64) for name in ("episode", "length"))
    listed = ListedEpisodes(recording.name, numbers, lengths)
    return RecordedSteps([listed], lambda _: nullcontext(recording), cache_bytes=cache_bytes, threads=threads)
