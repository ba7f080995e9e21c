"""Base classes of all recorders: options, files, rotation, closing."""

from __future__ import annotations

import functools
import inspect
import os
import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar, cast

import gymnasium as gym

from tupli_mcap.environment import name_of
from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.images.pictures import FrameFormat, ImageFormat
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Step
from tupli_mcap.recording.about.success import FlagCheck
from tupli_mcap.recording.write.options import (
    Capture,
    CaptureEnv,
    Durability,
    MetadataCallback,
    Mode,
    RecordInfo,
    RecordOptions,
    StepCallback,
    check_known,
)
from tupli_mcap.recording.write.recorders.frames import FrameRecorder
from tupli_mcap.recording.write.recorders.infos import InfoRecorder, entries_of, metadata_json
from tupli_mcap.recording.write.rotation import Rotation
from tupli_mcap.recording.write.work import BEGUN, FileRecorder, Work
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.schema import RLTuple
from tupli_mcap.wrappers.described import Captured, format_version, with_labels, with_run, with_stacks

if TYPE_CHECKING:
    from tupli_mcap.viewer.live import LiveSession

Env = TypeVar("Env")
Init = TypeVar("Init", bound=Callable[..., None])


def called_by_class(init: Init) -> Init:
    """Decorates an `__init__` that subclasses share: errors of wrong arguments name the class that was called, and say
    which option may be meant."""
    signature = inspect.signature(init)
    _, *known = signature.parameters

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **options: Any) -> None:
        called = type(self).__name__
        check_known(called, options, known)
        try:
            signature.bind(self, *args, **options)
        except TypeError as err:
            raise TypeError(f"{called}(): {err}") from None
        init(self, *args, **options)

    return cast("Init", checked)


class Recorder:
    """A recorder that writes one file, or one after another.

    Attributes:
        rotation: knows the files that were written, and when the next one begins.
    """

    rotation: Rotation
    _work: Work

    @property
    def path(self) -> Path:
        """The file that is recorded to."""
        return self.rotation.path

    @property
    def paths(self) -> list[Path]:
        """The files that were recorded to, in their order."""
        return self.rotation.paths

    def flush(self) -> None:
        """Writes everything recorded so far into chunks; the journal already protects it."""
        self._work.flush()

    def close(self) -> None:
        """Finishes the recording. Calling it twice is fine.

        Raises:
            RecordingError: the disk refuses; everything that was recorded is safe.
        """
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> Literal[False]:
        self.close()
        return False

    def __getstate__(self) -> dict[str, Any]:
        raise RecordingError(
            f"the recorder of {self.path} cannot be pickled or copied; make another recorder in the other process"
        )


