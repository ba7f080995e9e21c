"""What a recorder notes before the first step: environment, labels and run as attachments, and stacks of frames.

The environment is described by `benchmark.json`, and by a pickle on request; `run.json` has the user's words about the
run, and facts about this process.
"""

from __future__ import annotations

import contextlib
import os
import site
import subprocess
import sys
import sysconfig
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import gymnasium as gym
import numpy as np

from tupli_mcap import trust
from tupli_mcap.environment import (
    DOCUMENT_NAME,
    MAX_PICKLE,
    PICKLE_NAME,
    EnvironmentRecord,
    capture,
    documented_labels,
    first_of,
    note,
    reasons_for_distrust,
    versions_of,
)
from tupli_mcap.errors import RecordingError, TupliError
from tupli_mcap.messages.images.pictures import ImageFormat
from tupli_mcap.messages.step import Stack, StepLayout, can_stack, stack_of
from tupli_mcap.recording import Run
from tupli_mcap.recording.about.run import RUN_MEDIA_TYPE, RUN_NAME, RecordedRuns
from tupli_mcap.recording.write.options import CaptureEnv, RecordOptions
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.remote import shown_argument
from tupli_mcap.schema.times import iso_utc
from tupli_mcap.spaces.labels import LABELS_MEDIA_TYPE, LABELS_NAME, Labels, chosen_labels
from tupli_mcap.spaces.leaves import Leaf

_PACKAGES: Final = {  # distributions, by the module that says whether one is at work
    "tupli_mcap": "tupli-mcap", "gymnasium": "gymnasium", "numpy": "numpy", "torch": "torch", "jax": "jax",
    "tensorflow": "tensorflow", "stable_baselines3": "stable-baselines3", "d3rlpy": "d3rlpy", "torchrl": "torchrl",
    "ale_py": "ale-py", "mujoco": "mujoco",
}  # fmt: skip
_LONGEST: Final = 1000  # characters of an argument
_PATIENCE: Final = 2.0  # seconds for git
_SIZES: Final = ("stack_size", "num_stack")  # of FrameStackObservation, and of Gymnasium's older FrameStack


# ---- the environment


class Captured:
    """The environment of a recording as attachments, unless others are `given`.

    Attributes:
        attachments: name -> (media type, bytes).

    Raises:
        RecordingError: the environment cannot be pickled into at most 16 MiB.
    """

    def __init__(
        self,
        env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
        capture_env: CaptureEnv,
        given: Mapping[str, tuple[str, bytes]] | None,
    ) -> None:
        self.attachments = {} if given is None else dict(given)
        self._env, self._documented = env, capture_env is not None or given is not None
        self._digest = ""  # of an environment that the recording would carry
        self._began = 0
        if given is not None or capture_env is None:
            return
        record = note(env) if capture_env == "spec" else _pickled(_single(env))
        self.attachments[DOCUMENT_NAME] = ("application/json", record.to_json())
        if record.pickle is not None or _is_plugin(record):
            self._digest, self._began = record.digest, time.time_ns()
        if record.pickle is None:
            return
        if len(record.pickle) > MAX_PICKLE:
            raise RecordingError(
                f"capture_env='pickle': expected at most {MAX_PICKLE} bytes in a recording, found an environment of "
                f"{len(record.pickle)}; use capture_env='spec', or TupliEnvWrapper, whose storage keeps it once"
            )
        self.attachments[PICKLE_NAME] = ("application/octet-stream", record.pickle)

    def labels(self) -> Labels:
        """The labels that the environment documents; none if it is not to be described."""
        return documented_labels(self._env) if self._documented else Labels.none()

    def trust_stored(self, writer: RecordingWriter) -> None:
        """Signs an environment that the writer has just stored as this user's own, to be rebuilt without a question.

        A recording that is appended to keeps its own environment.
        """
        carried = [one for one in writer.container.attachment_indexes if one.name == DOCUMENT_NAME]
        is_new = DOCUMENT_NAME in writer.arriving or any(one.create_time >= self._began for one in carried)
        if self._digest and is_new:
            with contextlib.suppress(TupliError):  # recording goes on where no signature can be kept
                if not trust.is_trusted(self._digest):
                    trust.trust(self._digest)


def with_labels(
    attachments: Mapping[str, tuple[str, bytes]],
    spaces: StepLayout,
    given: Mapping[str, Sequence[str]] | None,
    documented: Labels,
) -> dict[str, tuple[str, bytes]]:
    """The attachments, and the labels that were given or are documented, if any. Attached labels stay as they are,
    unless others were given."""
    if LABELS_NAME in attachments and given is None:
        return dict(attachments)
    labels = chosen_labels({} if given is None else given, spaces.leaves, documented)
    if not labels:
        return dict(attachments)
    return {**attachments, LABELS_NAME: (LABELS_MEDIA_TYPE, labels.to_json(spaces.leaves))}


def _is_plugin(record: EnvironmentRecord) -> bool:
    """Whether a spec needs no trust here, but would where nobody has imported the package that registers its id."""
    spec = record.spec
    is_own = spec is None or str(spec.get("entry_point")).startswith("gymnasium.")
    return not is_own and not reasons_for_distrust(record)


