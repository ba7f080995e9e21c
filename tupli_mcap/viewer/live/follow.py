"""Reads a recording while it is written: each look finds the rows that have been committed since the last one.

The rule is that of every reader: the rows of a channel are those in chunks, then the journal's rows that follow them,
up to the first that is missing. The journal is read before the file, since the recorder moves rows from the journal to
the file. The recorder does nothing for this and does not wait.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError, RecordingError
from tupli_mcap.journal.file import FRAMES_AREA, JournalContents, read_journal, recorded_journal
from tupli_mcap.mcap.container import IN_CHUNKS
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import (
    ATTACHMENT_HEAD,
    BODY,
    CHUNK_HEAD,
    MESSAGE_INDEX,
    RECORD,
    RECORD_HEADER,
    has_summary,
    read_attachment,
    read_summary,
)
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.mcap.walk import Walk
from tupli_mcap.messages.frames import EncodedFrame, decode_frame
from tupli_mcap.messages.images.codecs import image_codecs
from tupli_mcap.messages.infos import InfoCodec, named_entries
from tupli_mcap.messages.layout import NUMBERS
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import (
    EPISODE_END,
    EPISODE_START,
    FINAL_STATE,
    INFO,
    Topics,
    camera_names,
    parse,
)
from tupli_mcap.recording.contents import check_metadata, step_channels
from tupli_mcap.recording.index import INDEX_NAME
from tupli_mcap.recording.recover.evidence import (
    Evidence,
    FileEnd,
    PackedStore,
    Piece,
    RecordedChannels,
    prefix,
)
from tupli_mcap.recording.recover.from_journal import belongs, define, take_rows
from tupli_mcap.recording.recover.step_runs import StepFacts, step_facts
from tupli_mcap.spaces.labels import LABELS_NAME, Labels
from tupli_mcap.viewer.live.episodes import EpisodeNews
from tupli_mcap.viewer.live.new_rows import NewInfo, NewSteps, messages_of

_ENVS = 8  # sub-environments whose steps are read
_STEPS = 5000  # of a sub-environment at a time, the newest
_DECODED = 200  # the same where each message is decoded on its own
_EPISODES = 1000  # of a sub-environment, whose first row is remembered
_CHUNKS = 8  # of each channel, the newest, that can be read
_HEADER = RECORD_HEADER.size


class _GrowingFile:
    """The newest chunks of a growing file, from their heads and message indexes.

    `position` is the end of the records that are known, `earlier` how many rows each channel has before offset `begin`.
    """

    def __init__(self, source: Source, position: int, begin: int) -> None:
        self._source = source
        self._position = position
        self._pieces: dict[int, list[Piece]] = {}  # by channel
        self.read_on(begin)
        self.earlier = {channel: pieces[-1].stop for channel, pieces in self._pieces.items()}

    def read_on(self, end: int | None = None) -> None:
        """Notes the chunks that were added since the last call."""
        self._source.refresh()
        chunk = 0
        with contextlib.suppress(FormatError):  # the recorder cut the file meanwhile
            for opcode, at, length in Walk(self._source, end=end).places(self._position):
                if opcode == Opcode.DATA_END or self._is_index(opcode, at):
                    break
                if opcode == Opcode.CHUNK:
                    chunk = at
                    continue
                if opcode == Opcode.MESSAGE_INDEX:
                    self._note(chunk, at)
                self._position = at + length

    def _is_index(self, opcode: int, at: int) -> bool:
        """Whether the record is the episode index, which an appending recorder cuts off."""
        name = INDEX_NAME.encode()
        return opcode == Opcode.ATTACHMENT and self._source.read(at + ATTACHMENT_HEAD.size, len(name)) == name

    def _note(self, chunk: int, index: int) -> None:
        head = self._source.read(chunk, CHUNK_HEAD.size + 4)
        _, length, _, _, size, crc, name_size = CHUNK_HEAD.unpack_from(head)
        method = IN_CHUNKS.index(head[CHUNK_HEAD.size : CHUNK_HEAD.size + name_size].decode())
        _, _, channel, entries = MESSAGE_INDEX.unpack(self._source.read(index, MESSAGE_INDEX.size))
        # the first entry says where the first message begins, behind the definitions
        skip = int.from_bytes(self._source.read(index + MESSAGE_INDEX.size + 8, 8), "little")
        pieces = self._pieces.setdefault(channel, [])
        first, rows = pieces[-1].stop if pieces else 0, entries // 16
        entry = chunk, length + RECORD.size, size, first, rows, skip, crc, channel, method, 0
        pieces.append(Piece(first, rows, entry))
        if len(pieces) > _CHUNKS:  # the two oldest become one piece that is not read
            pieces[:2] = [_unread(channel, 0, pieces[1].stop)]

    def evidence(self, seen: Mapping[int, int]) -> Evidence:
        """The file as if it held all rows that were looked at, so that they are not read from the journal again."""
        evidence = Evidence(self._source, FileEnd(), strict=True, good_end=self._source.size)
        evidence.pieces = {channel: list(pieces) for channel, pieces in self._pieces.items()}
        for channel, count in seen.items():
            stop = evidence.stop(channel)
            if count > stop:
                evidence.pieces.setdefault(channel, []).append(_unread(channel, stop, count))
        return evidence

    def at_hand(self, channel: int) -> int:
        """The first row of a channel in the chunks that can be read."""
        return next((piece.first for piece in self._pieces.get(channel, []) if piece.entry[0]), 0)


def _unread(channel: int, first: int, stop: int) -> Piece:
    """A piece for rows that are not read."""
    return Piece(first, stop - first, (0, 0, 0, first, stop - first, 0, 0, channel, 0, 0))


class Follower:
    """Reads what a recorder has committed since the last look. Rows before offset `begin` of the file are left out.
    `is_over`: the recorder has finished, so the next look finds the rest. `steps`: the step channels of the
    sub-environments whose steps are read."""

    def __init__(
        self, source: PathSource, metadata: Mapping[str, str], evidence: Evidence, begin: int
    ) -> None:
        self.is_over = False
        self.channels, self.schemas = evidence.channels, evidence.schemas
        self.topics = {channel.topic: number for number, channel in evidence.channels.items()}
        self.camera = next(iter(camera_names(self.topics)), None)
        channels = step_channels(evidence.channels, source.name)
        self.num_envs = len(channels)
        self.steps = [channel.id for channel in channels][:_ENVS]
        self.layout = layout = StepLayout.from_metadata(channels[0].metadata)
        self.labels = Labels.none()
        if LABELS_NAME in evidence.attachments:
            data = read_attachment(source, evidence.attachments[LABELS_NAME])
            self.labels = Labels.from_json(data, layout.leaves, source.name)
        self._of_env = [Topics.of_step(channel.topic) for channel in channels]
        self._codecs = image_codecs(layout, evidence.channels)
        self._source, self._metadata = source, metadata
        self._known = RecordedChannels.of(evidence, layout)._replace(steps=self.steps)
        self._file = _GrowingFile(source, evidence.good_end, begin)
        self._seen = dict(self._file.earlier)  # how many rows of each channel were looked at
        envs = range(len(self.steps))
        self._areas = {"steps", "events", "info"}
        self._areas |= {f"{top}{i}" for top in ("steps/", FRAMES_AREA) for i in envs}
        self._areas |= {f"{leaf.name}/{i}" for leaf in layout.images for i in envs}
        apart = [
            topic for topic in self.topics if (parsed := parse(topic)) and parsed.kind in ("camera", "frame")
        ]
        self._others = [self.topics[topic] for topic in (INFO, *apart) if topic in self.topics]
        self._logs = [
            *self._others,
            *(self.topics[topic] for topic in (EPISODE_START, EPISODE_END, FINAL_STATE)),
        ]
        # by sub-environment: the first row of each of its last episodes
        self._begins: list[dict[int, int]] = [{} for _ in envs]
        self._infos: list[tuple[int, bytes]] = []  # whose steps have not been looked at
        self._news = EpisodeNews(self.topics, self._new_rows, self._seen)

    @property
    def episodes(self) -> int:
        """Episodes that have ended up to the last look."""
        return self._news.count

    @property
    def successes(self) -> Sequence[bool]:
        """Whether episodes succeeded: those with `success` whose ends were new at the last look."""
        return self._news.successes

    def look(self) -> tuple[list[NewSteps], Array]:
        """The newest of the new steps by sub-environment, and the new ends of episodes (see `EpisodeNews`)."""
        journal = _journal_of(self._source, self._metadata, self._areas)
        self._file.read_on()
        evidence = self._file.evidence({channel: self._seen.get(channel, 0) for channel in self._logs})
        if journal is not None:
            take_rows(evidence, journal, self.layout, self._known)
        self._store = PackedStore(evidence)
        self._store.codecs = self._codecs
        steps = [new for env in range(len(self.steps)) if len(new := self._new_steps(env))]
        counts = [self._store.count(channel) for channel in self.steps]
        return steps, self._news.look(self._store, evidence, steps, counts, is_over=self.is_over)

    def _new_rows(self, channel: int, most: int | None = None) -> range:
        """The rows of a channel that were not looked at, or the newest of them; marks them as looked at."""
        count = self._store.count(channel)
        first = max(
            self._seen.get(channel, 0), self._file.at_hand(channel), 0 if most is None else count - most
        )
        self._seen[channel] = count
        return range(first, count)

    def _new_steps(self, env: int) -> NewSteps:
        layout, store, channel = self.layout, self._store, self.steps[env]
        new = self._new_rows(channel, _STEPS if layout.constant else _DECODED)
        parts = [p[:-1] for p in step_facts(store, layout, channel, new.start, len(new), keep=True)]
        if not parts:
            return NewSteps(env, new.start, None, [], StepFacts._make([*[np.empty(0)] * 6, {}]))
        facts = StepFacts._make([*map(np.concatenate, zip(*parts, strict=True)), {}])
        numbers, at = np.unique(facts.episode, return_index=True)
        begins = zip(
            numbers.tolist(), (new.start + at - facts.step[at].astype(np.int64)).tolist(), strict=True
        )
        self._begins[env] = dict([*self._begins[env].items(), *begins][-_EPISODES:])
        if not layout.constant:
            return NewSteps(env, new.start, None, messages_of(store, channel, new), facts)
        dtype, spans = layout.step_message.dtype, store.spans(channel, new.start, len(new))
        data = [store.rows(span.chunk, dtype)[span.begin : span.end].tobytes() for span in spans]
        return NewSteps(env, new.start, np.frombuffer(b"".join(data), dtype), [], facts)

    def image_channel(self, leaf: int, env: int) -> int:
        """The channel of the images of a leaf and a sub-environment."""
        return self.topics[self._of_env[env].image(self.layout.images[leaf].name)]

    def images(self, leaf: int, env: int, rows: range) -> dict[int, Array]:
        """The image rows that can still be read, as whole records."""
        channel = self.image_channel(leaf, env)
        dtype = self.layout.image_messages[self.layout.images[leaf].name].dtype
        first = max(rows.start, self._file.at_hand(channel))
        count = max(0, min(rows.stop, self._store.count(channel)) - first)
        found: list[Array] = []
        for span in self._store.spans(channel, first, count):
            found += list(self._store.rows(span.chunk, dtype)[span.begin : span.end])
        return dict(enumerate(found, first))

    def events(self, most: int) -> list[tuple[int, int, bytes]]:
        """(channel, log_time, CDR message) of the newest new infos and frames, then starts, ends and final states."""
        found = []
        for channel in self._others:
            rows = self._new_rows(channel, most)
            found += [(channel, *message) for message in messages_of(self._store, channel, rows)]
        return found + self._news.messages(most)

    def frames(self, env: int, most: int) -> list[tuple[int, EncodedFrame]]:
        """The newest of the new frames, each with the row of the step whose state it shows."""
        if self.camera is None:
            return []
        mine = self._of_env[env]
        ids = [self.topics[mine.frame(self.camera)], self.topics[mine.camera(self.camera)]]
        count, begins = min(map(self._store.count, ids)), self._begins[env]
        first = max(self._seen.get(ids[0], 0), count - most, *map(self._file.at_hand, ids))
        newest, found = max(begins, default=-1), []
        pairs, pictures = (messages_of(self._store, channel, range(first, count)) for channel in ids)
        for row, (_, pair), (_, picture) in zip(range(first, count), pairs, pictures, strict=True):
            episode, step = NUMBERS.unpack_from(pair, BODY - _HEADER)
            if episode > newest:  # its steps have not been looked at: it is for the next look
                break
            self._seen |= dict.fromkeys(ids, row + 1)
            if episode in begins:
                found.append((begins[episode] + step, decode_frame(memoryview(picture)[BODY - _HEADER :])[0]))
        return found

    def infos(self, most: int) -> list[NewInfo]:
        """The newest of the new infos of the first sub-environment."""
        channel = self.topics.get(INFO)
        if channel is None:
            return []
        decoder, begins, infos = InfoCodec.from_metadata(self.channels[channel].metadata), self._begins[0], []
        most *= self.num_envs
        new = [*self._infos, *messages_of(self._store, channel, self._new_rows(channel, most))][-most:]
        self._infos = []
        for time_ns, message in new:
            body = memoryview(message)[BODY - _HEADER :]
            episode, step = NUMBERS.unpack_from(body)
            if episode in begins:
                info = named_entries(decoder.decode(body)[2])
                infos.append(NewInfo(begins[episode] + step, time_ns, info))
            else:  # of another sub-environment, or of steps that have not been looked at
                self._infos.append((time_ns, message))
        return infos


def follow(path: Path, uuid: str, begin: int) -> Follower | None:
    """A follower of the recording with this UUID, from offset `begin` of its file on; None while it has no layout, or
    while another file is at its path."""
    try:
        source = PathSource(path)
    except RecordingError:  # no step was recorded
        return None
    evidence = prefix(source, only_metadata=True)
    stated = evidence.metadata or {}
    if stated.get("uuid") == uuid:
        metadata = check_metadata(source, stated)
        journal = _journal_of(source, metadata, ())
        # while somebody records, the journal defines the channels, later the summary does
        if journal is not None:
            define(evidence, journal)
        elif has_summary(source) and not is_locked(path):
            summary = read_summary(source)
            evidence.schemas, evidence.channels = summary.schemas, summary.channels
        if any(channel.topic.endswith("/step") for channel in evidence.channels.values()):
            return Follower(source, metadata, evidence, begin)
    source.close()
    return None


def _journal_of(
    source: PathSource, metadata: Mapping[str, str], areas: Collection[str]
) -> JournalContents | None:
    try:
        journal = read_journal(recorded_journal(Path(source.name), metadata), areas)
    except FileNotFoundError:
        return None
    return journal if belongs(journal.info, metadata) else None
