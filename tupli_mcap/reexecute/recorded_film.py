"""Makes films of recorded pictures: a camera's frames, or an image in the states. Executes nothing."""

from __future__ import annotations

import base64
import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.images.pictures import Picture, resized
from tupli_mcap.recording import Episode
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.reexecute.movie import check_goal, check_pictures, film_rate, write_movie
from tupli_mcap.spaces.labels import leaves_by_name
from tupli_mcap.spaces.leaves import Leaf

_KINDS = (".mp4", ".gif")
_FPS = 30.0
_SMALL = 240  # pixels of the longer side: what is smaller can hardly be seen, and its colours blur in an MP4
_BLOCK = 256  # most states in memory at a time


def has_pictures(episode: Episode) -> bool:
    """Whether the episode has recorded frames, or an image in its states."""
    return bool(len(episode.frames) or episode.recording.layout.images)


@dataclass(frozen=True)
class Film:
    """A film; notebooks show it.

    pictures: the number of pictures. kind: ".mp4" or ".gif". path: the file; None if it is in memory only. data: the
    bytes of the file.
    """

    pictures: int
    kind: str
    path: Path | None
    data: bytes = field(repr=False)

    def _repr_html_(self) -> str:
        content = base64.b64encode(self.data).decode()
        if self.kind == ".gif":
            return f'<img style="max-width:100%" src="data:image/gif;base64,{content}">'
        source = f'<source type="video/mp4" src="data:video/mp4;base64,{content}">'
        return f'<video style="max-width:100%" controls loop muted autoplay>{source}</video>'


def film(
    episodes: Sequence[Episode],
    target: str | os.PathLike[str] | None = None,
    *,
    camera: str | None = None,
    fps: float | None = None,
    every: int = 1,
    width: int | None = None,
    overwrite: bool = False,
) -> Film:
    """Make a film of the recorded pictures of episodes, one episode after another.

    Args:
        episodes: of one recording or several.
        target: the file to write, ".mp4" (extra `video`) or ".gif" (extra `frames`); None for an MP4 in memory.
        camera: a camera, or an image in the states, such as `state.wrist` or `wrist`. By default, the camera
            "render", else the first camera, else the first image. Of a stack, the newest frame is shown.
        fps: pictures a second; by default, from the duration of a step if the recording has it, else 30 steps a
            second: fewer of frames that were not recorded at every step, and with `every`. A picture is shown for at
            most 10 minutes.
        every: only every n-th picture of an episode, and its last one.
        width: of the film (pixels). By default as recorded; small pictures become larger, by a whole number.
        overwrite: replace a file that exists.

    Raises:
        RecordingError: an episode has no such pictures, the target exists (without `overwrite`), or cannot be written.
        MissingExtraError: PyAV or Pillow is not installed.
    """
    check_pictures(every, width)
    with tempfile.TemporaryDirectory() as folder:
        goal = Path(folder) / "film.mp4" if target is None else Path(target)
        kind = check_goal(goal, _KINDS, overwrite=overwrite)
        if fps is not None and not 0 < fps <= 1000:
            raise RecordingError(f"fps: expected a number above 0, up to 1000, found {fps!r:.40}")
        if not episodes:
            raise RecordingError("expected episodes to film, found none")
        if not all(hasattr(episode, "recording") for episode in episodes):
            raise RecordingError(
                f"expected episodes to film, such as recording.episodes, found {episodes!r:.80}"
            )
        parts = [_pictures(episode, camera) for episode in episodes]
        count = sum(-(-(number - 1) // int(every)) + 1 for number, _, _ in parts)
        seconds = episodes[0].recording.labels.step_seconds
        between = max(steps for _, _, steps in parts) * every
        pictures = (
            _scaled(picture, width)
            for number, drawn, _ in parts
            for i, picture in enumerate(drawn)
            if i % every == 0 or i == number - 1
        )
        with replacing(goal, overwrite=overwrite) as (_, path):
            rate = film_rate(fps or (1 / seconds if seconds else _FPS) / between)
            write_movie(path, kind, pictures, count, rate)
        return Film(count, kind, None if target is None else goal, goal.read_bytes())


def _scaled(picture: Picture, width: int | None) -> Picture:
    """The picture as wide as wanted; a small one as large as `_SMALL`, with sharp pixels."""
    if width is not None:
        return resized(picture, width)
    times = -(-_SMALL // max(picture.shape[:2]))
    return picture.repeat(times, axis=0).repeat(times, axis=1) if times > 1 else picture


def _pictures(episode: Episode, camera: str | None) -> tuple[int, Iterator[Picture], int]:
    """How many pictures of an episode there are, the pictures, and how many steps are from one to the next."""
    recording, images = episode.recording, episode.recording.layout.images
    if camera is not None and camera not in recording.cameras:
        leaf = leaves_by_name(images).get(camera)
        if leaf is not None:
            return _of_states(episode, leaf)
        known = [*recording.cameras, *(leaf.path for leaf in images)]
        raise RecordingError(
            f"{recording.name} has no pictures {camera!r:.80}; it has {', '.join(known) or 'none'}"
        )
    frames = recording.frames(episode.position, camera)
    if len(frames):
        return len(frames), iter(frames), _steps_between(frames.steps)
    if camera is None and images:
        return _of_states(episode, images[0])
    raise RecordingError(
        f"{recording.name}: episode {episode.number} was recorded without pictures; make them with `tupli-mcap render`"
    )


def _steps_between(steps: Array) -> int:
    """The usual number of steps from one frame to the next; that to the last one may be smaller."""
    return max(1, int(np.quantile(np.diff(steps), 0.5, method="higher"))) if len(steps) > 1 else 1


def _of_states(episode: Episode, leaf: Leaf) -> tuple[int, Iterator[Picture], int]:
    """The pictures of its states, and of its final state if that is known, as recorded frames show it."""
    final = episode.final_state

    def values() -> Iterator[Array]:
        for first in range(0, len(episode), _BLOCK):
            yield from leaf.get(episode[first : first + _BLOCK].states)
        if final is not None:
            yield leaf.get(final)

    return len(episode) + (final is not None), (as_picture(value, leaf) for value in values()), 1


def as_picture(value: Array, leaf: Leaf) -> Picture:
    """An image, or the newest frame of a stack, as height x width x 3."""
    if leaf.kind == "stack":
        value = leaf.newest(value)
    if value.ndim == 2:
        value = value[:, :, None]
    if value.shape[2] == 1:
        value = np.repeat(value, 3, axis=2)
    return np.ascontiguousarray(value[:, :, :3])
