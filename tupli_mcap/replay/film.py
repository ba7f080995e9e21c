"""Rendered frames on their way to a file: encoded, in a temporary file, for an episode may have thousands."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from tupli_mcap.messages.frames import EncodedFrame
from tupli_mcap.messages.images.pictures import FrameFormat, Picture, decode_picture, encode_picture

__all__ = ["Film"]


class _Take(NamedTuple):
    """A frame in the temporary file."""

    step: int
    offset: int
    size: int


class Film:
    """Frames by episode, as `NewFrames` has them; a context manager that throws them away.

    `times` of an episode says when it was in the state of each step (ns).
    """

    def __init__(self, camera: str, form: FrameFormat) -> None:
        self.camera = camera
        self._form: FrameFormat = form
        self._takes: dict[int, list[_Take]] = {}
        self._times: dict[int, Sequence[int]] = {}
        self._file = tempfile.TemporaryFile(prefix="tupli-mcap-")  # noqa: SIM115 - closed by close()
        self._end = 0

    def begin(self, episode: int, times: Sequence[int]) -> None:
        """Starts an episode, over again if there are frames of it."""
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
        """Frames by episode, those with none left out."""
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
        """Throws the frames away."""
        self._file.close()

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
