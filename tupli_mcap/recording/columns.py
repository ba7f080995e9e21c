"""Whole columns from chunks: one preallocated array a leaf, filled chunk by chunk, in threads if asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.chunks import ChunkStore
from tupli_mcap.recording.pieces import Pieces, Runs, final_runs, items, items_dtype
from tupli_mcap.recording.together import do_all

__all__ = ["FIELDS", "ColumnReader", "Columns"]

FIELDS = ("states", "actions", "rewards", "terminals", "timeouts", "next_states", "times")
_TIME = "#log_time"
Array = np.ndarray[Any, Any]
_MANY_ROWS = 1000  # fewer are copied before they have been looked at in another way


@dataclass
class Columns:
    """Columns of the asked fields, None for the others.

    A constant leaf is an array of shape (steps, *leaf shape), a leaf of variable size a list; both are nested as the
    space is. `episode_lengths` (int64) says where episodes end. `times` (int64, ns) is the wall clock when each step
    returned.
    """

    episode_lengths: Array
    states: Any = None
    actions: Any = None
    rewards: Any = None
    terminals: Any = None
    timeouts: Any = None
    next_states: Any = None
    times: Any = None

    def __len__(self) -> int:
        return int(self.episode_lengths.sum())


class ColumnReader:
    """Reads columns of a recording's layout."""

    def __init__(self, layout: StepLayout, store: ChunkStore, images: dict[str, dict[int, int]]) -> None:
        self._layout = layout
        self._store = store
        self._images = images  # leaf name -> step channel -> image channel
        self._decoder = None if layout.constant else MessageDecoder(layout)

    def read(
        self,
        runs: Runs,
        total: int,
        fields: Sequence[str],
        threads: int,
        keep: bool,
        images: bool = True,
    ) -> dict[str, Any]:
        """`fields` nested as their spaces are; `keep` puts the chunks read into the cache.

        Without `images`, the columns of image leaves are empty.
        """
        unknown = [field for field in fields if field not in FIELDS]
        if unknown:
            raise RecordingError(
                f"expected fields from {', '.join(FIELDS)}, found {', '.join(map(repr, unknown))}"
            )
        layout = self._layout
        wanted = {
            "states": layout.state, "actions": layout.action, "rewards": layout.reward,
        }  # fmt: skip
        leaves = [leaf for field, group in wanted.items() if field in fields for leaf in group]
        flags = [name for name in ("terminal", "timeout") if f"{name}s" in fields]
        skipped = {leaf.name for leaf in leaves if leaf.apart and not images}
        out: dict[str, Any] = {
            leaf.name: self._empty(leaf, 0 if leaf.name in skipped else total) for leaf in leaves
        }
        out.update({name: np.empty(total, np.bool_) for name in flags})
        if "times" in fields:
            out[_TIME] = np.empty(total, np.uint64)
        tasks: list[Callable[[], None]] = []
        plain = [leaf.name for leaf in leaves if not leaf.apart and leaf.size] + flags
        if layout.constant and "times" in fields:
            plain.append(_TIME)
        elif "times" in fields:
            self._read_times(runs, out[_TIME])
        if plain and layout.constant:
            tasks += self._tasks(runs, plain, out, layout.step_message.dtype, keep)
        elif plain:
            self._decode(runs, plain, out)
        for leaf in leaves:
            if leaf.apart and leaf.name not in skipped:
                moved = runs._replace(channels=self._image_channels(leaf.name, runs.channels))
                dtype = layout.image_messages[leaf.name].dtype
                tasks += self._tasks(moved, ["data"], {"data": out[leaf.name]}, dtype, keep, leaf)
        do_all(tasks, threads)
        nest = {"states": layout.nest_state, "actions": layout.nest_action, "rewards": layout.nest_reward}
        columns = {
            field: nest[field]([out[leaf.name] for leaf in group])
            for field, group in wanted.items()
            if field in fields
        }
        columns.update({f"{name}s": out[name] for name in flags})
        if "times" in fields:
            columns["times"] = out[_TIME].view(np.int64)
            if (columns["times"] < 0).any():
                raise FormatError(f"expected times of steps below 2**63 ns, found {out[_TIME].max()}")
        return columns

    def _empty(self, leaf: Leaf, total: int) -> Any:
        if leaf.kind == "variable":
            return [None] * total
        return np.empty((total, *leaf.shape), self._layout.dtypes[leaf.name])

    def _image_channels(self, name: str, channels: Array | Sequence[int]) -> Array:
        found, places = np.unique(channels, return_inverse=True)
        images: Array = np.array([self._images[name][channel] for channel in found.tolist()], np.int64)[
            places
        ]
        return images

    def _tasks(
        self,
        runs: Runs,
        names: Sequence[str],
        out: Mapping[str, Any],
        dtype: Any,
        keep: bool,
        image: Leaf | None = None,
    ) -> list[Callable[[], None]]:
        targets = [(name, out[name]) for name in names]
        turned = image is not None and image.frames_last
        if len(targets[0][1]) >= _MANY_ROWS and not turned:
            targets = [(name, items(column)) for name, column in targets]
            dtype = items_dtype(dtype)

        def copy(pieces: Pieces) -> None:
            rows: Any = self._store.rows(pieces.chunk, dtype, keep=keep)
            if image is not None and turned:
                rows = {"data": image.as_values(rows["data"])}
            pieces.copy(rows, targets)

        return [partial(copy, pieces) for pieces in Pieces.of(runs, self._store)]

    def _decode(self, runs: Runs, names: list[str], out: dict[str, Any]) -> None:
        if self._decoder is None:
            raise RecordingError("a constant layout is not decoded message by message")
        for channel, first, steps, place in runs.each():
            for i, body in enumerate(self._store.bodies(channel, first, steps)):
                values = self._decoder.step(body)
                for name in names:
                    out[name][place + i] = values[name]

    def _read_times(self, runs: Runs, out: Array) -> None:
        for channel, first, steps, place in runs.each():
            out[place : place + steps] = np.fromiter(
                self._store.times(channel, first, steps), np.uint64, steps
            )

    def final_columns(self, channel: int, episodes: Array) -> list[Any]:
        """A column of final states for each leaf of the state, of index rows that all have one."""
        if self._decoder is not None:
            found = [values for values in self.final_states(channel, episodes) if values is not None]
            return [
                [values[leaf.name] for values in found]
                if leaf.kind == "variable"
                else np.array([values[leaf.name] for values in found], self._layout.dtypes[leaf.name])
                for leaf in self._layout.state
            ]
        out = {leaf.name: self._empty(leaf, len(episodes)) for leaf in self._layout.state}
        numbers = np.empty(len(episodes), np.uint32)
        names = [leaf.name for leaf in self._layout.state if leaf.size] + ["episode"]
        for task in self._tasks(
            final_runs(episodes, channel),
            names,
            {**out, "episode": numbers},
            self._layout.final_message.dtype,
            True,
        ):
            task()
        wrong = np.flatnonzero(numbers != episodes["episode"])
        if len(wrong):
            first = int(wrong[0])
            raise FormatError(
                f"expected the final state of episode {episodes['episode'][first]}, found that of {numbers[first]}"
            )
        return [out[leaf.name] for leaf in self._layout.state]

    def final_states(self, channel: int, episodes: Array) -> list[dict[str, Any] | None]:
        """Leaf values of the final state of each given index row, by leaf name; None where there is none."""
        found: list[dict[str, Any] | None] = []
        for row in episodes:
            if row["final_row"] < 0:
                found.append(None)
                continue
            (span,) = self._store.spans(channel, int(row["final_row"]), 1)
            if self._decoder is None:
                rows = self._store.rows(span.chunk, self._layout.final_message.dtype)
                record = rows[span.begin]
                number = int(record["episode"])
                values = {leaf.name: record[leaf.name] for leaf in self._layout.state if leaf.size}
            else:
                data = memoryview(self._store.load(span.chunk))
                start, end = self._store.messages(span.chunk)[span.begin]
                number, values = self._decoder.final(data[start + BODY : end])
            if number != row["episode"]:
                raise FormatError(
                    f"expected the final state of episode {row['episode']}, found that of {number}"
                )
            for leaf in self._layout.state:
                if leaf.kind != "variable":
                    dtype = self._layout.dtypes[leaf.name]
                    value = values.get(leaf.name, np.empty(leaf.shape, dtype))
                    values[leaf.name] = np.array(value, dtype).reshape(leaf.shape)[
                        () if leaf.is_scalar else ...
                    ]
            found.append(values)
        return found
