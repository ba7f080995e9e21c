"""Seeds that environments draw by themselves."""

from __future__ import annotations

from typing import Any

import gymnasium as gym


def drawn_seed(env: gym.Env[Any, Any]) -> int | None:
    """The seed an environment drew in a reset without one; None if it does not say."""
    seed = getattr(env.unwrapped, "_np_random_seed", None)
    return seed if isinstance(seed, int) and seed >= 0 else None