class EpisodeWrapper(Recorder, Generic[Env]):
    """Manages the files that a wrapper records to; subclasses have `step` and `reset`, and are Gymnasium's wrappers.

    `_prepare` of a subclass sets `_parts`; its `_recorder_of` makes the recorder of a file.
    """

    _is_vector: ClassVar[bool]  # it wraps vector environments
    env: Any
    # what follows the rows of a step; not bound, for the wrapper must not hold itself
    _parts: Sequence[Callable[[Any, Any, Any], None]]
    _recorder: Any
    _frames: FrameRecorder | None

    @called_by_class
    def __init__(
        self,
        env: Env,
        path: str | os.PathLike[str],
        *,
        metadata_callback: MetadataCallback | None = None,
        record_info: RecordInfo = False,
        step_callback: StepCallback | None = None,
        compression: str = "zstd",
        mode: Mode = "x",
        reward_space: gym.Space[Any] | None = None,
        benchmark_id: str = "",
        capture_env: CaptureEnv = "spec",
        attachments: Mapping[str, tuple[str, bytes]] | None = None,
        labels: Mapping[str, Sequence[str]] | None = None,
        flush_seconds: float | None = None,
        journal_dir: str | os.PathLike[str] | None = None,
        chunk_size: int = 256 * 1024,
        durability: Durability = "os",
        frames: bool | int = False,
        frame_format: FrameFormat = "png",
        image_format: ImageFormat = "raw",
        stack_size: int | None = None,
        live: str | None = None,
        max_bytes: int | None = None,
        max_seconds: float | None = None,
        name: str | None = None,
        metadata: Mapping[str, Any] | None = None,
        tags: Sequence[str] = (),
        split: str = "",
        capture: Capture = "all",
        autoreset_mode: str | None = None,
    ) -> None:
        check_kind(env, vector=self._is_vector)
        super().__init__(env)  # type: ignore[call-arg]  # of Gymnasium's wrapper
        options = RecordOptions(
            metadata_callback=metadata_callback, record_info=record_info, step_callback=step_callback,
            compression=compression, mode=mode, reward_space=reward_space, benchmark_id=benchmark_id,
            capture_env=capture_env, attachments=attachments, labels=labels, flush_seconds=flush_seconds,
            journal_dir=journal_dir, chunk_size=chunk_size, durability=durability, frames=frames,
            frame_format=frame_format, image_format=image_format, stack_size=stack_size, live=live,
            max_bytes=max_bytes, max_seconds=max_seconds, name=name, metadata=metadata, tags=tags, split=split,
            capture=capture, autoreset_mode=autoreset_mode,
        )  # fmt: skip
        spaces, n = self._prepare(env, options)
        self._open(path, options, spaces, n)

    def _prepare(self, env: Env, options: RecordOptions) -> tuple[StepLayout, int | None]:
        """Returns the spaces of an environment, or of one of its sub-environments, and their number: None for a single
        environment."""
        raise NotImplementedError

    def _open(
        self,
        path: str | os.PathLike[str],
        options: RecordOptions,
        spaces: StepLayout,
        sub_environments: int | None,
    ) -> None:
        """Opens the first file, after all checks.

        Args:
            spaces: of the environment, or of one of its sub-environments.
            sub_environments: None for a single environment.
        """
        env = self.env
        options.check_rendering(getattr(env, "render_mode", None))
        self._infos = InfoRecorder(options.record_info) if options.has_infos else None
        self._check_flag = FlagCheck()
        self._step_callback = options.step_callback
        captured = Captured(env, options.capture_env, options.attachments)
        self._spaces = spaces = with_stacks(env, spaces, options.stack_size)
        spaces.to_metadata()
        environment = name_of(env)
        attachments = with_labels(captured.attachments, spaces, options.labels, captured.labels())
        attachments = with_run(attachments, options, environment)
        options = replace(options, attachments=attachments)
        name = options.name or environment
        self.rotation = Rotation(path, options, format_version(spaces, options.image_format), name)
        self._plain = options.is_plain
        self._work = work = Work()
        writer: RecordingWriter | None = None
        try:
            self._writer = writer = self.rotation.open_first()
            self._recorder = recorder = self._recorder_of(writer)
            work.recorders.append(recorder)
            captured.trust_stored(writer)
            writer.check_spaces(spaces, sub_environments or 1, vector=sub_environments is not None)
            n = sub_environments or 1
            self._frames = FrameRecorder(writer, n, options, work.ask) if options.every else None
            self._live = _live_session(writer, options.live, env)
            # must not hold the wrapper
            self._finalizer = weakref.finalize(self, _close_recordings, work, self._live)
        except BaseException:
            work.close()
            if writer is not None:
                writer.close()
            raise

    def _recorder_of(self, writer: RecordingWriter) -> FileRecorder:
        """The recorder of the episodes in a file."""
        raise NotImplementedError

    def _finish_step(self, taken: Any, result: Any) -> BaseException | None:
        """Does everything that follows a step's rows; returns an exception of a callback, after which the rest is done
        all the same.

        Args:
            taken: the action, or which sub-environments took a step, and the actions.
            result: what the environment returned.
        """
        work, refusal = self._work, None
        for part in self._parts:
            try:
                part(self, taken, result)
            except BaseException as err:
                if not work.is_whole_after(err):
                    self._writer.stop(err)
                    raise
                refusal = err if refusal is None else refusal
                work.state = BEGUN
        return refusal

    def _rotate(self, state: Any) -> None:
        """Goes on in the next file, with the environment at `state`."""
        work, before, left = self._work, self._recorder, self._writer
        writer = work.ask(self.rotation.open_next)
        recorder: Any = self._recorder_of(writer)
        work.recorders.append(recorder)
        recorder.go_on_from(before, state)
        self._writer, self._recorder = writer, recorder
        if self._live is not None:
            self._live.go_on(writer)
        if self._frames is not None:
            self._frames.go_on(writer)
        before.close()
        work.recorders.remove(before)
        work.ask(self.rotation.finished, left.path)

    def _entries(self, step: Step) -> dict[str, Any]:
        """The entries of the step callback, to record with the info of a step."""
        entries = {} if self._infos is None else self._infos.chosen(step.info)
        if self._step_callback is not None:
            entries.update(entries_of(self._step_callback(step), "step_callback: what it returns"))
        return entries

    def close(self, **kwargs: Any) -> None:
        """Finishes the recording, then closes the environment. Calling it twice is fine.

        Raises:
            RecordingError: the disk refuses; everything that was recorded is safe.
        """
        if "_finalizer" not in self.__dict__:
            return  # the constructor raised: Gymnasium 1.0 then calls close(), which would close the caller's env
        try:
            _close_recordings(self._work, self._live)
            self._finalizer.detach()
            self._when_closed()
            if self._infos is not None:
                self._infos.warn_of_unseen(self.path)
        finally:
            self.env.close(**kwargs)

    def _when_closed(self) -> None:
        """Called after the files are finished."""


