"""Writing materialised columns: a query's steps, block after block, into one file a leaf."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from tupli_mcap.dataset.columns import pick
from tupli_mcap.dataset.loading import Selected, positions_of
from tupli_mcap.materialized import BytesWriter, ColumnPlan, ColumnWriter, FileEntry
from tupli_mcap.materialized.plan import LeafFiles
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.variable import VariableField
from tupli_mcap.recording import Recording
from tupli_mcap.recording.blocks import Array, Block, blocks
from tupli_mcap.schema import EpisodeHeader

__all__ = ["StepsWriter", "breaks_of"]


def breaks_of(selected: Selected) -> Array:
    """The wanted steps (int64, ascending) whose next state is not that of the next wanted step: an episode ends, or the
    tuple filter has left out what comes after."""
    ends: Array = np.cumsum(selected.lengths[selected.lengths > 0]) - 1
    if selected.mask is None:
        return ends
    cuts = np.flatnonzero(np.diff(np.flatnonzero(selected.mask)) > 1)
    return np.union1d(ends, cuts)


class _LeafWriter:
    """The files of one leaf while they are written."""

    def __init__(self, directory: Path, files: LeafFiles, codec: VariableField | None) -> None:
        self._files, self._codec = files, codec
        self._array = ColumnWriter(directory / files.array, files.dtype, files.shape)
        self._values = None if codec is None else BytesWriter(directory / files.values)
        self._end = 0
        if codec is not None:
            self._array.put(np.zeros(1, np.int64))

    def put(self, rows: Any) -> None:
        if self._codec is None or self._values is None:
            self._array.put(rows)
            return
        offsets = np.empty(len(rows), np.int64)
        for i, value in enumerate(rows):
            data = bytearray()
            self._codec.encode(value, data, 0)
            self._values.write(data)
            self._end += len(data)
            offsets[i] = self._end
        self._array.put(offsets)

    def finish(self) -> dict[str, FileEntry]:
        files = {self._files.array: self._array.finish()}
        if self._values is not None:
            files[self._files.values] = self._values.finish()
        return files

    def close(self) -> None:
        self._array.close()
        if self._values is not None:
            self._values.close()


class StepsWriter:
    """Writes the columns of the wanted steps of some episodes, recording after recording, in the episodes' order.

    No more is held at any time than what says which steps are wanted, and one block of a recording.
    """

    def __init__(
        self, directory: Path, layout: StepLayout, headers: Sequence[EpisodeHeader], selected: Selected
    ) -> None:
        self._directory, self._layout, self._selected = directory, layout, selected
        self._recorded = np.array([header.n_tuples for header in headers], np.int64)
        self._starts = np.cumsum(self._recorded) - self._recorded  # of each episode, among the listed steps
        self._ids = np.array([header.id.encode() for header in headers])
        self._breaks = breaks_of(selected)
        self._plan = ColumnPlan(layout, selected.steps, len(headers), len(self._breaks))
        self._episode = 0  # the one that is written next
        self._done = 0  # wanted steps
        self._open = contextlib.ExitStack()
        try:
            self._leaves = {name: self._leaf(files) for name, files in self._plan.leaves.items()}
            self._next = {name: self._leaf(files) for name, files in self._plan.next_leaves.items()}
            names = ("terminal", "timeout", "time", "step", "next_state_known")
            self._plain = {name: self._column(name) for name in names}
        except BaseException:
            self.close()
            raise

    def _leaf(self, files: LeafFiles) -> _LeafWriter:
        codec = self._layout.variable[files.leaf.name] if files.variable else None
        return self._open.enter_context(contextlib.closing(_LeafWriter(self._directory, files, codec)))

    def _column(self, name: str) -> ColumnWriter:
        dtype, shape = self._plan.plain[name]
        return self._open.enter_context(ColumnWriter(self._directory / f"{name}.npy", dtype, shape))

    def put(
        self, recording: Recording, headers: Sequence[EpisodeHeader], advance: Callable[[int], None]
    ) -> None:
        """Appends the wanted steps of a recording's episodes; `advance` is told how many steps were read."""
        positions, _ = positions_of(recording, headers)
        first = self._episode
        for block in blocks(recording, positions):
            rows = self._wanted(block)
            self._put_steps(block, rows)
            self._put_following(recording, int(positions[self._episode - first]), block, rows)
            self._done += len(block) if rows is None else len(rows)
            self._episode += len(block.rows) if block.whole else 0
            advance(len(block))

    def _wanted(self, block: Block) -> Array | None:
        """The rows of a block that are wanted; None if all are."""
        here = slice(self._episode, self._episode + len(block.rows))
        steps, mask = _steps(block), self._selected.mask
        listed = steps < np.repeat(self._recorded[here], block.lengths)  # not what was recorded since
        if mask is None:
            return None if listed.all() else np.flatnonzero(listed)
        places = np.repeat(self._starts[here], block.lengths) + steps
        return np.flatnonzero(listed & mask[np.minimum(places, len(mask) - 1)])

    def _put_steps(self, block: Block, rows: Array | None) -> None:
        layout, columns = self._layout, block.columns
        groups = (
            (layout.state, columns.states), (layout.action, columns.actions), (layout.reward, columns.rewards),
        )  # fmt: skip
        for group, values in groups:
            for leaf in group:
                self._leaves[leaf.name].put(_picked(leaf.get(values), rows))
        self._plain["terminal"].put(_picked(columns.terminals, rows))
        self._plain["timeout"].put(_picked(columns.timeouts, rows))
        self._plain["time"].put(_picked(columns.times, rows))
        self._plain["step"].put(_picked(_steps(block), rows))

    def _put_following(self, recording: Recording, position: int, block: Block, rows: Array | None) -> None:
        """The states that follow the breaks of a block, whose first episode is at `position`."""
        count = len(block) if rows is None else len(rows)
        begin, end = np.searchsorted(self._breaks, [self._done, self._done + count])
        if begin == end:
            return
        local = self._breaks[begin:end] - self._done
        after = _After.of(block, local if rows is None else rows[local])
        if after.beyond:
            step = block.first_step + len(block)
            next_block = recording.read_steps(position, step, step + 1, ["states"]).states
        self._plain["next_state_known"].put(after.known)
        theirs = {leaf.keys: leaf.name for leaf in block.layout.state}
        for leaf in self._layout.state:
            following = pick(leaf.get(block.columns.states), after.rows)
            for at, place in after.finals:
                following[at] = block.finals[theirs[leaf.keys]][place]
            if after.beyond:
                following[-1] = leaf.get(next_block)[0]
            self._next[leaf.name].put(following)

    def finish(self) -> tuple[ColumnPlan, dict[str, FileEntry]]:
        """Closes the files, and says what they are."""
        last = {
            "break": self._breaks,
            "episode_length": self._selected.lengths,
            "episode_recorded": self._recorded,
        }
        for name, values in last.items():
            self._plain[name] = self._column(name)
            self._plain[name].put(values)
        files = {f"{name}.npy": writer.finish() for name, writer in self._plain.items()}
        with ColumnWriter(self._directory / "episode_id.npy", self._ids.dtype, self._ids.shape) as ids:
            ids.put(self._ids)
            files["episode_id.npy"] = ids.finish()
        for writer in (*self._leaves.values(), *self._next.values()):
            files |= writer.finish()
        return self._plan, files

    def close(self) -> None:
        """Closes the files, whether they are whole or not."""
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, err: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class _After(NamedTuple):
    """Where the states that follow some rows of a block are.

    rows: rows of the block to take them from. finals: pairs of a place in `rows` and one in the block's final states,
    to take instead. known: False (of bools) where it was not recorded, and is the row's own state. beyond: the last one
    is in the next block.
    """

    rows: Array
    finals: list[tuple[int, int]]
    known: Array
    beyond: bool

    @classmethod
    def of(cls, block: Block, rows: Array) -> _After:
        ends = block.ends if block.whole else np.empty(0, np.int64)
        at_end = np.isin(rows, ends)
        finals_at = {int(block.ends[episode]): place for place, episode in enumerate(block.finals_of)}
        finals = [(at, finals_at[row]) for at, row in enumerate(rows.tolist()) if row in finals_at]
        known = ~at_end
        known[[at for at, _ in finals]] = True
        last = len(block) - 1
        beyond = bool(rows[-1] == last and not at_end[-1])
        return cls(np.where(at_end, rows, np.minimum(rows + 1, last)), finals, known, beyond)


def _picked(column: Any, rows: Array | None) -> Any:
    return column if rows is None else pick(column, rows)


def _steps(block: Block) -> Array:
    """The step of each row, counted from 0 in its episode (int64)."""
    steps: Array = np.arange(len(block)) - np.repeat(block.starts, block.lengths) + block.first_step
    return steps
