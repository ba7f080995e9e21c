"""Numbers out of what is known of episodes: what they are drawn by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.dataset.items import SamplingError
from tupli_mcap.errors import FilterError
from tupli_mcap.schema import BaseFilter, EpisodeHeader, F, compile_predicate, split_key
from tupli_mcap.schema.predicate import MISSING, look_up

__all__ = ["episode_values"]


def episode_values(headers: Sequence[EpisodeHeader], expression: F | BaseFilter) -> np.ndarray[Any, Any]:
    """The number that each episode has at a key, `F("metadata.score")` for example; of a filter, 1 where it is true.

    Raises:
        SamplingError: an episode has no number there, or it is no expression.
        FilterError: the expression names an unknown field.
    """
    if isinstance(expression, BaseFilter):
        matches = compile_predicate(expression, EpisodeHeader)
        return np.array([float(matches(header)) for header in headers])
    if not isinstance(expression, F):
        raise SamplingError(f"expected an expression, such as F('metadata.score'), found {expression!r:.80}")
    path = split_key(expression.key)
    if path[0] not in EpisodeHeader.model_fields:
        known = ", ".join(sorted(EpisodeHeader.model_fields))
        raise FilterError(f"unknown key {expression.key!r}; the keys are {known}")
    return np.array([_number(look_up(header, path), header, expression) for header in headers])


def _number(value: object, header: EpisodeHeader, expression: F) -> float:
    if not isinstance(value, int | float):
        found = "nothing" if value is MISSING else f"{value!r:.80}"
        raise SamplingError(
            f"expected a number as {expression.key} of every episode, found {found} for {header.id}; "
            "leave such episodes out with with_episode_filter(...)"
        )
    return float(value)
