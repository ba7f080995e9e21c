"""The steps of one environment in the journal, and on their way into chunks."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.journal.committed import RowDeriver, even_rows
from tupli_mcap.journal.derive import EpisodeDeriver
from tupli_mcap.journal.file import Journal, RowArea
from tupli_mcap.journal.logs import STATE, ToFile, seal
from tupli_mcap.mcap.records import BODY, HOLE
from tupli_mcap.messages.encode_rows import make_row_encoder
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.episodes import EpisodeLog
from tupli_mcap.recording.write.rows.images import ImageRows
from tupli_mcap.recording.write.rows.variable import put_each
from tupli_mcap.spaces.exact import check_structure, exact_array, leaf_value

# Chunks that a half of a single environment becomes. What is done once a half takes as long for few rows as for many.
CHUNKS_PER_HALF = 2


class SingleRows:
    """The step rows of one environment.

    `put`, `put_state` and `put_whole` are the generated encoders; `block` says which of the area's blocks is this
    environment's.
    """

    def __init__(
        self,
        layout: StepLayout,
        journal: Journal,
        channel: int,
        images: Sequence[ImageRows],
        file: ToFile,
        block: int = 0,
    ) -> None:
        self._file, self._sealed = file, file.sealed
        self._layout, self._images = layout, images
        self._dtype = layout.step_message.dtype
        self._area = area = journal.area("steps", RowArea)
        self._buffer = buffer = journal.buffer("steps")
        rows: Array = np.frombuffer(buffer, self._dtype).reshape(2, area.channels, area.rows + 1)
        self._rows = rows[:, block]
        self._sequence: Array = self._rows["#sequence"]
        first_half = block * area.block
        self._starts = (first_half, first_half + area.half)  # of the halves of this block
        self._channel = channel
        self._half = 0
        self._chunk = -(-area.rows // CHUNKS_PER_HALF)  # rows
        self._flushed = 0  # rows of the running half that are in the file
        self._deriver = RowDeriver(time_ns=file.end_time)
        self._header = layout.step_message.header(channel)
        self._hole = layout.step_message.header(channel, HOLE)
        self._heads = np.dtype(
            {"names": ["head"], "formats": [f"V{BODY}"], "offsets": [0], "itemsize": area.row_size}
        )
        encoder = self._encoder = make_row_encoder(
            layout, buffer, channel, file.counts[channel], images, self._switch,
            self._seal if file.sealed else None,
        )  # fmt: skip
        self.put = encoder.put
        self.put_state = encoder.put_state
        self.put_next = encoder.put_next
        self.put_whole = encoder.put_whole
        self._offset = encoder.offset
        self.events: EpisodeLog | None = None  # where derived episodes go; None: none are derived
        self._derived = 0  # offset of the rows that no episodes were derived from yet
        self._episodes = EpisodeDeriver(1, encoder.state_end)
        self.holds_episodes = layout.tells_episodes and not file.sealed
        self._state_end = encoder.state_end
        self._go_to(0)
        self.begin_episode(0)

    @property
    def count(self) -> int:
        """Rows of the channel so far, those of earlier sessions included."""
        return self._encoder.count()

    @property
    def total(self) -> Any:
        """The running episode's return so far."""
        return self._encoder.total()

    def begin_episode(self, episode: int) -> None:
        """The rows that follow belong to `episode`, whose start is written."""
        start, prefix = self._offset(), self._header + NUMBERS.pack(episode, 0)
        self._encoder.begin(prefix)
        self._buffer[start : start + len(prefix)] = prefix
        self._derived = start
        self._episodes.begin(0, episode, self.count)

    # ---- many steps at once

    def put_many(
        self, states: Any, actions: Any, rewards: Any, terminals: Array, timeouts: Array, episodes: Any
    ) -> None:
        """As `StepStore.put_many`."""
        n, layout = len(terminals), self._layout
        if self._sealed or layout.images:
            put_each(self, layout, (states, actions, rewards), terminals, timeouts)
            return
        check_structure(layout.observation_space, states, "state")
        check_structure(layout.action_space, actions, "action")
        columns = [("terminal", terminals), ("timeout", timeouts), ("episode", np.broadcast_to(episodes, n))]
        for root, leaves in ((states, layout.state), (actions, layout.action), (rewards, layout.reward)):
            for leaf in leaves:
                value = exact_array(
                    leaf_value(root, leaf), layout.dtypes[leaf.name], (n, *leaf.shape), leaf.path
                )
                if leaf.size:
                    columns.append((leaf.name, value))
        amounts = np.asarray(rewards, np.float64).reshape(n, -1).sum(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):  # of infinite rewards
            totals = np.cumsum(np.append(float(self.total), amounts))[1:]  # one by one, as steps add them
        begin = 0
        while begin < n:
            begin = self._put_rows(columns, begin, n, totals)

    def _put_rows(self, columns: Sequence[tuple[str, Array]], begin: int, end: int, totals: Array) -> int:
        """Writes as many of the steps as the half has room for; returns how far it came."""
        area, size = self._area, self._area.row_size
        first = (self._offset() - self._starts[self._half]) // size
        count = min(end - begin, area.rows - first)
        rows = self._rows[self._half, first : first + count]
        for name, values in columns:
            rows[name] = values[begin : begin + count]
        # behind the values: the first row with a header is the running one, whose state is taken
        rows.view(self._heads)["head"] = np.frombuffer(self._hole, f"V{BODY}")
        rows["#log_time"] = time.time_ns()
        after = self._offset() + count * size
        self._buffer[after : after + BODY] = bytes(BODY)  # nobody knows the state there
        sequence = self._encoder.count()
        rows["#sequence"] = np.arange(sequence, sequence + count)
        self._encoder.skip(count, float(totals[begin + count - 1]))
        return begin + count

    # ---- episodes derived from rows

    def skip_pending(self) -> None:
        """Says that the records of all episodes up to here are written."""
        self._derived = self._offset()
        self._episodes.begin(0, -1, 0)

    def derive_pending(self, *, over: bool = False) -> None:
        """Derives episodes from all rows so far. `over`: the running row has the final state of the last episode."""
        pending = {0: self.pending_state()} if over else None
        begin, self._derived = self._derived, self._offset()
        if self.events is not None:
            rows = np.frombuffer(self._buffer[begin : self._derived], self._dtype)
            self.events.extend(self._episodes.derive(rows[None], pending))

    def pending_state(self) -> bytes:
        """As `StepStore.pending_state`."""
        start = self._offset()
        state = bytes(self._buffer[start + BODY + 8 : start + self._state_end])
        return state + b"".join(images.pending() for images in self._images)

    def _seal(self, offset: int, *, alone: bool = False) -> None:
        end = offset + self._area.row_size
        running = b"" if alone else self._buffer[end + STATE : end + self._state_end]
        seal(self._buffer, offset, end, running)

    def _switch(self) -> None:
        """The half is full: go on in the other one, then write this one as a chunk."""
        area, half = self._area, self._half
        # before the other half's last row goes, whose hole may be here
        self.derive_pending()
        spare = self._starts[half] + area.rows * area.row_size
        self._half = 1 - half
        # a power loss may leave a part of what is written over these rows, and not the chunk they are in
        self._sequence[self._half] = HOLE
        start = self._starts[self._half]
        self._buffer[start : start + self._state_end] = self._buffer[spare : spare + self._state_end]
        flushed, self._flushed = self._flushed, 0
        self._go_to(self._half)
        self._derived = self._starts[self._half]
        self._emit(self._starts[half], flushed, area.rows)

    def _go_to(self, half: int) -> None:
        """The next row is the first one of a half, behind the last one of the other."""
        area = self._area
        start, other, spare = self._starts[half], self._starts[1 - half], area.rows * area.row_size
        self._encoder.move(start, other + spare - area.row_size, start + spare)

    def flush(self) -> None:
        """Writes the rows of the running half that are not in the file yet."""
        start = self._starts[self._half]
        rows = (self._offset() - start) // self._area.row_size
        flushed, self._flushed = self._flushed, rows
        self.derive_pending()
        self._emit(start, flushed, rows)

    def _emit(self, start: int, begin: int, end: int) -> None:
        """Writes rows of a half, without holes."""
        size = self._area.row_size
        data: Any = self._buffer[start + begin * size : start + end * size]
        kept = np.frombuffer(data, self._dtype)["#sequence"] != HOLE
        if not kept.all():
            data = memoryview(np.frombuffer(data, f"V{size}")[kept].view(np.uint8))  # padding stays zero
        elif self._sealed:
            data = bytearray(data)  # until the chunk is on the disk, the rows in the journal stay as sealed
        rows = np.frombuffer(data, self._dtype)
        self._deriver.fill(rows)
        for first in range(0, len(rows), self._chunk):
            chunk = rows[first : first + self._chunk]
            part = data[first * size : first * size + chunk.nbytes]
            self._file.add_chunk(even_rows(self._channel, part, chunk))
