"""Everything known of a recording once it is opened: from its summary, or recovered from its chunks and journal."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema

from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.checksums import check_crc
from tupli_mcap.mcap.container import CHUNK_ROWS, Rows
from tupli_mcap.mcap.lock import is_locked
from tupli_mcap.mcap.source import Source
from tupli_mcap.mcap.summary import (
    check_magic,
    foreign,
    has_summary,
    read_attachment,
    read_metadata,
    read_summary,
)
from tupli_mcap.recording.index import EPISODE_ROWS, INDEX_NAME, EpisodeIndex
from tupli_mcap.recording.limits import check_chunks

__all__ = ["Contents", "NewerVersionError", "check_version", "read_contents"]

RECORDING_METADATA = "tupli_mcap.recording"
RECORDING_KEYS = (
    "uuid", "format_version", "library", "created_ns", "benchmark_id", "journal", "replaced", "rewritten",
    "next_episode",
)  # fmt: skip
CHANNEL_KEYS = (
    "observation_space", "action_space", "reward_space", "dtypes", "inner_dtypes", "env", "leaf", "fields", "camera",
)  # fmt: skip
_VERSIONS = ("1", "2")
_PLACE = re.compile("(?:/env_([0-9]+))?/(image|frame)/(.+)", re.DOTALL)
_ATTEMPTS = 5
_PAUSE = 0.01  # seconds: a writer begins, ends or goes on within that
_VALUES = (
    ("uuid", "32 hexadecimal digits", re.compile("[0-9a-f]{32}")),
    ("created_ns", "a time in decimal digits", re.compile("[0-9]{1,19}")),
    ("next_episode", "a number of an episode", re.compile("[0-9]{1,10}|")),
)


class NewerVersionError(FormatError):
    """A recording of a format that this version of the package does not know: nothing in it can be judged."""


@dataclass
class Contents:
    """`table` is a CHUNK_ROWS array; `memory` holds the rows of chunks that are only in the journal (`tail`, as the
    writer would take them); `data_end` is the offset where the episode index (or what is to be cut) begins; `undefined`
    are the channels that only the journal defines."""

    metadata: dict[str, str]
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, AttachmentIndex] = field(default_factory=dict)
    metadata_indexes: list[MetadataIndex] = field(default_factory=list)
    table: np.ndarray = field(default_factory=lambda: np.empty(0, CHUNK_ROWS))
    memory: list[bytes] = field(default_factory=list)
    tail: list[Rows] = field(default_factory=list)
    index: EpisodeIndex = field(
        default_factory=lambda: EpisodeIndex(np.empty(0, EPISODE_ROWS), np.empty(0, CHUNK_ROWS), b"")
    )
    complete: bool = True
    data_end: int = 0
    undefined: list[int] = field(default_factory=list)
    used_episodes: int = 0  # beyond the numbers of episodes whose steps were lost, and whose ends were not

    @property
    def next_episode(self) -> int:
        """The number of the next episode: no number is given twice, not even one that was left out in rewriting."""
        told = self.metadata.get("next_episode", "0")
        numbers = self.index.episodes["episode"]
        free = max(self.used_episodes, int(numbers.max()) + 1 if len(numbers) else 0)
        return max(free, int(told)) if re.fullmatch("[0-9]{1,10}", told) else free


def read_contents(source: Source) -> Contents:
    """Reads a finished file by its summary, another by recovery; anew if a writer changes it meanwhile.

    Raises:
        FormatError: no MCAP file, no recording of ours, or damaged.
    """
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
    check_magic(source)
    if not has_summary(source):
        from tupli_mcap.recording.recover.unfinished import find_journal, recover_contents

        journal = find_journal(source)  # a writer that closed in between has left a summary, and no journal
        if not has_summary(source):
            return recover_contents(source, journal)
    summary = read_summary(source)
    if RECORDING_METADATA not in summary.metadata:
        raise foreign(source, f"it has no metadata {RECORDING_METADATA!r}")
    metadata = check_metadata(source, read_metadata(source, summary.metadata[RECORDING_METADATA]))
    if INDEX_NAME not in summary.attachments:
        raise FormatError(
            f"{source.name}: the recording has no episode index {INDEX_NAME!r}; recover it into a new file"
        )
    attachment = summary.attachments.pop(INDEX_NAME)
    index = EpisodeIndex.decode(read_attachment(source, attachment), source.name)
    if len(index.chunks) != summary.chunks:
        raise FormatError(
            f"{source.name}: the episode index lists {len(index.chunks)} chunks, the summary {summary.chunks}"
        )
    check_chunks(index.chunks, attachment.offset, source.name)
    return Contents(
        metadata,
        summary.schemas,
        summary.channels,
        summary.attachments,
        list(summary.metadata.values()),
        index.chunks,
        index=index,
        data_end=attachment.offset,
    )


def step_channels(channels: dict[int, Channel], name: str) -> list[Channel]:
    """The step channels in the order of their sub-environments.

    Raises:
        FormatError: they are not numbered from 0, or the metadata of a channel is damaged.
    """
    for channel in channels.values():
        if is_ours(channel.topic):
            check_crc(channel.metadata, CHANNEL_KEYS, f"{name}: the metadata of channel {channel.topic}")
            check_place(channel, name)
    found = [channel for channel in channels.values() if channel.topic.endswith("/step")]
    by_env = {channel.metadata.get("env", ""): channel for channel in found}
    numbers = [str(i) for i in range(len(found))]
    if sorted(by_env) != sorted(numbers):
        raise FormatError(
            f"{name}: expected step channels of sub-environments 0 to {len(found) - 1}, found {list(by_env)}"
        )
    return [by_env[number] for number in numbers]


def check_place(channel: Channel, name: str) -> None:
    """Raises FormatError unless the metadata of a channel of images or frames says the place that its topic says."""
    found = _PLACE.fullmatch(channel.topic)
    if found is None:
        return
    key = "leaf" if found[2] == "image" else "camera"
    expected = {"env": found[1] or "0", key: found[3]}
    told = {key: channel.metadata.get(key) for key in expected}
    if told != expected:
        raise FormatError(
            f"{name}: expected {expected} in the metadata of channel {channel.topic}, found {told!r:.100}"
        )


def is_ours(topic: str) -> bool:
    return (
        topic in ("/final_state", "/info")
        or topic.endswith("/step")
        or "/image/" in topic
        or "/frame/" in topic
    )


def check_metadata(source: Source, found: dict[str, str]) -> dict[str, str]:
    """The metadata without its checksum; FormatError unless it is whole, and of a format this version reads."""
    metadata = check_crc(found, RECORDING_KEYS, f"{source.name}: the metadata record {RECORDING_METADATA!r}")
    check_version(metadata, source.name)
    for key, what, pattern in _VALUES:
        if not pattern.fullmatch(metadata.get(key, "")):
            raise FormatError(f"{source.name}: expected {key!r} of {what}, found {metadata.get(key)!r:.60}")
    return metadata


def check_version(metadata: Mapping[str, str], name: str) -> None:
    """Raises NewerVersionError unless this version of the package knows the format of a recording with these metadata,
    which are undamaged."""
    version = metadata.get("format_version")
    if version not in _VERSIONS:
        known = " or ".join(map(repr, _VERSIONS))
        raise NewerVersionError(
            f"{name}: expected format version {known}, found {version!r:.40}; update tupli-mcap"
        )
