"""Pictures of an episode: recorded frames, and images of its states."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import NotFoundError
from tupli_mcap.messages.images.pictures import encode_pixels, format_of
from tupli_mcap.recording import Episode
from tupli_mcap.reexecute.recorded_film import as_picture
from tupli_mcap.spaces.leaves import Leaf

_COARSE = 200  # pixels


class Camera(NamedTuple):
    """A source of pictures: a camera, or an image of the states (`leaf`).

    steps: int64; picture i shows the state after `steps[i]` steps.
    """

    name: str
    steps: Array
    leaf: Leaf | None = None

    @property
    def coarse(self) -> bool:
        """Whether it has so few pixels that a browser has to enlarge them without smoothing."""
        return self.leaf is not None and max(self.leaf.shape) < _COARSE

    def place(self, step: int) -> int:
        """The index of the picture that shows a step: the last one up to it."""
        return max(0, int(self.steps.searchsorted(step, side="right")) - 1)

    def shows(self) -> str:
        """JSON for the page's script: the steps, or their count if each step has a picture."""
        count = len(self.steps)
        return json.dumps(count if np.array_equal(self.steps, np.arange(count)) else self.steps.tolist())


def cameras_of(episode: Episode) -> list[Camera]:
    """The cameras with pictures of an episode."""
    recording = episode.recording
    found = [Camera(name, recording.frames(episode.position, name).steps) for name in recording.cameras]
    found += [Camera(leaf.path, np.arange(len(episode)), leaf) for leaf in recording.layout.images]
    return [camera for camera in found if len(camera.steps)]


def picture_at(episode: Episode, cameras: Sequence[Camera], camera: int, place: int) -> tuple[bytes, str]:
    """The bytes and the media type of a picture: a frame as it was recorded, an image as PNG. NotFoundError if there is
    none, MissingExtraError for an image without Pillow."""
    if not (0 <= camera < len(cameras) and 0 <= place < len(cameras[camera].steps)):
        raise NotFoundError("there is no such picture")
    chosen = cameras[camera]
    if chosen.leaf is None:
        data = bytes(episode.recording.frames(episode.position, chosen.name).encoded(place).data)
        form = format_of(data)
        if form is None:
            raise NotFoundError("this frame cannot be shown: expected PNG or JPEG, found other bytes")
        return data, f"image/{form}"
    value = chosen.leaf.get(episode[place : place + 1].states)[0]
    return encode_pixels(as_picture(value, chosen.leaf)), "image/png"
