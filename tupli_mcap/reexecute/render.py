"""`render`: makes frames for a recording that has none, by running its episodes again and comparing each step."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import gymnasium as gym

from tupli_mcap import files
from tupli_mcap.dataset.which import candidates
from tupli_mcap.errors import RecordingError, TupliError, UntrustedError, brief
from tupli_mcap.messages.images.pictures import FrameFormat, check_format, check_picture, resized
from tupli_mcap.recording import Episode, Recording, rewrite_recording
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.index import chosen_numbers
from tupli_mcap.recording.signature_file import SIGNATURE_NAME
from tupli_mcap.recording.write.options import CAMERA, RENDER_MODE
from tupli_mcap.reexecute.attempt import Watch
from tupli_mcap.reexecute.certificate import Divergence, SkipKind, Skipped
from tupli_mcap.reexecute.certify import Certifier
from tupli_mcap.reexecute.movie import RenderedFrames, check_goal, check_pictures, film_rate, write_movie
from tupli_mcap.reexecute.reapply import Reexecutor
from tupli_mcap.reexecute.starts import EpisodePlan

_KINDS: Final = (".mcap", ".mp4", ".gif")
_FPS: Final = 30.0  # if neither the recording nor the environment has the duration of a step


class RenderedEpisode(NamedTuple):
    """The number of frames of an episode of `steps` steps; `whole`: it was run to its end, and agreed at every step."""

    episode: int
    steps: int
    frames: int
    whole: bool


class RenderReport(NamedTuple):
    """The result of rendering.

    path: the new file; None if nothing was rendered: then no file is written.
    episodes: the chosen episodes that were begun, in their order.
    divergence: the first difference from the recording, at which rendering stopped; None if there is none.
    skipped: episodes that cannot be run again.
    fps: frames a second of environment time, or the nearest number that films hold.
    width, height: size of the frames (pixels); 0 without frames.
    signature_left_out: whether the recording has a signature that the new file lacks.
    seconds: how long it took.
    """

    path: Path | None
    episodes: tuple[RenderedEpisode, ...]
    divergence: Divergence | None
    skipped: tuple[Skipped, ...]
    fps: float
    width: int
    height: int
    signature_left_out: bool
    seconds: float

    @property
    def frames(self) -> int:
        """The number of all frames."""
        return sum(episode.frames for episode in self.episodes)

    @property
    def ok(self) -> bool:
        """Whether all chosen episodes were rendered."""
        return self.divergence is None and not self.skipped


def render(
    recording: Recording | str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    episodes: Sequence[int | Episode] | None = None,
    every: int = 1,
    width: int | None = None,
    frame_format: FrameFormat = "png",
    trust: bool = False,
    env: gym.Env[Any, Any] | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> RenderReport:
    """Rebuild the environment with render_mode="rgb_array", run episodes again, and write the frames that it renders.

    Every step is compared with the recording: states, rewards and flags, bit for bit. Rendering stops at the first
    difference, and the frames before it are written. So frames never show another episode than the recorded one.

    Args:
        recording: an open recording, or what `Recording` opens.
        target: a new file. ".mcap": the recording with the frames as `/camera/render` (those it already has of the
            rendered episodes are replaced; a signature is left out); ".mp4" or ".gif": the frames one after another.
        episodes: numbers, or episodes of `recording`; all by default.
        every: render every n-th step, and the last one.
        width: width of the frames (pixels); by default, as the environment renders them.
        frame_format: format of the frames in a ".mcap".
        trust: rebuild the environment even if that runs code from the file, and reset it with any options.
        env: an environment, made with render_mode="rgb_array", to use instead of the one in the file; it is not closed.
        overwrite: whether an existing target is replaced.
        progress: called with the number of steps done.

    Raises:
        UntrustedError: rebuilding the environment would run code that this user does not trust; nothing was run.
        RecordingError: the recording has no environment, or one that cannot render; there is no such episode; the
            target exists or cannot be written. A target is written as a whole, or not at all.
        MissingExtraError: Pillow (`frames`), or PyAV for ".mp4" (`video`), is not installed.
    """
    if not isinstance(recording, Recording):
        with Recording(recording) as opened:
            return render(
                opened, target, episodes=episodes, every=every, width=width, frame_format=frame_format, trust=trust,
                env=env, overwrite=overwrite, progress=progress,
            )  # fmt: skip
    began = time.perf_counter()
    goal = Path(target)
    kind = _check_target(recording, goal, overwrite=overwrite)
    check_pictures(every, width)
    chosen = _numbers(recording, episodes)
    form = check_format(frame_format if kind == ".mcap" else "png")
    with contextlib.closing(RenderedFrames(CAMERA, form)) as frames:
        renderer = _Renderer(recording, trust, chosen, env, progress, frames, every, width)
        skipped = renderer.run().skipped
        order = [number for number in chosen if number in frames.counts]
        if order:
            _write(recording, goal, kind, frames, order, renderer.fps, overwrite=overwrite)
        return renderer.report(goal if order else None, chosen, skipped, time.perf_counter() - began)


def _check_target(recording: Recording, goal: Path, *, overwrite: bool) -> str:
    if files.is_same(goal, recording.path):
        raise RecordingError(f"{goal} is the recording itself, which is never overwritten; give another name")
    kind = check_goal(goal, _KINDS, overwrite=overwrite)
    if not goal.absolute().parent.is_dir():
        raise RecordingError(f"{goal}: there is no directory {goal.parent}; make it first")
    return kind


def _numbers(recording: Recording, episodes: Sequence[int | Episode] | None) -> list[int]:
    known = recording.index[candidates(recording)]
    if not len(known):
        raise RecordingError(f"{recording.name} has no episodes to render")
    given: Any = episodes
    if isinstance(episodes, Iterable):
        given = [item.number if isinstance(item, Episode) else item for item in episodes]
    return chosen_numbers(known, given, recording.name)


def _write(
    recording: Recording,
    goal: Path,
    kind: str,
    frames: RenderedFrames,
    order: list[int],
    fps: float,
    *,
    overwrite: bool,
) -> None:
    if kind == ".mcap":
        known = recording.index["episode"][candidates(recording)].tolist()
        kept = None if len(known) == len(recording) else known
        rewrite_recording(recording, goal, episodes=kept, frames=frames, overwrite=overwrite)
        return
    with replacing(goal, overwrite=overwrite) as (_, temporary):
        count = sum(frames.counts[number] for number in order)
        write_movie(temporary, kind, frames.pictures(order), count, fps)


class _Renderer(Certifier):
    """Renders the chosen episodes while they run, up to the first difference."""

    def __init__(
        self,
        recording: Recording,
        trust: bool,
        chosen: list[int],
        env: gym.Env[Any, Any] | None,
        progress: Callable[[int], None] | None,
        frames: RenderedFrames,
        every: int,
        width: int | None,
    ) -> None:
        super().__init__(recording, trust, frozenset(chosen), env, progress)
        self._frames = frames
        self._every = every
        self._width = width
        self._fps: float | None = None
        self.size = (0, 0)
        self.divergence: Divergence | None = None
        # of an episode that is run only because chosen ones continue it
        self._earlier: Divergence | None = None

    @property
    def fps(self) -> float:
        """Frames a second of environment time, or the nearest number that films hold."""
        return film_rate((self._fps or _FPS) / self._every)

    def report(
        self, path: Path | None, chosen: list[int], skipped: Sequence[Skipped], seconds: float
    ) -> RenderReport:
        """The result of rendering into the file at `path`."""
        index, counts = self._recording.index, self._frames.counts
        ran = {int(index["episode"][p]) for p, outcome in self._outcomes.items() if outcome is None}
        agreed = ran & self._chosen
        lengths = dict(zip(index["episode"].tolist(), index["length"].tolist(), strict=True))
        episodes = tuple(
            RenderedEpisode(number, lengths[number], counts.get(number, 0), number in agreed)
            for number in chosen
            if number in counts or number in agreed
        )
        height, width = self.size
        return RenderReport(
            path=path,
            episodes=episodes,
            divergence=self.divergence,
            skipped=tuple(skipped),
            fps=self.fps,
            width=width,
            height=height,
            signature_left_out=path is not None
            and path.suffix.lower() == ".mcap"
            and SIGNATURE_NAME in self._recording.attachments,
            seconds=seconds,
        )

    def _make(self) -> gym.Env[Any, Any]:
        env = super()._make()
        if env.render_mode != RENDER_MODE:
            raise self._cannot_render(f"its render_mode is {env.render_mode!r:.40}")
        if self._fps is None:
            self._fps = self._steps_a_second(env)
        return env

    def _build(self) -> gym.Env[Any, Any]:
        benchmark = self._recording.benchmark
        try:
            return benchmark.make_env(trust=self._trust, render_mode=RENDER_MODE)
        except UntrustedError:
            raise
        except TupliError as err:
            try:
                benchmark.make_env(trust=self._trust).close()
            except TupliError:
                raise err from None  # it cannot be built without rendering either: the first error says why
            raise self._cannot_render(brief(err.__cause__ or err)) from err

    def _cannot_render(self, why: str) -> RecordingError:
        name = self._record.name if self._record is not None else str(self._given)
        return RecordingError(
            f"{self._recording.name}: the environment {name[:200]!r} cannot be rendered with "
            f"render_mode={RENDER_MODE!r}: {why}"
        )

    def _steps_a_second(self, env: gym.Env[Any, Any]) -> float:
        told = self._recording.labels.step_seconds
        if told:
            return 1 / told
        fps = (env.metadata or {}).get("render_fps")
        return float(fps) if isinstance(fps, int | float) and 0 < fps < 1e6 else _FPS

    def _watch(self, plan: EpisodePlan, reexecutor: Reexecutor) -> Watch | None:
        if plan.number not in self._chosen:
            return lambda step: None
        number, length = plan.number, int(self._recording.index["length"][plan.position])
        times = self._recording.read(episodes=[plan.position], fields=["times"]).times.tolist()
        self._frames.begin(number, [int(self._recording.index["start_time"][plan.position]), *times])

        def watch(step: int) -> None:
            if step % self._every == 0 or step == length:
                self._frames.add(number, step, self._picture(reexecutor.env, number, step))

        return watch

    def _picture(self, env: gym.Env[Any, Any], number: int, step: int) -> Any:
        where = f"{self._recording.name}: episode {number}, step {step}"
        try:
            rendered: Any = env.render()
        except (Exception, SystemExit) as err:  # an environment's own code
            raise self._cannot_render(
                f"at step {step} of episode {number} it fails with {brief(err)}"
            ) from err
        picture = check_picture(rendered, where)
        if self._width is not None:
            picture = resized(picture, self._width)
        self.size = (picture.shape[0], picture.shape[1])
        return picture

    def _reexecute(self, plans: list[EpisodePlan]) -> None:
        self.divergence = self._earlier = None  # a second try may agree
        super()._reexecute(plans)

    def _stops(self, plan: EpisodePlan, outcome: Divergence | SkipKind | None) -> bool:
        if plan.number not in self._chosen:
            if isinstance(outcome, Divergence) and self._earlier is None:
                self._earlier = outcome
            return False
        if isinstance(outcome, Divergence):
            self.divergence = outcome
        elif outcome == "after_divergence":  # of an episode it goes on from
            self.divergence = self._earlier
        return self.divergence is not None
