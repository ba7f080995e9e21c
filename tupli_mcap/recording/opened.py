"""Opens a recording: reads summary and index, or recovers it in memory, and checks them before it allocates."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, NamedTuple

import gymnasium as gym
from mcap.records import Channel

from tupli_mcap.environment import DOCUMENT_NAME, PICKLE_NAME, EnvironmentRecord, build, reasons_for_distrust
from tupli_mcap.errors import FormatError, RecordingError, memory_for, plural
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.records import (
    BODY,
    Summary,
    check_magic,
    foreign,
    has_summary,
    read_attachment,
    read_metadata,
    read_summary,
)
from tupli_mcap.mcap.source import FileOfMany, PathSource, Source, TemporarySource, open_source
from tupli_mcap.messages.episodes import END_NAME, END_SCHEMA, START_NAME, START_SCHEMA
from tupli_mcap.messages.images.codecs import image_codecs
from tupli_mcap.messages.infos import InfoCodec
from tupli_mcap.messages.step import FINAL_STATE_SCHEMA, STEP_SCHEMA, StepLayout
from tupli_mcap.messages.topics import EPISODE_END, EPISODE_START, FINAL_STATE, INFO, Topics
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.columns.read import ColumnReader
from tupli_mcap.recording.contents import (
    RECORDING_METADATA,
    REPEATED_METADATA,
    Contents,
    check_metadata,
    step_channels,
)
from tupli_mcap.recording.frames import Cameras
from tupli_mcap.recording.index import (
    EPISODE_TOPICS,
    INDEX_NAME,
    EpisodeIndex,
    StepClaims,
    check_chunks,
    check_episodes,
    check_rows,
)
from tupli_mcap.recording.signature_file import SIGNATURE_NAME, voucher
from tupli_mcap.remote import is_url
from tupli_mcap.spaces.labels import LABELS_NAME, MAX_LABELS, Labels
from tupli_mcap.trust import TrustedKey, is_trusted

CACHE_BYTES = 512 << 20
_ATTEMPTS = 5
_NO_METADATA = f"it has no metadata {RECORDING_METADATA!r}"
_REWRITTEN = "if another program has rewritten it, recover it into a new file"
_PAUSE = 0.01  # seconds to wait for a writer that is just beginning or closing


class AttachmentInfo(NamedTuple):
    """An entry of the attachments in a recording's summary."""

    name: str
    media_type: str
    size: int


class OpenFile(NamedTuple):
    """The file of an open recording, for code that copies, checks or signs its contents.

    Attributes:
        topics: topic -> channel id.
        steps: ids of the step channels, by sub-environment.
    """

    source: Source
    contents: Contents
    store: ChunkStore
    topics: Mapping[str, int]
    steps: Sequence[int]
    cameras: Cameras

    def __repr__(self) -> str:
        return f"<OpenFile {self.source.name!r}: {plural(len(self.topics), 'channel')}>"

    @property
    def info_codec(self) -> InfoCodec | None:
        """The codec of the infos; None if the file has none."""
        channel = self.topics.get(INFO)
        return None if channel is None else InfoCodec.from_metadata(self.contents.channels[channel].metadata)


class RecordedBenchmark(NamedTuple):
    """The environment of a recording, as data. `signature` is the attachment of a signed recording."""

    id: str
    record: EnvironmentRecord
    signature: bytes | None = None

    def make_env(self, *, trust: bool = False, render_mode: str | None = None) -> gym.Env[Any, Any]:
        """Rebuilds the environment; a given `render_mode` is used if the environment has it. `trust` lets code from the
        file run.

        Raises:
            UntrustedError: code from the file would run, and this user trusts neither it nor the key that signed it.
        """
        trust = trust or (self.needs_trust and self.voucher is not None)
        return build(self.record, trust=trust, render_mode=render_mode)

    @property
    def needs_trust(self) -> bool:
        """Whether rebuilding it runs code that this user has not trusted."""
        return bool(reasons_for_distrust(self.record)) and not is_trusted(self.record.digest)

    @property
    def voucher(self) -> TrustedKey | None:
        """The key, among those this user trusts, that signed the environment; None if none did."""
        return None if self.signature is None else voucher(self.signature, self.record.digest, self.id)


