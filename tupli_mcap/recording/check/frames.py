"""Checks the frames of a recording against its episodes and each other."""

from __future__ import annotations

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.messages.frames import FRAME_LAYOUT, decode_frame
from tupli_mcap.messages.images.pictures import format_of
from tupli_mcap.messages.topics import Topics
from tupli_mcap.recording.check.report import Findings
from tupli_mcap.recording.columns.chunk_store import ChunkStore
from tupli_mcap.recording.recording import Recording

_TOLD = 3  # rows of a channel that are reported for each defect


def verify_frames(recording: Recording, findings: Findings) -> None:
    """Checks that every picture has a row in `/frame`, with the same time, and that these rows are in order."""
    for camera in recording.cameras:
        for env in range(recording.num_envs):
            _Pair(recording, findings, camera, env).run()


class _Pair:
    def __init__(self, recording: Recording, findings: Findings, camera: str, env: int) -> None:
        self._recording = recording
        self._findings = findings
        self._store: ChunkStore = recording.file.store
        self._camera = camera
        topics = Topics.of(env if recording.is_vector else None)
        self._picture_topic, self._pair_topic = topics.camera(camera), topics.frame(camera)
        self._channels = recording.file.cameras.channels(camera, env)
        self._rows = recording.index[recording.index["env"] == env]

    def run(self) -> None:
        pictures, pairs = (self._store.count(channel) for channel in self._channels)
        if pictures != pairs and self._recording.complete:
            self._error(f"expected {pairs} frames, found {pictures}", self._picture_topic)
        topic = self._pair_topic
        try:
            times = self._pairs(self._channels[1])
            topic = self._picture_topic
            self._pictures(self._channels[0], times)
        except FormatError as err:
            self._error(str(err), topic)

    def _pairs(self, channel: int) -> Array:
        """Checks the rows of `/frame`; returns their times (int64, ns)."""
        parts = [
            self._store.rows(chunk, FRAME_LAYOUT.dtype, keep=False) for chunk in self._store.chunks(channel)
        ]
        rows = np.concatenate(parts) if parts else np.empty(0, FRAME_LAYOUT.dtype)
        episodes, steps = rows["episode"].astype(np.int64), rows["step"].astype(np.int64)
        again = (episodes[1:] == episodes[:-1]) & (steps[1:] <= steps[:-1])
        for i in np.flatnonzero(again)[:_TOLD].tolist():
            self._error(
                f"row {i + 1} is of an earlier step than the row before, or the same", self._pair_topic
            )
        starts = np.append(True, episodes[1:] != episodes[:-1])[: len(rows)]
        runs = episodes[starts]
        if len(np.unique(runs)) != len(runs):
            self._error("frames of an episode are not one after another", self._pair_topic)
        order = np.argsort(self._rows["episode"], kind="stable")
        known = self._rows["episode"][order].astype(np.int64)
        lengths = np.append(self._rows["length"][order].astype(np.int64), -1)
        at = np.searchsorted(known, episodes)
        is_known = np.append(known, -1)[at] == episodes
        lost = int((~is_known | (steps > lengths[at])).sum())
        if lost and self._recording.complete:
            self._findings.note(
                "frame",
                f"{lost} frames of camera {self._camera!r} are of steps that are not in the recording",
                "nothing to be done: a power loss or a lost journal leaves such frames, and they are never shown",
            )
        return rows["#log_time"].astype(np.int64)

    def _pictures(self, channel: int, times: Array) -> None:
        for row, time, body in self._store.all_messages(channel):
            why = self._defect(body, time, int(times[row]) if row < len(times) else None)
            if why:
                self._error(f"row {row} {why}", self._picture_topic)

    def _defect(self, body: memoryview, log_time: int, pair_time: int | None) -> str:
        """What is wrong with a picture's message; empty if nothing is."""
        try:
            frame, frame_id = decode_frame(body)
        except FormatError as err:
            return f"cannot be decoded: {err}"
        if frame.form not in ("png", "jpeg") or format_of(frame.data) != frame.form:
            return f"is no picture of its format {frame.form!r:.40}"
        if frame_id != self._camera:
            return f"is of camera {frame_id!r:.60}"
        if frame.time_ns != log_time or pair_time not in (None, log_time):
            return "has another time than its header or its row of /frame"
        return ""

    def _error(self, message: str, topic: str) -> None:
        self._findings.error("frame", message, channel=topic)
