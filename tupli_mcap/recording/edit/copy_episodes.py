"""Copies episodes of recordings into another one: renumbers rows, and copies chunks whose rows stay the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.episodes import INTERRUPTED, EpisodeEnd, EpisodeStart
from tupli_mcap.messages.frames import EncodedFrame, encode_frame, encode_pair
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.layout import NUMBERS, renumbered
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.about.success import without_success
from tupli_mcap.recording.edit.assemble import Assembler, CopiedEpisode, writable
from tupli_mcap.recording.recording import Recording


class NewFrames(Protocol):
    """New frames of a camera for some episodes, in place of the recorded ones."""

    camera: str

    def of(self, episode: int) -> Iterable[tuple[int, EncodedFrame]] | None:
        """(step, frame) of an episode, in order; None if the episode keeps its recorded frames."""
        ...


class NewValues(NamedTuple):
    """New values in place of the recorded ones.

    Attributes:
        columns: by channel and field of its messages, a value for each row of the channel: a list, or an object that
            returns arrays.
        returns: by number of the episode.
        finals: final states by number of the episode: what follows `episode` and `env` in `/final_state`.
    """

    columns: Mapping[int, Mapping[str, Any]]
    returns: Mapping[int, float]
    finals: Mapping[int, bytes]


class Trim(NamedTuple):
    """The part of an episode that stays: its steps `start:stop`, and their return.

    `final` is the state after them (what follows `episode` and `env` in `/final_state`); None if the end stays.
    """

    start: int
    stop: int
    episode_return: float
    final: bytes | None


class EpisodeCopier:
    """Appends episodes of `source` to `target`.

    Args:
        channels: the target's ids of the source's channels, if they differ.
        shift: added to the numbers of the episodes.
        first_env: the target's sub-environment that the source's first one becomes; None to keep all numbers.
        cameras: by camera, then by sub-environment, the ids of its channels.
        frames: new frames of a camera, in place of the source's.
        values: new values of steps, in place of the source's.
        trims: by number, the steps that stay of an episode.
        layout: of the target, if it differs: the source's `without` some fields.
        infos: the codecs of the source's infos and of the target's, if they differ.
    """

    def __init__(
        self,
        source: Recording,
        target: Assembler,
        cameras: Mapping[str, Sequence[tuple[int, int]]],
        *,
        channels: Mapping[int, int] | None = None,
        shift: int = 0,
        first_env: int | None = None,
        frames: NewFrames | None = None,
        values: NewValues | None = None,
        trims: Mapping[int, Trim] | None = None,
        layout: StepLayout | None = None,
        infos: tuple[InfoCodec, InfoCodec] | None = None,
    ) -> None:
        self._info_codecs = infos
        self._layout = source.layout if layout is None else layout
        self._is_whole = layout is None
        self._first_env = first_env
        self._trims = trims or {}
        self._values = values or NewValues({}, {}, {})
        self._source, self._target, self._shift = source, target, shift
        self._channels = channels or {}
        self._cameras, self._new_frames = cameras, frames
        self._file = source.file
        self._store, self._topics = source.file.store, source.file.topics
        # by channel, the time of the last new frame: times must not decrease, even if the clock went back
        self._held: dict[int, int] = {}

    def copy(self, rows: Array) -> list[CopiedEpisode]:
        """Copies the steps of the episodes in `rows` of the source's index, with their images, frames and infos;
        returns their other records.

        If sub-environments get other numbers, it does not copy infos: the caller adds those of `infos`.
        """
        layout = self._source.layout
        infos = INFO in self._topics and self._to(self._topics[INFO]) in self._target.container.channels
        rows = self._trimmed(rows)
        firsts = np.zeros(len(rows), dtype=np.int64)
        for env, channel in enumerate(self._file.steps):
            chosen = np.flatnonzero(rows["env"] == env)
            chosen = chosen[np.argsort(rows["first_row"][chosen], kind="stable")]
            lengths = rows["length"][chosen].astype(np.int64)
            firsts[chosen] = self._target.next_row(self._to(channel)) + np.cumsum(lengths) - lengths
            spans = _merged([(int(rows["first_row"][i]), int(rows["length"][i])) for i in chosen])
            self._copy(channel, spans, layout.step_message.dtype if layout.constant else None)
            topics = Topics.of_step(self._file.contents.channels[channel].topic)
            for leaf in self._layout.images:
                images = self._topics[topics.image(leaf.name)]
                self._copy(images, spans, layout.image_messages[leaf.name].dtype)
        self._frames(rows)
        if infos and self._first_env is None:
            if self._info_codecs is None:
                self._copy_places(self._topics[INFO], self._infos(rows), numbered=True)
            else:
                self._target.add_messages(self._to(self._topics[INFO]), self.infos(rows))
        return self._episodes(rows, firsts)

    def _trimmed(self, rows: Array) -> Array:
        """The index rows of the steps that stay; `first_row` is the row in the source."""
        rows = rows.copy()
        for row in rows:
            trim = self._trims.get(int(row["episode"]))
            if trim is None:
                continue
            channel = self._file.steps[int(row["env"])]
            if trim.start:
                row["start_time"] = self._time_of(channel, int(row["first_row"]) + trim.start - 1)
                row["seed"] = row["has_seed"] = 0
            if trim.final is not None:
                row["end_time"] = self._time_of(channel, int(row["first_row"]) + trim.stop - 1)
                row["end"], row["final_row"] = INTERRUPTED, max(0, row["final_row"])
            row["first_row"] += trim.start
            row["length"], row["return"] = trim.stop - trim.start, trim.episode_return
        return rows

    def _time_of(self, channel: int, place: int) -> int:
        ((time_ns, _),) = self._messages(channel, place, 1)
        return time_ns

    def _to(self, channel: int) -> int:
        """The id of a channel in the target."""
        return self._channels.get(channel, channel)

    def _copy_first(self, channel: int, count: int, dtype: np.dtype[Any] | None) -> int:
        moved = self._shift or self._first_env is not None or self._to(channel) != channel
        moved = moved or (channel in self._file.steps and not self._is_whole)
        if moved or channel in self._values.columns:
            return 0
        return self._target.copy_first(self._file, channel, count, dtype)

    def _copy(self, channel: int, spans: list[tuple[int, int]], dtype: np.dtype[Any] | None) -> None:
        """Copies rows `spans` of a channel of steps or images, renumbered, in chunks of the usual size."""
        self._store.fetch(
            span.chunk for first, count in spans for span in self._store.spans(channel, first, count)
        )
        done = self._copy_first(channel, spans[0][1], dtype) if spans and spans[0][0] == 0 else 0
        if done:
            spans = [(done, spans[0][1] - done), *spans[1:]]
        if dtype is None:
            messages = (m for first, count in spans for m in self._step_messages(channel, first, count))
            self._write(channel, messages, numbered=True)
            return
        rows = self._rows(channel, spans, dtype)
        if channel in self._file.steps and not self._is_whole:
            rows = (_narrowed(part, self._layout.step_message.dtype) for part in rows)
        self._target.add_rows(self._to(channel), rows)

    def _rows(self, channel: int, spans: Iterable[tuple[int, int]], dtype: np.dtype[Any]) -> Iterator[Array]:
        """Rows of constant size, with the new numbers of their episodes."""
        new = self._values.columns.get(channel, {})
        chunk, rows = -1, np.empty(0, dtype)
        for first, count in spans:
            for span in self._store.spans(channel, first, count):
                if span.chunk != chunk:  # short episodes share one
                    chunk, rows = span.chunk, self._store.rows(span.chunk, dtype, keep=False)
                part = rows[span.begin : span.end]
                is_numbered = (self._shift or self._trims) and "episode" in (dtype.names or ())
                if is_numbered or new:
                    part = writable(part)
                if is_numbered:
                    self._renumber_rows(part)
                for name, column in new.items():
                    part[name] = column[first : first + len(part)]
                first += len(part)
                yield part

    def _renumber_rows(self, part: Array) -> None:
        for number in np.unique(part["episode"]).tolist() if self._trims else ():
            if number in self._trims:
                part["step"][part["episode"] == number] -= np.uint32(self._trims[number].start)
        part["episode"] += np.uint32(self._shift)

    def _messages(self, channel: int, first: int, count: int) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of messages of a channel."""
        return ((time_ns, bytes(body)) for time_ns, body in self._store.messages(channel, first, count))

    def _step_messages(self, channel: int, first: int, count: int) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of steps of variable size, with new values, or without some fields."""
        messages, new = self._messages(channel, first, count), self._values.columns.get(channel, {})
        if not new and self._is_whole:
            yield from messages
            return
        decoder = MessageDecoder(self._source.layout)
        encoders = [(leaf.name, self._layout.codec(leaf).encode) for leaf in self._layout.step_leaves]
        for row, (time_ns, body) in enumerate(messages, first):
            values = decoder.step(memoryview(body)) | {name: column[row] for name, column in new.items()}
            out = bytearray(body[:8])
            for name, encode in encoders:
                if name in values:  # leaves without elements have no field
                    encode(values[name], out, 0)
            yield time_ns, bytes(out) + body[-2:]

    def _copy_places(self, channel: int, places: Array, *, numbered: bool) -> None:
        """Copies the rows `places` (ascending) of a channel as single messages."""
        moved = np.flatnonzero(places != np.arange(len(places)))
        same = int(moved[0]) if len(moved) else len(places)
        done = 0 if numbered and self._trims else self._copy_first(channel, same, None)
        spans = _merged([(place, 1) for place in places[done:].tolist()])
        messages = (m for first, count in spans for m in self._messages(channel, first, count))
        self._write(channel, messages, numbered=numbered)

    def _write(self, channel: int, messages: Iterable[tuple[int, bytes]], *, numbered: bool = False) -> None:
        """Adds messages (log_time, body) of a channel; `numbered` ones begin with `episode` and `step`."""
        if numbered and (self._shift or self._trims):
            messages = ((time_ns, self._renumbered(body)) for time_ns, body in messages)
        self._target.add_messages(self._to(channel), messages)

    def _renumbered(self, body: bytes) -> bytes:
        number, step = NUMBERS.unpack_from(body)
        trim = self._trims.get(number)
        return renumbered(body, number + self._shift, step - trim.start if trim else step)

    def _episodes(self, rows: Array, firsts: Array) -> list[CopiedEpisode]:
        """The other records of each episode, with its numbers in the target."""
        found, env = [], self._first_env or 0
        for row, first, starts in zip(rows, firsts.tolist(), self._starts(rows), strict=True):
            number = int(row["episode"])
            trim = self._trims.get(number)
            new = {"episode": number + self._shift, "env": int(row["env"]) + env, "first_row": first}
            ((end_time, body),) = self._messages(self._topics[EPISODE_END], int(row["end_row"]), 1)
            end = EpisodeEnd.decode(memoryview(body))
            total = self._values.returns.get(number, end.episode_return)
            final = self._final(row, NUMBERS.pack(new["episode"], new["env"]))
            if trim is not None:
                total, end_time = trim.episode_return, int(row["end_time"])
                end = end._replace(length=trim.stop - trim.start, end=int(row["end"]))
                if trim.final is not None:
                    end = end._replace(has_final_state=True, metadata=without_success(end.metadata))
            found.append(
                CopiedEpisode(
                    [(time_ns, start._replace(**new)) for time_ns, start in starts],
                    (end_time, end._replace(**new, episode_return=total)),
                    int(row["end_row"]),
                    final,
                )
            )
        return found

    def _final(self, row: Any, numbers: bytes) -> tuple[int, Callable[[], bytes]] | None:
        """log_time of a final state, and a function that returns its body with new numbers; None if it is not known."""
        trim = self._trims.get(int(row["episode"]))
        if trim is not None and trim.final is not None:
            return int(row["end_time"]), partial(bytes, numbers + trim.final)
        channel, place = self._topics[FINAL_STATE], int(row["final_row"])
        if place < 0:
            return None
        new, time_ns = self._values.finals.get(int(row["episode"])), self._time_of(channel, place)
        if new is not None:
            return time_ns, partial(bytes, numbers + new)
        if not self._layout.state:
            return time_ns, lambda: numbers
        return time_ns, lambda: numbers + next(body for _, body in self._messages(channel, place, 1))[8:]

    def _starts(self, rows: Array) -> list[list[tuple[int, EpisodeStart]]]:
        """(log_time, start) of the resets without a step before each episode, and of its own.

        Nobody can repeat what led to a state within an episode, nor the resets that follow one that ends early: a start
        that is `continued` says so.
        """
        positions = {int(number): i for i, number in enumerate(self._source.index["episode"])}
        ends_early = [False] * self._source.num_envs  # the episode before
        found = []
        for row in rows:
            env, number = int(row["env"]), int(row["episode"])
            trim = self._trims.get(number)
            resets = len(self._source.resets_before(positions[number]))
            messages = self._messages(self._topics[EPISODE_START], int(row["start_row"]) - resets, resets + 1)
            starts = [(time_ns, EpisodeStart.decode(memoryview(body))) for time_ns, body in messages]
            lost = ends_early[env]
            if trim is not None and trim.start:
                bare = starts[-1][1]._replace(
                    seed="", seed_given=False, continued=False, options="", reset_info="{}"
                )
                starts, lost = [(int(row["start_time"]), bare)], True
            if lost:
                time_ns, first = starts[0]
                starts = [(time_ns, first._replace(seed="", seed_given=False, continued=True)), *starts]
            ends_early[env] = trim is not None and trim.final is not None
            found.append(starts)
        return found

    def _frames(self, rows: Array) -> None:
        """Copies the frames of episodes: `/camera` and `/frame`."""
        source, new = self._source, self._new_frames
        for camera, channels in self._cameras.items():
            for env, (pictures, pairs) in enumerate(channels):
                episodes = rows[rows["env"] == env]
                episodes = episodes[np.argsort(episodes["first_row"], kind="stable")]
                if new is not None and new.camera == camera:
                    for channel in (pictures, pairs):
                        drawn = (self._frames_of(new, row, channel, channel == pictures) for row in episodes)
                        self._write(channel, (message for messages in drawn for message in messages))
                elif camera in source.cameras:
                    places = [self._frame_rows(camera, row) for row in episodes]
                    joined = np.concatenate(places) if places else np.zeros(0, np.int64)
                    theirs = self._file.cameras.channels(camera, env)
                    self._copy_places(theirs[0], joined, numbered=False)
                    self._copy_places(theirs[1], joined, numbered=True)

    def _frame_rows(self, camera: str, row: Any) -> Array:
        """The rows of a camera that show an episode."""
        number, length = int(row["episode"]), int(row["length"])
        start = self._trims[number].start if number in self._trims else 0
        places, steps, _ = self._file.cameras.rows(camera, int(row["env"]), number, start + length)
        return places[steps >= start]

    def _frames_of(
        self, new: NewFrames, row: Any, channel: int, pictures: bool
    ) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of the messages of an episode's frames, new or recorded ones."""
        number = int(row["episode"])
        drawn = new.of(number)
        if drawn is not None:
            for step, frame in drawn:
                time_ns = self._held[channel] = max(frame.time_ns, self._held.get(channel, 0))
                held = frame._replace(time_ns=time_ns)
                yield time_ns, encode_frame(new.camera, held) if pictures else encode_pair(number, step)
        elif new.camera in self._source.cameras:
            for place in self._frame_rows(new.camera, row).tolist():
                yield from self._messages(channel, place, 1)

    def _infos(self, rows: Array) -> Array:
        """The rows of `/info` that belong to the episodes and to steps that stay."""
        channel = self._topics[INFO]
        messages = self._messages(channel, 0, self._store.count(channel))
        numbers = np.array([NUMBERS.unpack_from(body) for _, body in messages], np.int64).reshape(-1, 2)
        kept = np.isin(numbers[:, 0], rows["episode"])
        if self._trims:
            trimmed = np.array([(n, t.start, t.stop) for n, t in sorted(self._trims.items())], np.int64)
            places = np.searchsorted(trimmed[:, 0], numbers[:, 0]).clip(max=len(trimmed) - 1)
            of, starts, stops = trimmed[places].T
            kept &= (of != numbers[:, 0]) | ((numbers[:, 1] >= starts) & (numbers[:, 1] < stops))
        return np.flatnonzero(kept)

    def infos(self, rows: Array) -> Iterator[tuple[int, bytes]]:
        """(log_time, body) of the infos of episodes, with new numbers."""
        if INFO in self._topics:
            for first, count in _merged([(place, 1) for place in self._infos(rows).tolist()]):
                for time_ns, body in self._messages(self._topics[INFO], first, count):
                    new = self._renumbered(body)
                    if self._info_codecs is not None:
                        own, target = self._info_codecs
                        new = target.encode(*own.decode(memoryview(new)), kinds=(float,))
                    yield time_ns, new


def _narrowed(rows: Array, dtype: np.dtype[Any]) -> Array:
    """Rows of constant size with only the fields of `dtype`."""
    found = np.zeros(len(rows), dtype)
    for name in dtype.names or ():
        found[name] = rows[name]
    found["#length"] = dtype.itemsize - 9
    return found


def _merged(spans: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for first, count in spans:
        if merged and merged[-1][0] + merged[-1][1] == first:
            merged[-1] = (merged[-1][0], merged[-1][1] + count)
        else:
            merged.append((first, count))
    return merged
