"""Whole columns from chunks: one preallocated array a leaf, filled chunk by chunk, in threads if asked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.messages.batches import LOG_TIME, BatchDecoder, Decode
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.runs import Pieces, Runs, final_runs, items, items_dtype, put
from tupli_mcap.recording.columns.threads import do_all
from tupli_mcap.recording.limits import check_bools
from tupli_mcap.spaces.leaves import Leaf

__all__ = ["FIELDS", "ColumnReader", "Columns"]

FIELDS = ("states", "actions", "rewards", "terminals", "timeouts", "next_states", "times")
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
        self._decoder = None if layout.constant else BatchDecoder(layout)

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
            out[LOG_TIME] = np.empty(total, np.uint64)
        tasks: list[Callable[[], None]] = []
        plain = [leaf.name for leaf in leaves if not leaf.apart and leaf.size] + flags
        if "times" in fields:
            plain.append(LOG_TIME)
        if plain and self._decoder is not None:
            tasks += self._decoding(runs, self._decoder.steps, {name: out[name] for name in plain}, keep)
        elif plain:
            tasks += self._tasks(runs, plain, out, layout.step_message.dtype, keep)
        for leaf in leaves:
            if leaf.apart and leaf.name not in skipped:
                moved = runs._replace(channels=self._image_channels(leaf.name, runs.channels))
                dtype = layout.image_messages[leaf.name].dtype
                tasks += self._tasks(moved, ["data"], {"data": out[leaf.name]}, dtype, keep, leaf)
        do_all(tasks, threads)
        for name in plain:
            check_bools(out[name], name, self._store.name)
        nest = {"states": layout.nest_state, "actions": layout.nest_action, "rewards": layout.nest_reward}
        columns = {
            field: nest[field]([out[leaf.name] for leaf in group])
            for field, group in wanted.items()
            if field in fields
        }
        columns.update({f"{name}s": out[name] for name in flags})
        if "times" in fields:
            columns["times"] = out[LOG_TIME].view(np.int64)
            if (columns["times"] < 0).any():
                raise FormatError(f"expected times of steps below 2**63 ns, found {out[LOG_TIME].max()}")
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

    def _decoding(
        self, runs: Runs, decode: Decode, out: Mapping[str, Any], keep: bool
    ) -> list[Callable[[], None]]:
        """Tasks that fill columns with messages of variable size."""

        def fill(pieces: Pieces) -> None:
            data, records = self._store.records(pieces.chunk, keep=keep)
            rows, places = pieces.indexes()
            for name, values in decode(data, records[rows], out).items():
                put(out[name], places, values)

        return [partial(fill, pieces) for pieces in Pieces.of(runs, self._store)]

    def final_columns(self, channel: int, episodes: Array) -> list[Any]:
        """A column of final states for each leaf of the state, of index rows that all have one."""
        out = {leaf.name: self._empty(leaf, len(episodes)) for leaf in self._layout.state}
        numbers = np.empty(len(episodes), np.uint32)
        stored = {leaf.name: out[leaf.name] for leaf in self._layout.state if leaf.size} | {
            "episode": numbers
        }
        runs = final_runs(episodes, channel)
        if self._decoder is not None:
            tasks = self._decoding(runs, self._decoder.finals, stored, True)
        else:
            tasks = self._tasks(runs, list(stored), stored, self._layout.final_message.dtype, True)
        do_all(tasks, 1)
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
                data, records = self._store.records(span.chunk)
                names = [leaf.name for leaf in self._layout.state] + ["episode"]
                columns = self._decoder.finals(data, records[span.begin : span.end], names)
                values = {name: column[0] for name, column in columns.items()}
                number = values.pop("episode")
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
