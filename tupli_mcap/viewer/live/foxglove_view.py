"""A Foxglove WebSocket server on this machine, which sends the messages of the file as they are recorded."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import foxglove
import numpy as np

from tupli_mcap.mcap.records import RECORD_HEADER
from tupli_mcap.messages.images.codecs import CODEC
from tupli_mcap.messages.layout import IMAGE_NAME, IMAGE_SCHEMA
from tupli_mcap.viewer.live.follow import Follower
from tupli_mcap.viewer.live.new_rows import NewSteps
from tupli_mcap.viewer.live.target import Target

_STEPS = 250  # of a sub-environment at a time
_IMAGES = 2
_EVENTS = 250
_FAREWELL = 0.2  # seconds for clients to take the last messages, which a stopping server drops


class FoxgloveView:
    """Publishes what is recorded, on the channels that clients subscribed to. RuntimeError if the port is taken."""

    def __init__(self, target: Target, title: str) -> None:
        self._context = foxglove.Context()
        self._channels: dict[int, Any] = {}  # by channel id
        self._server: Any = foxglove.start_server(
            name=title, host=target.host, port=target.port, context=self._context
        )

    def show(self, follower: Follower) -> bool:
        if not self._channels:
            self._announce(follower)
        if not any(channel.has_sinks() for channel in self._channels.values()):
            return False
        steps, _ = follower.look()
        for new in steps:
            shown = new.newest(_STEPS)
            self._publish(follower.steps[new.env], shown.cdr())
            self._show_images(follower, shown)
        for channel, time_ns, message in follower.events(_EVENTS):
            self._publish(channel, [(time_ns, message)])
        return True

    def _announce(self, follower: Follower) -> None:
        """Offers the channels of the file, in its order."""
        for channel in follower.channels.values():
            schema = follower.schemas[channel.schema_id]
            name, text = schema.name, schema.data
            if CODEC in channel.metadata:  # stored encoded, published as pixels
                name, text = IMAGE_NAME, IMAGE_SCHEMA.encode()
            self._channels[channel.id] = foxglove.Channel(
                channel.topic,
                schema=foxglove.Schema(name=name, encoding=schema.encoding, data=text),
                message_encoding="cdr",
                metadata=dict(channel.metadata),
                context=self._context,
            )

    def _publish(self, channel: int, messages: Any) -> None:
        out = self._channels.get(channel)
        if out is not None and out.has_sinks():
            for time_ns, message in messages:
                out.log(message, log_time=time_ns)

    def _show_images(self, follower: Follower, steps: NewSteps) -> None:
        stop = steps.first + len(steps)
        for leaf in range(len(follower.layout.images)):
            channel = follower.image_channel(leaf, steps.env)
            if self._channels[channel].has_sinks():
                found = follower.images(leaf, steps.env, range(max(steps.first, stop - _IMAGES), stop))
                for record in found.values():
                    message = np.frombuffer(record, np.uint8)[RECORD_HEADER.size :].tobytes()
                    self._publish(channel, [(int(record["#log_time"]), message)])

    def go_on(self, path: Path) -> None:
        self._close_channels()

    def _close_channels(self) -> None:
        for channel in self._channels.values():
            channel.close()
        self._channels = {}

    def close(self) -> None:
        if any(channel.has_sinks() for channel in self._channels.values()):
            time.sleep(_FAREWELL)
        self._close_channels()
        self._server.stop()
