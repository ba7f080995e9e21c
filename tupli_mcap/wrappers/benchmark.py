"""The attachments that describe the environment of a recording: `benchmark.json`, a pickle on request, and labels."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym

from tupli_mcap import trust
from tupli_mcap.environment import EnvironmentRecord, capture, documented_labels, note, reasons_for_distrust
from tupli_mcap.errors import RecordingError, TupliError
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.write.options import CaptureEnv
from tupli_mcap.recording.write.writer import RecordingWriter
from tupli_mcap.spaces.labels import LABELS_MEDIA_TYPE, LABELS_NAME, Labels, chosen_labels

_DOCUMENT = "benchmark.json"
_PICKLE = "env.cloudpickle"
_MAX_PICKLE = 16 << 20


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
        record = note(env) if capture_env == "spec" else capture(_single(env), pickled=True)
        self.attachments[_DOCUMENT] = ("application/json", record.to_json())
        if record.pickle is not None or _is_plugin(record):
            self._digest, self._began = record.digest, time.time_ns()
        if record.pickle is None:
            return
        if len(record.pickle) > _MAX_PICKLE:
            raise RecordingError(
                f"capture_env='pickle': expected at most {_MAX_PICKLE} bytes in a recording, found an environment of "
                f"{len(record.pickle)}; use capture_env='spec', or TupliEnvWrapper, whose storage keeps it once"
            )
        self.attachments[_PICKLE] = ("application/octet-stream", record.pickle)

    def with_labels(
        self, spaces: StepLayout, given: Mapping[str, Sequence[str]] | None
    ) -> dict[str, tuple[str, bytes]]:
        """The captured attachments, and the labels that were given or that the environment documents, if any."""
        if LABELS_NAME in self.attachments:
            return self.attachments
        documented = documented_labels(self._env) if self._documented else Labels.none()
        return with_labels(self.attachments, spaces, given, documented)

    def trust_stored(self, writer: RecordingWriter) -> None:
        """Signs an environment that the writer has just stored as this user's own, to be rebuilt without a question.

        A recording that is appended to keeps its own environment.
        """
        carried = [one for one in writer.container.attachment_indexes if one.name == _DOCUMENT]
        is_new = _DOCUMENT in writer.arriving or any(one.create_time >= self._began for one in carried)
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
    """The attachments, and the labels that were given or are documented, if any."""
    labels = chosen_labels(given or {}, spaces.leaves, documented)
    return {**attachments, **({LABELS_NAME: (LABELS_MEDIA_TYPE, labels.to_json())} if labels else {})}


def _is_plugin(record: EnvironmentRecord) -> bool:
    """Whether a spec needs no trust here, but would where nobody has imported the package that registers its id."""
    spec = record.spec
    is_own = spec is None or str(spec.get("entry_point")).startswith("gymnasium.")
    return not is_own and not reasons_for_distrust(record)


def _single(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> gym.Env[Any, Any]:
    """The environment, or the first sub-environment of several."""
    if not isinstance(env, gym.vector.VectorEnv):
        return env
    envs = getattr(env.unwrapped, "envs", None)
    if envs and isinstance(envs[0], gym.Env):
        first: gym.Env[Any, Any] = envs[0]
        return first
    raise RecordingError(
        "capture_env='pickle': expected sub-environments in this process, found none in "
        f"{type(env.unwrapped).__name__}; make it with vectorization_mode='sync', or use capture_env='spec'"
    )
