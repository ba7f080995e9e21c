"""Finds the leaves of an environment's state that are stacks of frames, so that each frame is stored once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym

from tupli_mcap.messages.images.pictures import ImageFormat
from tupli_mcap.messages.step import Stack, StepLayout, can_stack, stack_of
from tupli_mcap.spaces.leaves import Leaf

# Attributes of FrameStackObservation, and of Gymnasium's older FrameStack.
_SIZES = ("stack_size", "num_stack")


def with_stacks(env: Any, spaces: StepLayout, stack_size: int | None = None) -> StepLayout:
    """`spaces` with its stacks: leaves whose first axis, or else the last one, has the length `stack_size`, or the
    length in the attribute `stack_size` or `num_stack` of a wrapper around `env`.

    If a wrapper further out changes the frames, they are stored exactly all the same.
    """
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