def metadata_of(callback: MetadataCallback, step: Step) -> str:
    """The metadata that a callback returned, as JSON. Raises RecordingError unless it is a dict of JSON values."""
    state, action, reward, terminal, timeout, info = step
    rl_tuple = RLTuple.model_construct(
        state=state, action=action, reward=reward, info=info, terminal=terminal, timeout=timeout
    )
    return metadata_json(callback(rl_tuple) or None, "metadata_callback")


def reset_callback(callback: MetadataCallback) -> None:
    """Tells a callback that an episode begins; a plain function has no `reset`."""
    reset = getattr(callback, "reset", None)
    if reset is not None:
        reset()


def drawn_seed(env: gym.Env[Any, Any]) -> int | None:
    """The seed an environment drew by itself in a reset without one; None if it does not say."""
    seed = getattr(env.unwrapped, "_np_random_seed", None)
    return seed if isinstance(seed, int) and seed >= 0 else None


def check_kind(env: object, *, vector: bool) -> None:
    """Raises RecordingError unless an environment is Gymnasium's, and single or a vector one as expected; the latter
    must say the spaces of one sub-environment."""
    is_vector = isinstance(env, gym.vector.VectorEnv)  # EnvPool's are also a gym.Env
    if is_vector is not vector or not (vector or isinstance(env, gym.Env)):
        raise wrong_kind(env, "a vector environment" if vector else "a single environment")
    if not is_vector and _steps_several(env):
        raise wrong_kind(env, "a single environment")
    for name in ("single_observation_space", "single_action_space") if vector else ():
        if not hasattr(env, name):
            raise RecordingError(
                f"expected a vector environment with {name}, found {type(env).__name__} without; "
                "set it to the space of one sub-environment"
            )


def _steps_several(env: Any) -> bool:
    """Whether a `gymnasium.Env` has the spaces of several environments at once, as those of Isaac Lab."""
    base = env.unwrapped
    if not (hasattr(base, "num_envs") and hasattr(base, "single_observation_space")):
        return False
    return bool(base.single_observation_space != base.observation_space == env.observation_space)


def wrong_kind(env: object, expected: str) -> RecordingError:
    """The error for an object that is no environment, or is one of the other kind; it names the right recorder."""
    libraries = {cls.__module__.partition(".")[0] for cls in type(env).__mro__}
    name = type(env).__name__
    if isinstance(env, gym.vector.VectorEnv):
        found = f"the vector environment {name}; use tupli_mcap.vector.RecordEpisodes"
    elif isinstance(env, gym.Env) and _steps_several(env):
        found = (
            f"{name}, a gymnasium.Env that steps several environments at once; record its arrays with "
            "tupli_mcap.write_rollout, or make it a gymnasium.vector.VectorEnv for tupli_mcap.vector.RecordEpisodes"
        )
    elif isinstance(env, gym.Env):
        found = f"the single environment {name}; use tupli_mcap.RecordEpisodes"
    elif "stable_baselines3" in libraries:
        found = f"the VecEnv {name} of Stable-Baselines3; use tupli_mcap.sb3.VecRecordEpisodes"
    elif "pettingzoo" in libraries:
        found = (
            f"the PettingZoo environment {name}; there is no recorder of several agents yet, but "
            "tupli_mcap.EpisodeWriter(..., num_envs=AGENTS) records the steps of each agent as a stream"
        )
    elif isinstance(env, str):
        make = "make_vec" if "vector" in expected else "make"
        found = f"{env!r:.60}; make it: gymnasium.{make}({env!r:.60})"
    elif "dm_env" in libraries:
        found = f"the dm_env environment {name}; wrap it in shimmy.DmControlCompatibilityV0"
    elif callable(env):
        found = f"{name} {getattr(env, '__name__', '')}; give the environment that it makes"
    else:
        found = f"{name}, which is no gymnasium.Env"
    return RecordingError(f"expected {expected}, found {found}")


def _close_recordings(work: Work, live: LiveSession | None) -> None:
    """Finishes the files, then shows the remaining episodes in the live view."""
    try:
        work.close()
    finally:
        if live is not None:
            live.close()


def _live_session(writer: RecordingWriter, live: str | None, env: Any) -> LiveSession | None:
    """The live view of a new recording; None without `live`."""
    if live is None:
        return None
    from tupli_mcap.viewer.live import open_session

    spec = getattr(env, "spec", None)
    return open_session(writer, live, writer.path.name if spec is None else f"{spec.id} {writer.path.name}")
