"""Keeps rendered frames in a temporary file, and writes pictures as MP4 (with PyAV, extra `video`) or GIF (with Pillow,
extra `frames`)."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError, missing_extra, taken
from tupli_mcap.messages.frames import EncodedFrame
from tupli_mcap.messages.images.pictures import (
    FrameFormat,
    Picture,
    decode_picture,
    encode_picture,
    pillow,
    resized,
)

_SLOWEST, _FASTEST = 1 / 600, 1e6  # pictures a second: GIF holds durations up to 655 seconds
_GIF_FPS = 50  # browsers slow faster ones down to 10 frames a second
_GIF_COLOURS = 256
_GIF_PIXELS = (1 << 16) - 1  # of the longer side
_GIF_SAMPLE = 15_000  # about so many pixels of a larger picture are sampled to choose its colours
_CODECS = ("libx264", "h264", "mpeg4")
# How PyAV turns sRGB into YUV. If a film does not say so, players take one of 720 rows or more for BT.709.
_COLOURS = {"colorspace": "smpte170m", "color_primaries": "bt709", "color_trc": "iec61966-2-1"}


class _Take(NamedTuple):
    step: int
    offset: int
    size: int


class RenderedFrames:
    """Frames by episode in a temporary file, with the methods of `NewFrames`.

    `times` of an episode are the wall clock times of its states (ns).
    """

    def __init__(self, camera: str, form: FrameFormat) -> None:
        self.camera = camera
        self._form: FrameFormat = form
        self._takes: dict[int, list[_Take]] = {}
        self._times: dict[int, Sequence[int]] = {}
        self._file = tempfile.TemporaryFile(prefix="tupli-mcap-")  # noqa: SIM115 - closed by close()
        self._end = 0

    def begin(self, episode: int, times: Sequence[int]) -> None:
        """Starts an episode, and forgets frames that it has."""
        self._takes[episode], self._times[episode] = [], times

    def add(self, episode: int, step: int, picture: Picture) -> None:
        """Appends the frame of a step."""
        data = encode_picture(picture, self._form)
        self._file.seek(self._end)
        self._file.write(data)
        self._takes[episode].append(_Take(step, self._end, len(data)))
        self._end += len(data)

    @property
    def counts(self) -> dict[int, int]:
        """The number of frames of each episode that has some."""
        return {episode: len(takes) for episode, takes in self._takes.items() if takes}

    def of(self, episode: int) -> Iterator[tuple[int, EncodedFrame]] | None:
        """(step, frame) of an episode; None if it has none."""
        return self._read(episode) if self._takes.get(episode) else None

    def _read(self, episode: int) -> Iterator[tuple[int, EncodedFrame]]:
        times = self._times[episode]
        for take in self._takes[episode]:
            self._file.seek(take.offset)
            yield take.step, EncodedFrame(times[take.step], self._form, self._file.read(take.size))

    def pictures(self, episodes: Sequence[int]) -> Iterator[Picture]:
        """The frames of episodes, one after another."""
        for episode in episodes:
            for step, frame in self._read(episode):
                yield decode_picture(frame.data, f"frame of step {step}")

    def close(self) -> None:
        self._file.close()


def check_goal(goal: Path, kinds: Sequence[str], *, overwrite: bool) -> str:
    """The kind of a file that may be made: the end of its name, in lower case.

    Raises:
        RecordingError: it is none of `kinds`, or the file exists (without `overwrite`).
        MissingExtraError: the package for films of this kind is not installed.
    """
    kind = goal.suffix.lower()
    if kind not in kinds:
        raise RecordingError(f"{goal}: expected a name that ends in {', '.join(kinds[:-1])} or {kinds[-1]}")
    if goal.exists() and not overwrite:
        raise RecordingError(taken(goal))
    if kind == ".mp4":
        _av()
    elif kind == ".gif":
        pillow()
    return kind


def check_pictures(every: int, width: int | None) -> None:
    """Raises RecordingError unless every n-th picture can be taken, and be of this width (pixels)."""
    whole = (int, np.integer)
    is_good = isinstance(every, whole) and every >= 1
    if not is_good or not (width is None or (isinstance(width, whole) and 1 <= width <= 1 << 14)):
        raise RecordingError(
            f"expected every >= 1 and a width of 1 to 16384, found {every!r:.40} and {width!r:.40}"
        )


def film_rate(fps: float) -> float:
    """The nearest number of pictures a second that films of all kinds hold: from one in 10 minutes to a million."""
    return min(max(fps, _SLOWEST), _FASTEST)


def _av() -> Any:
    try:
        import av
    except ImportError as err:
        raise missing_extra("MP4 needs PyAV", "video") from err
    return av


def write_movie(path: Path, kind: str, pictures: Iterator[Picture], count: int, fps: float) -> None:
    """Writes `count` pictures as ".mp4" or ".gif"; all get the size of the first one. RecordingError if that fails, as
    of pictures that are too large."""
    first = next(pictures)
    width, height = size = first.shape[1], first.shape[0]
    rest = (resized(picture, *size) for picture in pictures)
    failed = RecordingError(
        f"expected pictures that {kind} can hold, found {width} x {height} pixels; give another width"
    )
    if kind == ".gif":
        if max(size) > _GIF_PIXELS:
            raise failed
        _write_gif(path, first, rest, count, fps)
        return
    av = _av()
    try:
        _write_mp4(av, path, first, rest, fps)
    except av.FFmpegError as err:
        if isinstance(err, OSError):  # a full disk, say
            # as a plain one, of which the name of the file can be changed
            raise OSError(err.errno, err.strerror, str(path)) from err
        raise failed from err


def _write_mp4(av: Any, path: Path, first: Picture, rest: Iterator[Picture], fps: float) -> None:
    rate = Fraction(fps).limit_denominator(1000)
    codec = next((name for name in _CODECS if name in av.codecs_available), "")
    if not codec:
        raise RecordingError(f"this PyAV has none of the codecs {', '.join(_CODECS)}; write a .gif instead")
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=rate)
        even = _even(first)
        stream.height, stream.width = even.shape[:2]
        stream.pix_fmt = "yuv420p"  # the format that all players and browsers support
        stream.options = _COLOURS | ({"crf": "18", "movflags": "+faststart"} if codec == "libx264" else {})
        for picture in chain([first], rest):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(_even(picture)), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _even(picture: Picture) -> Picture:
    """The picture with an even height and width, since colours are stored for 2 x 2 pixels: repeats the last row or
    column."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _write_gif(path: Path, first: Picture, rest: Iterator[Picture], count: int, fps: float) -> None:
    stride = max(1, math.ceil(fps / _GIF_FPS))
    shown = np.unique([*range(0, count, stride), count - 1])  # the last picture is how the episode ends
    # GIF counts in hundredths of a second
    ends = np.round(np.append(shown[1:], count) * 100 / fps)
    durations = (np.diff(ends, prepend=0) * 10).astype(int).tolist()
    durations[-1] += 1000  # shows the end for a second before the film repeats
    images = (indexed(picture) for i, picture in enumerate(rest, 1) if i % stride == 0 or i == count - 1)
    indexed(first).save(
        path, format="GIF", save_all=True, append_images=images, duration=durations, loop=0, disposal=1
    )


def indexed(picture: Picture) -> Any:
    """A Pillow image of at most 256 colours (mode P); exact if the picture has no more colours."""
    library = pillow()
    image = library.fromarray(picture)
    counts = image.getcolors(_GIF_COLOURS)
    if counts is not None:  # Pillow's `quantize` may change them
        colours = np.array(sorted(colour for _, colour in counts), np.uint8)
        exact = library.fromarray(np.searchsorted(_codes(colours), _codes(picture)).astype(np.uint8))
        exact.putpalette(colours.tobytes())
        return exact
    apart = math.isqrt(image.width * image.height // _GIF_SAMPLE)
    if apart < 2:
        return image.quantize(_GIF_COLOURS)
    size = -(-image.width // apart), -(-image.height // apart)
    palette = image.resize(size, library.Resampling.NEAREST).quantize(_GIF_COLOURS)
    return image.quantize(palette=palette, dither=library.Dither.NONE)


def _codes(colours: Array) -> Array:
    """Each colour (the last axis) as a number of 24 bits."""
    red, green, blue = (colours[..., i].astype(np.uint32) for i in range(3))
    return red << 16 | green << 8 | blue
