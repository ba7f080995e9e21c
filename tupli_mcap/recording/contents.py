"""Everything known of a recording once it is opened: from its summary, or recovered from its chunks and journal."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from mcap.records import AttachmentIndex, Channel, MetadataIndex, Schema

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.container import CHUNK_ROWS, REPEATED, Rows, library
from tupli_mcap.mcap.records import check_crc
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.topics import FINAL_STATE, INFO, Topic, parse
from tupli_mcap.recording.index import EPISODE_ROWS, EpisodeIndex

RECORDING_METADATA = "tupli_mcap.recording"
REPEATED_METADATA = RECORDING_METADATA + REPEATED
_REQUIRED_KEYS = ("uuid", "format_version", "library", "created_ns", "benchmark_id")
RECORDING_KEYS = (*_REQUIRED_KEYS, "journal", "replaced", "rewritten", "next_episode")
CHANNEL_KEYS = (
    "observation_space", "action_space", "reward_space", "dtypes", "inner_dtypes", "env", "leaf", "fields", "camera",
)  # fmt: skip
_VERSIONS = ("1", "2")
# kind of a channel -> key of its metadata that has the name in its topic
_KEYS = {"image": "leaf", "frame": "camera"}
_VALUES = (
    ("uuid", "32 hexadecimal digits", re.compile("[0-9a-f]{32}")),
    ("created_ns", "a time in decimal digits", re.compile("[0-9]{1,19}")),
    ("next_episode", "a number of an episode", re.compile("[0-9]{1,10}|")),
)


class NewerVersionError(FormatError):
    """The recording has a format that this version of the package does not know, so that it cannot check it."""


@dataclass
class Contents:
    """The contents of a recording: from the summary of a finished file, else from recovery.

    Attributes:
        metadata: of the recording, undamaged.
        schemas, channels: by id.
        attachments: by name, without the episode index.
        metadata_indexes: offsets of the metadata records, without the repeated one.
        table: the chunks (CHUNK_ROWS); those in `tail` have offsets from IN_MEMORY on.
        tail: the rows that are in no chunk of the file.
        index: the episode index.
        complete: the writer finished the file.
        data_end: the offset where the episode index begins; a writer that appends cuts the file there.
        undefined: the channels that only the journal defines.
        used_episodes: a number above those of episodes whose steps or ends are lost.
        endless: the numbers of the episodes whose ends recovery made; they may still be running.
    """

    metadata: dict[str, str]
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    attachments: dict[str, AttachmentIndex] = field(default_factory=dict)
    metadata_indexes: list[MetadataIndex] = field(default_factory=list)
    table: Array = field(default_factory=lambda: np.empty(0, CHUNK_ROWS))
    tail: list[Rows] = field(default_factory=list)
    index: EpisodeIndex = field(
        default_factory=lambda: EpisodeIndex(np.empty(0, EPISODE_ROWS), np.empty(0, CHUNK_ROWS), b"")
    )
    complete: bool = True
    data_end: int = 0
    undefined: list[int] = field(default_factory=list)
    used_episodes: int = 0
    endless: Collection[int] = ()

    @property
    def next_episode(self) -> int:
        """The number of the next episode. No number is used twice, not even that of an episode that was left out."""
        numbers = self.index.episodes["episode"]
        free = int(numbers.max()) + 1 if len(numbers) else 0
        return max(free, self.used_episodes, int(self.metadata.get("next_episode") or 0))


def step_channels(channels: dict[int, Channel], name: str) -> list[Channel]:
    """The step channels in the order of their sub-environments; raises FormatError if they are not numbered from 0, or
    the metadata of a channel is damaged."""
    found = []
    for channel in channels.values():
        if is_ours(channel.topic):
            check_crc(channel.metadata, CHANNEL_KEYS, f"{name}: the metadata of channel {channel.topic}")
        topic = parse(channel.topic)
        if topic is not None and topic.kind in _KEYS:
            _check_place(channel, topic, name)
        elif topic is not None and topic.kind == "step":
            found.append(channel)
    by_env = {channel.metadata.get("env", ""): channel for channel in found}
    numbers = [str(i) for i in range(len(found))]
    if sorted(by_env) != sorted(numbers):
        raise FormatError(
            f"{name}: expected step channels of sub-environments 0 to {len(found) - 1}, found {list(by_env)}"
        )
    return [by_env[number] for number in numbers]


def _check_place(channel: Channel, topic: Topic, name: str) -> None:
    """Raises FormatError unless a channel's metadata name the sub-environment, and leaf or camera, of its topic."""
    expected = {"env": str(topic.env), _KEYS[topic.kind]: topic.name}
    told = {key: channel.metadata.get(key) for key in expected}
    if told != expected:
        raise FormatError(
            f"{name}: expected {expected} in the metadata of channel {channel.topic}, found {told!r:.100}"
        )


def is_ours(topic: str) -> bool:
    """Whether the specification defines metadata for channels of that topic."""
    if topic in (FINAL_STATE, INFO):
        return True
    place = parse(topic)
    return place is not None and place.kind != "camera"


def first_metadata(uuid: str, format_version: str, benchmark_id: str, time_ns: int) -> dict[str, str]:
    """The metadata that every recording has from its beginning."""
    return {
        "uuid": uuid,
        "format_version": format_version,
        "library": library(),
        "created_ns": str(time_ns),
        "benchmark_id": benchmark_id,
    }


def check_metadata(source: Source, found: dict[str, str]) -> dict[str, str]:
    """The metadata of a recording without `crc`. Raises FormatError if they are damaged or incomplete,
    NewerVersionError if this version of the package does not know the format."""
    metadata = check_crc(found, RECORDING_KEYS, f"{source.name}: the metadata record {RECORDING_METADATA!r}")
    check_version(metadata, source.name)
    for key in _REQUIRED_KEYS:
        if key not in metadata:
            place = f"{source.name}: expected {key!r} in the metadata record {RECORDING_METADATA!r}"
            raise FormatError(
                f"{place}, found {sorted(metadata)!r:.200}; tupli-mcap recover saves the episodes"
            )
    for key, what, pattern in _VALUES:
        if not pattern.fullmatch(metadata.get(key, "")):
            raise FormatError(f"{source.name}: expected {key!r} of {what}, found {metadata.get(key)!r:.60}")
    return metadata


def check_version(metadata: Mapping[str, str], name: str) -> None:
    """Raises NewerVersionError unless this package knows the format that these (undamaged) metadata name."""
    version = metadata.get("format_version")
    if version not in _VERSIONS:
        known = " or ".join(map(repr, _VERSIONS))
        raise NewerVersionError(
            f"{name}: expected format version {known}, found {version!r:.40}; update tupli-mcap"
        )
