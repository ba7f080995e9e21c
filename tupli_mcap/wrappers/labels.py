"""The attachment `labels.json` of a new recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym

from tupli_mcap.environment import documented_labels
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.labels import LABELS_MEDIA_TYPE, LABELS_NAME, Labels, chosen_labels
from tupli_mcap.wrappers.benchmark import Captured


def with_labels(
    captured: Captured,
    env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any],
    spaces: StepLayout,
    given: Mapping[str, Sequence[str]] | None,
) -> dict[str, tuple[str, bytes]]:
    """What was captured, and the labels that were given or that the environment documents, if there are any."""
    attachments = captured.attachments
    if LABELS_NAME in attachments:
        return attachments
    documented = documented_labels(env) if captured.documented else Labels.none()
    labels = chosen_labels(given or {}, spaces.leaves, documented)
    if not labels:
        return attachments
    return {**attachments, LABELS_NAME: (LABELS_MEDIA_TYPE, labels.to_json())}
