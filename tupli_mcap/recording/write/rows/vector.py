"""Step rows of a vector environment: a batch is written by whole-array assignment, one block of rows a sub-environment.

A sub-environment that took no step in a batch (the ignored step of next-step autoreset) leaves a hole, recognised by
its sequence; holes are squeezed out when the rows go to the file. The chunks of a full half are compressed while the
other half fills, and written before it is needed again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import StepError
from tupli_mcap.journal.derive import EpisodeDeriver, StartedEpisode
from tupli_mcap.journal.file import Journal, RowArea
from tupli_mcap.journal.logs import STATE, ToFile, seal
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, HOLE
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.episodes import EpisodeLog
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.spaces.exact import check_structure, exact_array, leaf_value
from tupli_mcap.spaces.leaves import Leaf

_ACTION, _REWARD, _STATE = range(3)
_BOOL = np.dtype(np.bool_)  # those may hold other bytes than 0 and 1
# of leaves: their place in the rows, values, 1 if it is in the next rows
_Values = list[tuple[Array, Any, int]]
_Images = Sequence[tuple[Sequence[ImageRows], list[Array]]]  # of leaves: the stores, and what each is given
# values, images, terminals, timeouts, and who took a step
Batch = tuple[_Values, _Images, Array, Array, Array | None]


class _Field(NamedTuple):
    """A leaf in the rows of all sub-environments; None if it takes no bytes. `ahead`: it is of the next row."""

    leaf: Leaf
    view: Array | None
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    ahead: int


class VectorRows:
    """The step rows of `channels` sub-environments. Arrays given to `put` have the sub-environments first."""

    def __init__(
        self,
        layout: StepLayout,
        journal: Journal,
        channels: Sequence[int],
        images: Sequence[Sequence[ImageRows]],
        file: ToFile,
    ) -> None:
        self._file, self._sealed = file, file.sealed
        self._layout = layout
        self._area = area = journal.area("steps", RowArea)
        self._buffer = journal.buffer("steps")
        self._images = list(zip(images, layout.images, strict=True))
        self._channels = list(channels)
        n = len(channels)
        self.counts = np.array([file.counts[channel] for channel in channels], np.uint32)  # rows so far
        self._ones = np.ones_like(self.counts)
        self._half = self._row = self._flushed = 0
        self._now = file.end_time
        self._times = np.zeros((2, area.rows), np.uint64)  # of the rows in the journal, the same for a batch
        self._offsets = np.arange(area.rows, dtype=np.uint64) * np.uint64(area.row_size)
        self._write_chunks: Callable[[], None] | None = None  # of the half that is not running
        self._make_views()
        self._fill_heads()
        self.events: EpisodeLog | None = None  # where derived episodes go; None: none are derived
        self._derived = 0  # rows of the running half that episodes were derived from
        self._episodes = EpisodeDeriver(n, layout.state_end)
        self._state = [self._writer(leaf, 1) for leaf in layout.state if not leaf.apart]
        others = [*((leaf, _ACTION) for leaf in layout.action), *((leaf, _REWARD) for leaf in layout.reward)]
        self._fields = [
            *((root, self._writer(leaf, 0)) for leaf, root in others),
            *((_STATE, field) for field in self._state),
        ]
        self._nested = any(leaf.keys for leaf in layout.leaves)
        self._flagged = bytearray(2 * area.rows)  # where a flag may be set: a new journal is zeros
        self._state_end = layout.state_end
        self.holds_episodes = layout.tells_episodes and not file.sealed

    def _make_views(self) -> None:
        """The places of the rows' fields in the journal."""
        area, n = self._area, len(self._channels)
        table = np.frombuffer(self._buffer, self._layout.step_message.dtype)
        self._rows: Array = table.reshape(2, n, area.rows + 1)
        self._flags = (self._rows["terminal"], self._rows["timeout"])
        pairs = np.dtype(
            {
                "names": ["times", "numbers"],
                "formats": [("<u8", 2), "<u8"],  # log_time and publish_time, episode and step
                "offsets": [15, BODY],
                "itemsize": area.row_size,
            }
        )
        self._pair, self._numbers = self._rows.view(pairs)["times"], self._rows.view(pairs)["numbers"]
        self._sequence = self._rows["#sequence"]
        self._state_bytes: Array = np.frombuffer(self._buffer, np.uint8).reshape(*self._rows.shape, -1)

    def _fill_heads(self) -> None:
        """Fills in the constant parts of all rows of a channel, and marks them as holes."""
        message = self._layout.step_message
        headers = b"".join(message.header(channel, HOLE) for channel in self._channels)
        heads = np.dtype(
            {"names": ["head"], "formats": [f"V{BODY}"], "offsets": [0], "itemsize": self._area.row_size}
        )
        self._rows.view(heads)["head"] = np.frombuffer(headers, f"V{BODY}")[None, :, None]

    def _writer(self, leaf: Leaf, ahead: int) -> _Field:
        view = None if leaf.size == 0 else self._rows[leaf.name]
        return _Field(leaf, view, self._layout.dtypes[leaf.name], (len(self._channels), *leaf.shape), ahead)

    def row_counts(self) -> list[int]:
        """As `BatchStore.row_counts`."""
        counts: list[int] = self.counts.tolist()
        return counts

    def check(
        self, actions: Any, states: Any, rewards: Any, terminals: Array, timeouts: Array, active: Array | None
    ) -> Batch:
        """As `BatchStore.check`."""
        images = self._check_images(states) if self._images else ()
        if self._nested:
            check_structure(self._layout.action_space, actions, "action")
            check_structure(self._layout.observation_space, states, "state")
        values, roots = [], (actions, rewards, states)
        for root, (leaf, view, dtype, shape, ahead) in self._fields:
            value = leaf_value(roots[root], leaf) if leaf.keys else roots[root]
            if (
                not (value.__class__ is np.ndarray and value.dtype is dtype and value.shape == shape)
                or dtype is _BOOL
            ):
                value = exact_array(value, dtype, shape, leaf.path)
            if view is not None:
                values.append((view, value, ahead))
        return values, images, terminals, timeouts, active

    def _check_images(self, states: Any) -> _Images:
        found, n = [], len(self._channels)
        for stores, leaf in self._images:
            batch = leaf_value(states, leaf)
            if np.shape(batch)[:1] != (n,):
                raise StepError(f"{leaf.path}: expected {n} images, found shape {np.shape(batch)}")
            found.append((stores, [stores[i].check(batch[i]) for i in range(n)]))
        return found

    def put_state(self, states: Any, mask: Array | None = None) -> None:
        """As `BatchStore.put_state`."""
        for leaf, view, dtype, shape, _ in self._state:
            value = exact_array(leaf_value(states, leaf), dtype, shape, leaf.path)
            if view is None:
                continue
            if mask is None:
                view[self._half, :, self._row] = value
            else:
                view[self._half, mask, self._row] = value[mask]
        for stores, leaf in self._images:
            images = leaf_value(states, leaf)
            for i in range(len(stores)) if mask is None else np.flatnonzero(mask).tolist():
                stores[i].put_first(stores[i].check(images[i]))

    def put(self, batch: Batch, numbers: Array, *, ends: bool) -> None:
        """As `BatchStore.put`."""
        values, images, terminals, timeouts, active = batch
        for stores, pictures in images:  # a committed step has the image of the state after it
            for i, picture in enumerate(pictures):
                if active is None or active[i]:
                    stores[i].put(picture)
                else:
                    stores[i].put_first(picture)
        half, row = self._half, self._row
        for view, value, ahead in values:
            view[half, :, row + ahead] = value
        place = half * self._area.rows + row
        if ends or self._flagged[place]:
            self._flags[0][half, :, row] = terminals
            self._flags[1][half, :, row] = timeouts
            self._flagged[place] = ends
        self._numbers[half, :, row] = numbers
        self._now = now = max(time.time_ns(), self._now)
        self._times[half, row] = now
        self._pair[half, :, row] = now
        if active is None:
            self._sequence[half, :, row] = self.counts
            self.counts += self._ones
        else:
            self._sequence[half, :, row] = np.where(active, self.counts, HOLE)
            self.counts += active
        if self._sealed:
            self._seal(active)
        self._row = row + 1
        if self._row == self._area.rows:
            self._switch()

    # ---- episodes derived from rows

    def begin_episode(self, episode: StartedEpisode) -> None:
        """The next row of a sub-environment is the first one of an episode whose start is written."""
        self._episodes.begin(episode.env, episode.number, episode.first_row)

    def derive_pending(self, over: Array) -> tuple[list[int], list[float]]:
        """Derives all episodes up to here.

        Args:
            over: where the last row has ended its episode, and the running one has its final state: bool (num_envs,).

        Returns:
            The numbers of the running episodes (-1: none), and their returns so far.
        """
        self._derive(self._half, self._row, {i: self.pending_state(i) for i in np.flatnonzero(over).tolist()})
        return self._episodes.running.tolist(), self._episodes.totals.tolist()

    def _derive(self, half: int, end: int, pending: Mapping[int, bytes] | None = None) -> None:
        """Derives episodes from the rows of a half before `end`, as far as that is not done yet."""
        if self.events is not None:
            begin, self._derived = self._derived, end
            self.events.extend(self._episodes.derive(self._rows[half, :, begin:end], pending))

    def pending_state(self, i: int) -> bytes:
        """As `BatchStore.pending_state`."""
        area = self._area
        start = self._half * area.half + i * area.block + self._row * area.row_size
        state = bytes(self._buffer[start + BODY + 8 : start + self._state_end])
        return state + b"".join(stores[i].pending() for stores, _ in self._images)

    def _seal(self, active: Array | None) -> None:
        size = self._area.row_size
        for i in range(len(self._channels)) if active is None else np.flatnonzero(active).tolist():
            start = self._half * self._area.half + i * self._area.block + self._row * size
            end = start + size
            seal(self._buffer, start, end, self._buffer[end + STATE : end + self._state_end])

    def _switch(self) -> None:
        self._finish_chunks()  # a half is used again only when its chunks are in the file
        half, rows, flushed = self._half, self._area.rows, self._flushed
        self._derive(half, rows)  # before the other half's last rows go, whose holes may be here
        self._half = 1 - half
        # a power loss may leave a part of what is written over these rows, and not the chunks they are in
        self._sequence[self._half] = HOLE
        end = self._state_end
        self._state_bytes[self._half, :, 0, BODY:end] = self._state_bytes[half, :, rows, BODY:end]
        self._row = self._flushed = self._derived = 0
        self._write_chunks = self._file.start_chunks(self._chunks(half, flushed, rows))
        if self._file.durable:
            self._finish_chunks()

    def flush(self) -> None:
        """Writes the rows that are not in the file yet."""
        self._finish_chunks()
        flushed, self._flushed = self._flushed, self._row
        self._derive(self._half, self._row)
        self._write_chunks = self._file.start_chunks(self._chunks(self._half, flushed, self._row))
        self._finish_chunks()

    def _finish_chunks(self) -> None:
        write, self._write_chunks = self._write_chunks, None
        if write is not None:
            write()

    def _chunks(self, half: int, begin: int, end: int) -> list[Rows]:
        """The rows of a half as chunks, without holes; whole ones are not copied."""
        kept = self._sequence[half, :, begin:end] != HOLE
        whole = kept.all(axis=1).tolist()
        chunks = []
        for i, channel in enumerate(self._channels):
            rows, times = self._rows[half, i, begin:end], self._times[half, begin:end]
            if not whole[i]:
                rows = rows.view(f"V{rows.dtype.itemsize}")[kept[i]].view(rows.dtype)  # padding stays zero
                times = times[kept[i]]
            elif self._sealed:  # until the chunk is on the disk, the rows in the journal stay as sealed
                rows = np.frombuffer(bytearray(rows.view(np.uint8)), rows.dtype)
            if not len(rows):
                continue
            if self._sealed:
                rows["#publish_time"] = times
            first = int(rows["#sequence"][0])
            chunks.append(Rows(channel, first, rows.view(np.uint8), self._offsets[: len(rows)], times))
        return chunks
