"""Which leaves of an environment's state are frames of a sliding window, so that each frame is stored once."""

from __future__ import annotations

from typing import Any

import gymnasium as gym

from tupli_mcap.messages.step import StepLayout, can_stack
from tupli_mcap.recording.pictures import ImageFormat

__all__ = ["format_version", "with_stacks"]


def with_stacks(env: Any, spaces: StepLayout) -> StepLayout:
    """`spaces`, with the leaves that a `FrameStackObservation` around `env` stacks.

    A wrapper outside of it may change what it gives: then, too, what is stored is what the environment returned.
    """
    sizes = set()
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.FrameStackObservation):
            sizes.add(env.stack_size)
        env = env.env
    stacks = [leaf.name for leaf in spaces.state if can_stack(leaf) and leaf.shape[0] in sizes]
    if not stacks:
        return spaces
    return StepLayout(spaces.observation_space, spaces.action_space, spaces.reward_space, stacks=stacks)


def format_version(spaces: StepLayout, images: ImageFormat) -> str:
    """The least version of the format that has what these spaces need."""
    return "2" if spaces.stacks or (images != "raw" and spaces.images) else "1"
