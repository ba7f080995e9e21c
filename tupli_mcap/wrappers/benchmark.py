"""What a plain recording says of its environment: `benchmark.json`, and the pickle where a spec is not enough."""

from __future__ import annotations

import contextlib
from typing import Any

import gymnasium as gym

from tupli_mcap import trust
from tupli_mcap.environment import capture, reasons_for_distrust
from tupli_mcap.errors import TupliError

__all__ = ["benchmark_attachments", "vector_benchmark_attachments"]

_MAX_PICKLE = 16 << 20


def benchmark_attachments(env: gym.Env[Any, Any]) -> dict[str, tuple[str, bytes]]:
    """The environment as attachments; empty if it cannot be captured, or only as a pickle of more than 16 MiB.

    What others would have to trust is signed as this user's own, so that it can be rebuilt here without a question.
    """
    try:
        record = capture(env)
    except TupliError:
        return {}
    attachments = {"benchmark.json": ("application/json", record.to_json())}
    if record.pickle is not None:
        if len(record.pickle) > _MAX_PICKLE:
            return {}
        attachments["env.cloudpickle"] = ("application/octet-stream", record.pickle)
    if reasons_for_distrust(record):
        with contextlib.suppress(TupliError):  # recording goes on where no signature can be kept
            trust.trust(record.digest)
    return attachments


def vector_benchmark_attachments(env: gym.vector.VectorEnv[Any, Any, Any]) -> dict[str, tuple[str, bytes]]:
    """The first sub-environment as attachments; empty where it is in another process or there is none."""
    envs = getattr(env.unwrapped, "envs", None)
    return benchmark_attachments(envs[0]) if envs and isinstance(envs[0], gym.Env) else {}