class OpenedRecording:
    """An open file with a sound structure, and the facts in it. The arguments are those of `Recording`."""

    def __init__(
        self,
        source: str | os.PathLike[str] | BinaryIO | TemporarySource | FileOfMany,
        *,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self._source = open_source(source)
        place = source.name if isinstance(source, FileOfMany) else source
        self.address: str | None = None if not isinstance(place, str | os.PathLike) else _absolute(place)
        self._cache_bytes = cache_bytes
        self.name = self._source.name
        path = self._source.path
        self.path: Path | None = None if path is None else Path(_absolute(path))
        try:
            with memory_for(lambda: f"{self.name}: opening a file of {self._source.size} bytes"):
                self._contents: Contents = read_contents(self._source)
                memory = [bytes(rows.data) for rows in self._contents.tail]
                self._store = ChunkStore(self._source, self._contents.table, memory, cache_bytes)
                self._prepare()
        except BaseException:
            self._source.close()
            raise

    def _prepare(self) -> None:
        contents = self._contents
        self.complete = contents.complete
        self.metadata: Mapping[str, str] = MappingProxyType(contents.metadata)
        self.index = contents.index.episodes
        topics = {channel.topic: channel for channel in contents.channels.values()}
        steps = step_channels(contents.channels, self.name)
        self._step_channels = [channel.id for channel in steps]
        self._layout: StepLayout | None = None
        self._columns: ColumnReader | None = None
        self._topics = {topic: channel.id for topic, channel in topics.items()}
        self._images: dict[str, dict[int, int]] = {}  # leaf -> step channel -> image channel
        # messages by episode and step
        self._infos: tuple[InfoCodec, dict[int, dict[int, bytes]]] | None = None
        counts = {topic: self._store.count(self._topics.get(topic, 0)) for topic in EPISODE_TOPICS}
        rows = [self._store.count(channel) for channel in self._step_channels]
        check_episodes(self.index, rows, counts, self.name, whole=contents.complete)
        self._cameras = Cameras(contents, self._store, self.is_vector, len(steps), self.name)
        if steps:
            try:
                self._layout = StepLayout.from_metadata(steps[0].metadata)
            except FormatError as err:
                raise FormatError(f"{self.name}: {steps[0].topic}: {err}") from err
            self._check_schemas(topics, steps, self._layout)
            self._images = {
                leaf.name: {
                    channel.id: self._topics.get(Topics.of_step(channel.topic).image(leaf.name), 0)
                    for channel in steps
                }
                for leaf in self._layout.images
            }
            self._store.codecs = image_codecs(self._layout, contents.channels)
            if contents.complete:
                self._check_sizes(self._layout, rows)
            self._store.claims = {
                channel: StepClaims(self.index, env) for env, channel in enumerate(self._step_channels)
            }
            self._columns = ColumnReader(self._layout, self._store, self._images)

    def _check_schemas(
        self, topics: Mapping[str, Channel], steps: Sequence[Channel], layout: StepLayout
    ) -> None:
        """Checks that the channels have the schemas of the layout, and steps and final states the same spaces."""
        final = [topics[FINAL_STATE]] if FINAL_STATE in topics else []
        for channel in [*steps, *final]:
            if _spaces_of(channel) != _spaces_of(steps[0]):
                raise FormatError(
                    f"{self.name}: {channel.topic} describes other spaces than {steps[0].topic}"
                )
        expected = {
            **{channel.topic: (STEP_SCHEMA, layout.step_schema) for channel in steps},
            FINAL_STATE: (FINAL_STATE_SCHEMA, layout.final_schema),
            EPISODE_START: (START_NAME, START_SCHEMA),
            EPISODE_END: (END_NAME, END_SCHEMA),
        }
        for topic, (name, text) in expected.items():
            schema = self._contents.schemas.get(topics[topic].schema_id) if topic in topics else None
            if topic in topics and (schema is None or (schema.name, schema.data) != (name, text.encode())):
                raise FormatError(f"{self.name}: the schema of {topic} is not that of its spaces")

    def _check_sizes(self, layout: StepLayout, steps: Sequence[int]) -> None:
        """Checks that the chunks have room for the rows in the index, and that each step has its images."""
        if layout.constant:
            size = layout.step_message.record_size
        else:  # at least
            least = (
                1 if leaf.kind == "variable" else leaf.size * layout.dtypes[leaf.name].itemsize
                for leaf in layout.step_leaves
            )
            size = BODY + 10 + sum(least)
        sizes = dict.fromkeys(self._step_channels, (size, layout.constant))
        if layout.constant and FINAL_STATE in self._topics:
            sizes[self._topics[FINAL_STATE]] = (layout.final_message.record_size, True)
        for leaf in layout.images:
            for count, channel in zip(steps, self._images[leaf.name].values(), strict=True):
                if self._store.count(channel) != count:
                    raise FormatError(
                        f"{self.name}: expected {count} images of {leaf.path}, found {self._store.count(channel)}; "
                        "recover it into a new file"
                    )
                if channel not in self._store.codecs:
                    sizes[channel] = (layout.image_messages[leaf.name].dtype.itemsize, True)
        check_rows(self._contents.table, sizes, self.name)

    # ---- facts

    @property
    def uuid(self) -> str:
        """32 hex digits, made with the recording."""
        return self.metadata["uuid"]

    @property
    def size(self) -> int:
        """Bytes of the file when it was opened."""
        return self._source.size

    @property
    def benchmark_id(self) -> str:
        """The id of the benchmark; empty if there is none."""
        return self.metadata.get("benchmark_id", "")

    @property
    def created_ns(self) -> int:
        """Wall clock (ns) when the recording was made."""
        return int(self.metadata["created_ns"])

    @property
    def layout(self) -> StepLayout:
        """The layout of the steps; raises RecordingError before the first step."""
        if self._layout is None:
            raise RecordingError(
                f"{self.name} has no step yet, so its spaces are not known; record a step first"
            )
        return self._layout

    @property
    def observation_space(self) -> gym.Space[Any]:
        """The space of the states of one sub-environment; raises RecordingError before the first step."""
        return self.layout.observation_space

    @property
    def action_space(self) -> gym.Space[Any]:
        """The space of the actions of one sub-environment; raises RecordingError before the first step."""
        return self.layout.action_space

    @property
    def num_envs(self) -> int:
        """Number of sub-environments; 1 for a single environment."""
        return len(self._step_channels)

    @property
    def is_vector(self) -> bool:
        """True if a vector environment was recorded, even one with a single sub-environment."""
        return Topics.of(0).step in self._topics

    @property
    def n_steps(self) -> int:
        """The number of steps of all episodes."""
        return int(self.index["length"].sum())

    @property
    def attachments(self) -> Mapping[str, AttachmentInfo]:
        """The attachments without the episode index."""
        return {
            name: AttachmentInfo(name, a.media_type, a.data_size)
            for name, a in self._contents.attachments.items()
        }

    def read_attachment(self, name: str) -> bytes:
        """An attachment's bytes, its CRC checked.

        Raises:
            RecordingError: there is no such attachment.
            FormatError: it is damaged.
        """
        if name not in self._contents.attachments:
            known = ", ".join(self._contents.attachments) or "none"
            raise RecordingError(f"{self.name} has no attachment {name!r}; it has {known}")
        return read_attachment(self._source, self._contents.attachments[name])

    def _small_attachment(self, name: str, most: int) -> bytes | None:
        """An attachment's bytes, None if there is none; raises FormatError if it has more than `most` bytes."""
        info = self.attachments.get(name)
        if info is not None and info.size > most:
            raise FormatError(f"{self.name}: {name}: expected at most {most} bytes, found {info.size}")
        return None if info is None else self.read_attachment(name)

    @property
    def labels(self) -> Labels:
        """Names of dimensions and values, and the seconds of a step; parts that the recording lacks are empty.

        Raises:
            FormatError: they do not fit the recording.
        """
        data = None if self._layout is None else self._small_attachment(LABELS_NAME, MAX_LABELS)
        if data is None:
            return Labels.none()
        return Labels.from_json(data, self.layout.leaves, f"{self.name}: {LABELS_NAME}")

    @property
    def benchmark(self) -> RecordedBenchmark:
        """The environment that was recorded, as data; `make_env()` rebuilds it.

        Raises:
            RecordingError: the recording carries no environment.
            FormatError: what it carries is damaged.
        """
        if DOCUMENT_NAME not in self._contents.attachments:
            advice = "load its benchmark from the storage it is in"
            if not self.benchmark_id:
                advice = "it was left out, could not be captured, or lived in other processes"
            raise RecordingError(f"{self.name} carries no environment; {advice}")
        pickle = None
        if PICKLE_NAME in self._contents.attachments:
            pickle = self.read_attachment(PICKLE_NAME)
        where = f"{self.name}: benchmark.json"
        record = EnvironmentRecord.from_json(self.read_attachment(DOCUMENT_NAME), pickle, where=where)
        signature = self.read_attachment(SIGNATURE_NAME) if SIGNATURE_NAME in self.attachments else None
        return RecordedBenchmark(self.benchmark_id, record, signature)

    def _channel(self, topic: str) -> int:
        if topic not in self._topics:
            raise FormatError(
                f"{self.name}: expected a channel {topic}, found {', '.join(self._topics) or 'none'}"
            )
        return self._topics[topic]

    @property
    def file(self) -> OpenFile:
        """Its channels, chunks and messages; closing the recording closes it."""
        return OpenFile(
            self._source, self._contents, self._store, self._topics, self._step_channels, self._cameras
        )

    def close(self) -> None:
        """Closes the file; what was read stays valid."""
        self._source.close()


def _spaces_of(channel: Channel) -> dict[str, str]:
    return {key: value for key, value in channel.metadata.items() if key not in ("env", "crc")}


def _absolute(source: str | os.PathLike[str]) -> str:
    name = os.fspath(source)
    return name if is_url(name) else os.path.abspath(name)  # noqa: PTH100 - links stay


# ---- the contents: from the summary, or by recovery in memory


def is_finished(path: Path) -> bool:
    """Whether a file ends as a finished recording does. FormatError if it does not begin as an MCAP file does."""
    with contextlib.closing(PathSource(path)) as source:
        if has_summary(source):
            return True
        check_magic(source)
        return False


def read_contents(source: Source) -> Contents:
    """Reads the contents from the summary of a finished file, or by recovery; again if a writer changes it meanwhile.
    Raises FormatError if the file is no MCAP file, is no recording, or is damaged."""
    for _ in range(_ATTEMPTS):
        size = source.size
        try:
            return _read_contents(source)
        except FormatError:
            source.refresh()
            if source.size == size and (source.path is None or not is_locked(source.path)):
                raise
        time.sleep(_PAUSE)
    return _read_contents(source)


def _read_contents(source: Source) -> Contents:
    if not has_summary(source):
        check_magic(source)
        from tupli_mcap.recording.recover.from_journal import find_journal
        from tupli_mcap.recording.recover.unfinished import recover_contents

        journal = find_journal(source)  # a writer that closed in the meantime left a summary, and no journal
        if not has_summary(source):
            return recover_contents(source, journal)
    summary = _summary(source)
    # prefer the record at the end: everything read here then lies at the end of the file
    place = summary.metadata.get(REPEATED_METADATA, summary.metadata.get(RECORDING_METADATA))
    if place is None:
        if _is_ours(source):
            raise FormatError(f"{source.name}: {_NO_METADATA}; {_REWRITTEN}")
        raise foreign(source, _NO_METADATA)
    metadata = check_metadata(source, read_metadata(source, place))
    if INDEX_NAME not in summary.attachments:
        raise FormatError(
            f"{source.name}: the recording has no episode index {INDEX_NAME!r}; recover it into a new file"
        )
    attachment = summary.attachments.pop(INDEX_NAME)
    index = EpisodeIndex.decode(read_attachment(source, attachment), source.name)
    if len(index.chunks) != summary.chunks:
        raise FormatError(
            f"{source.name}: the episode index lists {len(index.chunks)} chunks, the summary {summary.chunks}; "
            f"{_REWRITTEN}"
        )
    check_chunks(index.chunks, attachment.offset, source.name)
    return Contents(
        metadata,
        summary.schemas,
        summary.channels,
        summary.attachments,
        [place for place in summary.metadata.values() if place.name != REPEATED_METADATA],
        index.chunks,
        index=index,
        data_end=attachment.offset,
    )


def _is_ours(source: Source) -> bool:
    """Whether a finished file that cannot be read may be a recording."""
    from tupli_mcap.recording.recover.damaged import may_be_recording
    from tupli_mcap.recording.recover.evidence import FileEnd

    return may_be_recording(source, FileEnd(finished=True))


def _summary(source: Source) -> Summary:
    """The summary of a finished file. What MCAP allows and recordings never have, such as no CRC or a topic twice, is
    damage only in a recording."""
    try:
        return read_summary(source)
    except FormatError as err:
        if _is_ours(source):
            raise FormatError(f"{err}; recover it into a new file") from err
        raise foreign(source, _NO_METADATA) from err