def _pickled(env: gym.Env[Any, Any]) -> EnvironmentRecord:
    try:
        return capture(env, pickled=True, otherwise="use capture_env='spec'")
    except TupliError as err:
        raise RecordingError(f"capture_env='pickle': {err}") from err


def _single(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> gym.Env[Any, Any]:
    """The environment, or the first sub-environment of several."""
    if not isinstance(env, gym.vector.VectorEnv):
        return env
    if (first := first_of(env)) is not None:
        return first
    raise RecordingError(
        "capture_env='pickle': expected sub-environments in this process, found none in "
        f"{type(env.unwrapped).__name__}; make it with vectorization_mode='sync', or use capture_env='spec'"
    )


# ---- the run


def with_run(
    attachments: Mapping[str, tuple[str, bytes]], options: RecordOptions, environment: str
) -> dict[str, tuple[str, bytes]]:
    """The attachments with `run.json`; without it if the user says nothing about the run and captures nothing.
    RecordingError if a part of the run is no text, or JSON cannot hold it."""
    run = Run.given(options.name, options.metadata, options.tags, options.split)
    if RUN_NAME in attachments or (run == Run() and options.capture == "none"):
        return dict(attachments)
    run = replace(run, id=uuid.uuid4().hex, environment=environment, started=iso_utc(time.time_ns()))
    if options.capture != "none":
        loaded = frozenset(package for module, package in _PACKAGES.items() if module in sys.modules)
        run = replace(run, versions=dict(versions_of(loaded)))
    if options.capture == "all":
        command = tuple(shown_argument(argument)[:_LONGEST] for argument in sys.orig_argv[:100])
        run = replace(run, command=command, git=_git(_program_folder()), host=os.uname().nodename)
    return {**attachments, RUN_NAME: (RUN_MEDIA_TYPE, RecordedRuns([run]).to_json())}


def _program_folder() -> str:
    """The directory of the program's file; the working directory if there is no file, as in a notebook, or if it is
    installed, as `tupli-mcap` and `pytest` are: an environment may lie in a repository that is not the user's."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    installed = (sys.prefix, sys.base_prefix, site.getuserbase(), sysconfig.get_path("scripts"))
    if not file or any(Path(file).resolve().is_relative_to(Path(folder).resolve()) for folder in installed):
        try:
            return os.getcwd()  # noqa: PTH109 - a text
        except OSError:
            return ""  # it was deleted: git finds nothing there
    return str(Path(file).absolute().parent)


@lru_cache(maxsize=8)
def _git(folder: str) -> dict[str, Any]:
    """The commit of a folder, and whether files differ from it; empty if git does not know the folder."""
    # no program of the repository's configuration is run, and nothing in it is written
    ask = ["git", "-c", "core.fsmonitor=false", "-C", folder]
    environment = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}

    def answer(*arguments: str) -> str:
        done = subprocess.run(
            [*ask, *arguments], capture_output=True, check=True, timeout=_PATIENCE, env=environment, text=True
        )
        return done.stdout.strip()

    try:
        commit = answer("rev-parse", "HEAD")
        changed = answer("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return {"commit": commit, "dirty": bool(changed)}


# ---- stacks of frames


def with_stacks(env: Any, spaces: StepLayout, stack_size: int | None = None) -> StepLayout:
    """`spaces` with its stacks: leaves whose first axis, or else the last one, has the length `stack_size`, or the
    length in the attribute `stack_size` or `num_stack` of a wrapper around `env`.

    If a wrapper further out changes the frames, they are stored exactly all the same.
    """
    if stack_size is not None and (
        isinstance(stack_size, bool) or not isinstance(stack_size, int | np.integer) or stack_size < 1
    ):
        raise RecordingError(f"stack_size: expected a number of frames or None, found {stack_size!r:.80}")
    leaves = [leaf for leaf in spaces.state if any(map(can_stack, _both(leaf)))]
    sizes = (_sizes(env) if stack_size is None else {stack_size}) if leaves else set()
    stacks: list[Stack] = []
    for leaf in leaves:
        found = next((one for one in _both(leaf) if one.stored_shape[0] in sizes), None)
        if found is not None and can_stack(found):
            stacks.append(stack_of(found))
    if not stacks:
        return spaces
    return StepLayout(spaces.observation_space, spaces.action_space, spaces.reward_space, stacks=stacks)


def _both(leaf: Leaf) -> tuple[Leaf, Leaf]:
    """The leaf with its frames along the first axis, and along the last one."""
    return leaf, replace(leaf, frames_last=True)


def _sizes(env: Any) -> set[Any]:
    """The numbers of frames that the wrappers of an environment stack; empty for one in another process."""
    if isinstance(env, gym.vector.VectorEnv | gym.vector.VectorWrapper):
        base = env.unwrapped
        if type(base).__module__ == "ale_py.vector_env":  # it stacks without a wrapper, frames first
            return set((base.single_observation_space.shape or ())[:1])
        inner = getattr(base, "envs", None)
        return _sizes(inner[0]) if inner else set()
    found = set()
    while isinstance(env, gym.Wrapper):
        found |= {vars(env)[name] for name in _SIZES if isinstance(vars(env).get(name), int)}
        env = env.env
    return found


def format_version(spaces: StepLayout, images: ImageFormat) -> str:
    """The lowest format version that can hold these spaces."""
    return "2" if spaces.stacks or (images != "raw" and spaces.images) else "1"
