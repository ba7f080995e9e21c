"""Where the steps of a recording lie, apart from the open file: for readers of many recordings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.mcap.source import Source
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.columns.chunk_store import ChunkStore

__all__ = ["StoredSteps"]


class StoredSteps(NamedTuple):
    """The steps of a recording, by channel and row.

    `channels` are the step channels by sub-environment; `images` says for each image leaf (ROS name) which channel
    holds the images of a step channel; `final_channel` is None where there is no final state; `where` is the path or
    the URL that opens the file again, None if there is none; `source` is the file while the recording is open.
    """

    layout: StepLayout
    store: ChunkStore
    channels: list[int]
    images: dict[str, dict[int, int]]
    final_channel: int | None
    where: str | None
    source: Source

    def channels_of(self, envs: Array, leaf: str | None = None) -> Array:
        """The step channel (or that of an image leaf) of each sub-environment's number in `envs`."""
        if len(envs) and int(envs.max()) >= len(self.channels):
            raise FormatError(
                f"an episode names sub-environment {envs.max()}, but there are {len(self.channels)}"
            )
        found = [self.images[leaf][channel] if leaf else channel for channel in self.channels]
        return np.array(found, np.int64)[envs]
