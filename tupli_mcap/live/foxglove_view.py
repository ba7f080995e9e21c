"""A Foxglove WebSocket server on this machine: the topics, schemas and bytes of the file, as they come."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from tupli_mcap.errors import missing_extra
from tupli_mcap.live.follow import NewSteps, Watcher
from tupli_mcap.live.target import Target
from tupli_mcap.mcap.records import RECORD_HEADER
from tupli_mcap.messages.images.codecs import CODEC
from tupli_mcap.messages.layout import IMAGE_NAME, IMAGE_SCHEMA
from tupli_mcap.recording.write.writer import RecordingWriter

__all__ = ["FoxgloveView"]

_STEPS = 250  # of a sub-environment at a time
_IMAGES = 2
_ENVS = 8
_EVENTS = 250
_FAREWELL = 0.2  # seconds for clients to take what was published last: a server that stops drops it


class FoxgloveView:
    """Publishes what is recorded; a channel that nobody listens to costs next to nothing.

    Raises:
        MissingExtraError: the extra `foxglove` is not installed.
        RuntimeError: the port is taken.
    """

    def __init__(self, target: Target, title: str, writer: RecordingWriter) -> None:
        try:
            import foxglove
        except ImportError as err:
            raise missing_extra("a live view in Foxglove needs foxglove-sdk", "foxglove") from err
        self._sdk = foxglove
        self._context = foxglove.Context()
        self._writer = writer
        self._channels: dict[int, Any] = {}  # by channel id
        self._server: Any = foxglove.start_server(
            name=title, host=target.host, port=target.port, context=self._context
        )
        self.port = int(self._server.port)

    def show(self, watcher: Watcher) -> bool:
        if not self._channels:
            self._announce()
        if not any(channel.has_sinks() for channel in self._channels.values()):
            return False
        steps, _ = watcher.look(_ENVS)
        channels = self._writer.channels
        for new in steps:
            shown = new.newest(_STEPS)
            self._publish(channels.steps[new.env], shown.cdr())
            self._show_images(watcher, shown)
        for channel, time_ns, message in watcher.events()[-_EVENTS:]:
            self._publish(channel, [(time_ns, message)])
        return True

    def _announce(self) -> None:
        """The channels that the file has, in its own order."""
        container = self._writer.container
        for channel in container.channels.values():
            schema = container.schemas[channel.schema_id]
            name, text = schema.name, schema.data
            if CODEC in channel.metadata:  # what is shown comes out of the journal, as pixels
                name, text = IMAGE_NAME, IMAGE_SCHEMA.encode()
            self._channels[channel.id] = self._sdk.Channel(
                channel.topic,
                schema=self._sdk.Schema(name=name, encoding=schema.encoding, data=text),
                message_encoding="cdr",
                metadata=dict(channel.metadata),
                context=self._context,
            )

    def _publish(self, channel: int, messages: Any) -> None:
        out = self._channels.get(channel)
        if out is not None and out.has_sinks():
            for time_ns, message in messages:
                out.log(message, log_time=time_ns)

    def _show_images(self, watcher: Watcher, steps: NewSteps) -> None:
        stop = steps.first + len(steps)
        for leaf, ids in enumerate(self._writer.channels.images):
            out = self._channels.get(ids[steps.env])
            if out is None or not out.has_sinks():
                continue
            found = watcher.images(leaf, steps.env, range(max(steps.first, stop - _IMAGES), stop))
            for row in sorted(found):
                message = np.frombuffer(found[row], np.uint8)[RECORD_HEADER.size :].tobytes()
                out.log(message, log_time=int(found[row]["#log_time"]))

    def go_on(self, writer: RecordingWriter) -> None:
        self._close_channels()
        self._writer = writer

    def _close_channels(self) -> None:
        for channel in self._channels.values():
            channel.close()
        self._channels = {}

    def close(self) -> None:
        if any(channel.has_sinks() for channel in self._channels.values()):
            time.sleep(_FAREWELL)
        self._close_channels()
        self._server.stop()
