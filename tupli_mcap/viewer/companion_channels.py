"""Companion channels: in a copy of a recording, each number and text once more, in a type that stock viewers plot.

Rerun plots `std_msgs/msg/Float64MultiArray` and shows `std_msgs/msg/String` as they are; Foxglove gets a layout file.
The copy is a recording like any other: companion channels say what they follow, and readers of recordings ignore them.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError
from tupli_mcap.journal.logs import group_records
from tupli_mcap.journal.rows import even_rows
from tupli_mcap.mcap.container import Rows
from tupli_mcap.mcap.records import BODY, CDR_HEADER, iter_records
from tupli_mcap.messages.cdr import write_string
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.episodes import record
from tupli_mcap.messages.layout import Field, record_dtype
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.recording.edit.rewrite import Follower
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.names import dimension_names
from tupli_mcap.viewer.targets import check_new

__all__ = ["ARRAY_SCHEMA", "STRING_SCHEMA", "WIDEST", "companion_topics", "write_companions"]

WIDEST = 64  # elements of a leaf that gets a companion: more lines than that are no plot
_SEPARATOR = "=" * 80 + "\n"
ARRAY_SCHEMA = (
    "std_msgs/MultiArrayLayout layout\nfloat64[] data\n"
    f"{_SEPARATOR}MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n"
    f"{_SEPARATOR}MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
)
STRING_SCHEMA = "string data\n"
_OPCODE_MESSAGE = 5


def write_companions(
    source: Recording,
    target: str | os.PathLike[str],
    *,
    episodes: Sequence[int] | None = None,
    force: bool = False,
) -> Path:
    """Writes a copy of `source` with companion channels.

    Args:
        episodes: numbers of those to keep; all by default.
        force: replace a file that exists.

    Raises:
        RecordingError: the target exists or cannot be written, or the source has no step.
        FormatError: the source is damaged.
    """
    target = Path(target)
    check_new(target, force=force)
    if not source.num_steps:
        raise RecordingError(f"{source.name} has no step, so there is nothing to plot")
    rewrite_recording(source, target, episodes=episodes, followers=_followers(source))
    return target


def companion_topics(layout: StepLayout, top: str = "") -> dict[str, str]:
    """ROS name of a leaf -> the topic that follows it; `top` is `/env_<i>` of a sub-environment."""
    topics = {leaf.name: f"{top}/plot/{leaf.name}" for leaf in layout.step_leaves if _is_plotted(leaf)}
    texts = {leaf.name: f"{top}/text/{leaf.name}" for leaf in layout.step_leaves if _is_text(leaf)}
    return topics | texts


def _is_plotted(leaf: Leaf) -> bool:
    return leaf.dtype is not None and not leaf.apart and 0 < leaf.size <= WIDEST


def _is_text(leaf: Leaf) -> bool:
    return type(leaf.space) is spaces.Text


def _followers(source: Recording) -> list[Follower]:
    layout, labels = source.layout, source.labels
    found = []
    for env in range(source.num_envs):
        recorded = Topics.of(env if source.is_vector else None)
        top, steps = recorded.top, recorded.step
        topics = companion_topics(layout, top)
        for leaf in layout.step_leaves:
            if _is_plotted(leaf):
                names = dimension_names(leaf, labels.dimensions.get(leaf.path))
                make = _numbers(names, _values_of(layout, leaf))
                found.append(_follower(topics[leaf.name], "Float64MultiArray", ARRAY_SCHEMA, steps, make))
            elif _is_text(leaf):
                found.append(
                    _follower(topics[leaf.name], "String", STRING_SCHEMA, steps, _texts(layout, leaf))
                )
        running = _numbers(["return"], _RunningReturn(layout))
        found.append(_follower(f"{top}/plot/return", "Float64MultiArray", ARRAY_SCHEMA, steps, running))
    return found


def _follower(topic: str, name: str, schema: str, steps: str, make: Callable[[int, Rows], Rows]) -> Follower:
    return Follower(topic, f"std_msgs/msg/{name}", schema, steps, make)


class _Columns(NamedTuple):
    """Steps: `episode`, and a value for each leaf."""

    episode: Array
    leaves: Callable[[str], Any]


def _columns(layout: StepLayout, rows: Rows) -> _Columns:
    if layout.constant:
        table: Array = np.frombuffer(rows.data, layout.step_message.dtype)
        return _Columns(table["episode"], table.__getitem__)
    decoder, data = MessageDecoder(layout), memoryview(rows.data)
    steps = [decoder.step(data[start + BODY : end]) for start, end, *_ in iter_records(data)]
    return _Columns(
        np.array([step["episode"] for step in steps]), lambda name: [step[name] for step in steps]
    )


def _values_of(layout: StepLayout, leaf: Leaf) -> Callable[[Rows], Array]:
    """Makes a function from steps to the leaf's elements as float64 (rows x elements)."""

    def values(rows: Rows) -> Array:
        found = np.asarray(_columns(layout, rows).leaves(leaf.name))
        return found.reshape(len(found), leaf.size).astype(np.float64)

    return values


