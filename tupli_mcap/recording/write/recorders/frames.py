"""Frames while a recording is written: which states are rendered, and where their pictures go."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.frames import EncodedFrame, encode_frame, encode_pair
from tupli_mcap.messages.images.pictures import check_picture, encode_picture
from tupli_mcap.recording.write.options import CAMERA, RecordOptions
from tupli_mcap.recording.write.recorders.vector import VectorRecorder
from tupli_mcap.recording.write.writer import RecordingWriter

Ask = Callable[..., Any]


class FrameRecorder:
    """Records the frames of one camera: of an episode's first state, of the state after every `every`-th step, and of
    the last state if the episode ends by a flag. Of a vector environment, `render()` gives one a sub-environment.

    A frame is in the journal, or in the file, when `step` returns. `options` have the `every` and the format of frames;
    `ask` calls what renders (`Work.ask`).
    """

    def __init__(self, writer: RecordingWriter, num_envs: int, options: RecordOptions, ask: Ask) -> None:
        self._writer = writer
        self._ask = ask
        self._every, self._form = options.every, options.frame_format
        # of the state the next episode starts at: it has no number before its first step
        self._first: list[EncodedFrame | None] = [None] * num_envs

    def start(self, env: int, render: Callable[[], Any]) -> None:
        """The picture of a reset's state; it is recorded if a step follows."""
        self._first[env] = self._ask(self._rendered, render)

    def go_on(self, writer: RecordingWriter) -> None:
        """Continues in another file."""
        self._writer = writer

    def forget(self, env: int) -> None:
        """Forgets the pending picture after a reset that failed: the state is unknown."""
        self._first[env] = None

    def step(self, env: int, episode: int, step: int, ended: bool, render: Callable[[], Any] | None) -> None:
        """After `step` steps of an episode; `render` is called if their frame is wanted; None where the environment
        has been reset since.

        RecordingError if what is rendered is no picture.
        """
        first, self._first[env] = self._first[env], None
        if first is not None:
            _put_frame(self._writer, env, episode, 0, first)
        if render is None or (not ended and step % self._every):
            return
        frame = self._ask(self._rendered, render)
        _put_frame(self._writer, env, episode, step, frame)
        if ended:  # where no reset follows, the next episode starts here
            self._first[env] = frame

    def _rendered(self, render: Callable[[], Any]) -> EncodedFrame:
        picture, now = render(), time.time_ns()
        return EncodedFrame(now, self._form, encode_picture(check_picture(picture, "frames"), self._form))

    # ---- of a vector environment

    def start_batch(self, chosen: Array, render: Callable[[], Any]) -> None:
        """After a reset of the `chosen` sub-environments (bool)."""
        pictures = self._ask(self._all_rendered, render)
        for i in np.flatnonzero(chosen).tolist():
            self.start(i, partial(pictures.__getitem__, i))

    def step_batch(
        self,
        recorder: VectorRecorder,
        stepped: Array,
        ended: Array,
        render: Callable[[], Any],
        *,
        same_step: bool,
    ) -> None:
        """After a batch, before its ends are recorded. A sub-environment that took no step was reset; with `same_step`,
        one that ended was too, so that its final state has no frame.

        RecordingError if what is rendered are no pictures.
        """
        once = cache(lambda: self._all_rendered(render))

        def picture(i: int) -> Any:
            return once()[i]

        for i in range(len(self._first)):
            reset = not stepped[i] or (same_step and bool(ended[i]))
            if stepped[i]:
                number, step = recorder.running(i)
                self.step(i, number, step, bool(ended[i]), None if reset else partial(picture, i))
            if reset:
                self.start(i, partial(picture, i))

    def _all_rendered(self, render: Callable[[], Any]) -> Sequence[Any]:
        found, n = render(), len(self._first)
        if not isinstance(found, list | tuple | np.ndarray) or len(found) != n:
            raise RecordingError(
                f"frames: expected render() to return a picture for each of {n} sub-environments, "
                f"found {type(found).__name__}{f' of {len(found)}' if hasattr(found, '__len__') else ''}"
            )
        return list(found)


def _put_frame(writer: RecordingWriter, env: int, episode: int, step: int, frame: EncodedFrame) -> None:
    """Records the frame of a step; its time is not before that of the last frame."""
    camera, pairs = writer.channels.cameras[env]
    log = writer.frames[env]
    frame = frame._replace(time_ns=max(frame.time_ns, log.latest_ns))
    log.append(frame.time_ns, (pairs, encode_pair(episode, step)), (camera, encode_frame(CAMERA, frame)))
