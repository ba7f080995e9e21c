"""The attachment `labels.json` of a new recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym

from tupli_mcap.environment import documented_labels
from tupli_mcap.messages.labels import LABELS_MEDIA_TYPE, LABELS_NAME, chosen_labels
from tupli_mcap.messages.step import StepLayout

__all__ = ["with_labels"]


def with_labels(
    attachments: Mapping[str, tuple[str, bytes]],
    env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    spaces: StepLayout,
    given: Mapping[str, Sequence[str]] | None,
) -> dict[str, tuple[str, bytes]]:
    """The attachments, and the labels that were given or that the environment documents, if there are any."""
    if LABELS_NAME in attachments:
        return dict(attachments)
    labels = chosen_labels(given or {}, spaces.leaves, documented_labels(env))
    if not labels:
        return dict(attachments)
    return {**attachments, LABELS_NAME: (LABELS_MEDIA_TYPE, labels.to_json())}