class _RunningReturn:
    """From steps to the sum of their episode's rewards so far; keeps the sum from one chunk to the next."""

    def __init__(self, layout: StepLayout) -> None:
        self._layout = layout
        self._leaves = [leaf for leaf in layout.reward if leaf.dtype is not None and leaf.size]
        self._episode = -1
        self._total = 0.0

    def __call__(self, rows: Rows) -> Array:
        columns = _columns(self._layout, rows)
        rewards = np.zeros(len(columns.episode))
        for leaf in self._leaves:
            found = np.asarray(columns.leaves(leaf.name))
            rewards += found.reshape(len(found), -1).sum(axis=1, dtype=np.float64)
        returns = np.empty(len(rewards))
        bounds = [0, *(np.flatnonzero(np.diff(columns.episode.astype(np.int64))) + 1).tolist(), len(rewards)]
        for begin, end in itertools.pairwise(bounds):
            if columns.episode[begin] != self._episode:
                self._episode, self._total = int(columns.episode[begin]), 0.0
            returns[begin:end] = np.cumsum(rewards[begin:end]) + self._total
            self._total = float(returns[end - 1])
        return returns[:, None]


def _numbers(names: Sequence[str], values: Callable[[Rows], Array]) -> Callable[[int, Rows], Rows]:
    """Makes Float64MultiArray messages, all of one size, whose dimension is labelled with the names."""
    head = bytearray((1).to_bytes(4, "little"))
    write_string(head, 0, ", ".join(names))
    head += bytes(-len(head) % 4)
    for number in (len(names), len(names), 0, len(names)):  # size, stride, data_offset, length of data
        head += number.to_bytes(4, "little")
    at = -(-len(head) // 8) * 8
    fixed = Field("fixed", np.dtype(np.uint8), (len(head),), 0)
    data = Field("data", np.dtype(np.float64), (len(names),), at)
    dtype = record_dtype([fixed, data], at + data.nbytes)

    def make(channel: int, rows: Rows) -> Rows:
        table = np.frombuffer(bytearray(len(rows.times) * dtype.itemsize), dtype)
        table["#opcode"] = _OPCODE_MESSAGE
        table["#length"] = dtype.itemsize - 9
        table["#channel"] = channel
        table["#sequence"] = rows.first + np.arange(len(table))
        table["#log_time"] = table["#publish_time"] = rows.times
        table["#cdr"] = int.from_bytes(CDR_HEADER, "little")
        table["fixed"] = np.frombuffer(head, np.uint8)
        table["data"] = values(rows)
        return even_rows(channel, rows.first, table.tobytes(), table)

    return make


def _texts(layout: StepLayout, leaf: Leaf) -> Callable[[int, Rows], Rows]:
    """Makes String messages."""

    def make(channel: int, rows: Rows) -> Rows:
        out = bytearray()
        texts = _columns(layout, rows).leaves(leaf.name)
        for i, (text, time_ns) in enumerate(zip(texts, rows.times.tolist(), strict=True)):
            body = bytearray()
            write_string(body, 0, text)
            out += record(channel, rows.first + i, time_ns, bytes(body))
        (made,) = group_records(memoryview(out))
        return made

    return make
