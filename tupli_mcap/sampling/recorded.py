"""Steps read out of recordings, as they are asked for."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError
from tupli_mcap.messages.common import field_leaves
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Recording
from tupli_mcap.recording.chunks import ChunkCache
from tupli_mcap.sampling.files import OpenFiles
from tupli_mcap.sampling.gather import TIME, ConstantRows, Rows
from tupli_mcap.sampling.index import ListedEpisodes, StepIndex
from tupli_mcap.sampling.kinds import EPISODE, final_rows, image_rows, step_rows
from tupli_mcap.sampling.steps import checked_fields

__all__ = ["CACHE_BYTES", "THREADS", "RecordedSteps"]

CACHE_BYTES = 512 << 20
THREADS = min(4, os.cpu_count() or 1)
_PLAIN = {"terminals": "terminal", "timeouts": "timeout", "times": TIME}
Array = np.ndarray[Any, Any]


class RecordedSteps:
    """The steps of episodes in recordings, by number (see `Steps`); each chunk is read when a step of it is asked for.

    What is read is kept: decoded columns, where those asked for so far fit into the budget all together, else the
    chunks used last. Opening reads the indexes of all recordings; few files are open at any time. Safe from several
    threads; a forked child goes on with its own copy, and a pickled copy opens the files itself, with nothing kept.

    Args:
        listed: the episodes, in order.
        open_recording: opens a recording by its name.
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
        open_recording: Callable[[str], Recording],
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
        self._rows_of = {name: rows for rows in self._rows[:-1] for name in rows.columns}
        self._used: dict[int, set[str]] = {}

    def __getstate__(self) -> dict[str, Any]:
        rest = ("layout", "_rows", "_rows_of", "_used")
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

    def read(self, fields: Sequence[str], rows: Array) -> dict[str, Any]:
        fields = checked_fields(fields)
        layout = self.layout
        if layout is None:
            return {field: np.empty(0) for field in fields}
        listed = rows if self._wanted is None else self._wanted[rows]
        nest = {"states": layout.nest_state, "actions": layout.nest_action, "rewards": layout.nest_reward}
        groups = {field: field_leaves(field, layout) or () for field in nest if field in fields}
        names = [leaf.name for group in groups.values() for leaf in group]
        found = self._read([*names, *(_PLAIN[field] for field in fields if field in _PLAIN)], listed)
        columns: dict[str, Any] = {}
        for field in fields:
            if field == "next_states":
                columns[field] = self._next_states(layout, listed)
            elif field in _PLAIN:
                columns[field] = found[_PLAIN[field]]
            else:
                columns[field] = nest[field]([found[leaf.name] for leaf in groups[field]])
        if "times" in columns:
            columns["times"] = _signed(columns["times"])
        return columns

    def _read(self, names: Sequence[str], listed: Array) -> dict[str, Any]:
        """Columns of listed steps, by name of the leaf."""
        by_rows: dict[int, tuple[Rows, list[str]]] = {}
        for name in names:
            rows = self._rows_of[name]
            by_rows.setdefault(id(rows), (rows, []))[1].append(name)
        found: dict[str, Any] = {}
        for rows, chosen in by_rows.values():
            found.update(self._read_of(rows, chosen, listed))
        return found

    def _read_of(self, rows: Rows, names: Sequence[str], wanted: Array) -> dict[str, Any]:
        used = self._used.setdefault(id(rows), set())
        if not used.issuperset(names):
            used.update(names)
            self._share_budget()
        return rows.read(names, wanted, self.threads)

    def _share_budget(self) -> None:
        """Decides which columns are kept decoded, out of those that were asked for so far."""
        sizes = {
            id(rows): rows.nbytes(self._used[id(rows)])
            for rows in self._rows
            if isinstance(rows, ConstantRows) and id(rows) in self._used
        }
        images = {id(rows) for rows in self._rows[1:-1]}
        if sum(sizes.values()) > self.cache_bytes:
            sizes = {key: size for key, size in sizes.items() if key not in images}
            if sum(sizes.values()) > self.cache_bytes // 2:
                sizes = {}
        for rows in self._rows:
            if isinstance(rows, ConstantRows):
                rows.hold(id(rows) in sizes)
        self._cache.budget = self.cache_bytes - sum(sizes.values())

    def _next_states(self, layout: StepLayout, listed: Array) -> Any:
        index = self._index
        episodes = np.searchsorted(self._ends, listed, side="right")
        after = np.where(listed == self._ends[episodes] - 1, index.after[episodes], listed + 1)
        names = [leaf.name for leaf in layout.state]
        at_end = np.flatnonzero(after < 0)
        found = self._read(names, np.where(after < 0, listed, after))
        if len(at_end):
            finals = self._finals(names, -1 - after[at_end])
            for name in names:
                _put(found[name], at_end, finals[name])
        return layout.nest_state([found[name] for name in names])

    def _finals(self, names: Sequence[str], rows: Array) -> dict[str, Any]:
        found = self._read_of(self._rows[-1], [*names, EPISODE], rows)
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


def _signed(times: Array) -> Array:
    signed = times.view(np.int64)
    if (signed < 0).any():
        raise FormatError(f"expected times of steps below 2**63 ns, found {times.max()}")
    return signed
