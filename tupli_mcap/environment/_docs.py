"""Names of dimensions and actions, read from a live environment's documentation, and how long its steps take."""

from __future__ import annotations

import contextlib
import math
import re
from typing import Any

import gymnasium as gym
from gymnasium import spaces
from gymnasium.envs.registration import load_env_creator

from tupli_mcap.environment._capture import first_of
from tupli_mcap.spaces.labels import Labels

_HEADING = re.compile(r"^\s*#+\s*(.*?)\s*$", re.MULTILINE)
_ROW = re.compile(r"^\s*\|\s*(\d+)\s*\|([^|\n]*)\|", re.MULTILINE)
_ITEM = re.compile(r"^\s*[-*]\s*(\d+)\s*:\s*(.+?)\s*$", re.MULTILINE)
_MARKUP = re.compile(r"[`*_]{1,2}(?=\S)(.+?)(?<=\S)[`*_]{1,2}")
_LONGEST = 60  # characters
_MOST = 10_000  # names


def documented_labels(env: gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]) -> Labels:
    """Labels from the tables and lists in an environment's documentation that number its dimensions or values.

    Gymnasium documents its environments this way: https://gymnasium.farama.org/environments/classic_control/cart_pole.
    """
    inner: Any = env.unwrapped
    classes = type(inner).__mro__  # a subclass need not repeat its base's documentation
    kind = ""
    if isinstance(env, gym.vector.VectorEnv):
        state, action = env.single_observation_space, env.single_action_space
        if (first := first_of(env)) is not None:
            inner = first.unwrapped
            classes = type(inner).__mro__
        else:  # in other processes, or all in one
            kind, classes = "single_", (*classes, *_registered(inner))
    else:
        state, action = env.observation_space, env.action_space
    texts = [cls.__doc__ or "" for cls in classes]
    labels = Labels({}, {}, _step_seconds(inner))
    for name, space, unwrapped in (
        ("state", state, getattr(inner, f"{kind}observation_space", None)),
        ("action", action, getattr(inner, f"{kind}action_space", None)),
    ):
        if not _same_dimensions(space, unwrapped):
            continue  # a wrapper has changed the space
        heading = "observation space" if name == "state" else "action space"
        section = next(filter(None, (_section(text, heading) for text in texts)), "")
        if isinstance(space, spaces.Discrete):
            names = (name == "action" and _meanings(inner, int(space.n))) or _names(section, int(space.n))
            if names:
                labels.values[name] = names
        elif isinstance(space, spaces.Box) and len(space.shape) == 1:
            names = _names(section, space.shape[0])
            if names:
                labels.dimensions[name] = names
    return labels


def _registered(envs: Any) -> tuple[type, ...]:
    """The classes of the single environment that is registered under a vector environment's id."""
    with contextlib.suppress(Exception):  # a module that cannot be imported any more, say
        made: Any = gym.spec(envs.spec.id).entry_point
        made = load_env_creator(made) if isinstance(made, str) else made
        return made.__mro__ if isinstance(made, type) else ()
    return ()


def _same_dimensions(space: Any, unwrapped: Any) -> bool:
    if isinstance(space, spaces.Discrete):
        return bool(space == unwrapped)
    return type(space) is type(unwrapped) and space.shape == unwrapped.shape


def _section(text: str, heading: str) -> str:
    """The text below the first heading that is `heading`, up to the next one."""
    headings = list(_HEADING.finditer(text))
    for i, match in enumerate(headings):
        if match.group(1).lower().startswith(heading):
            return text[match.end() : headings[i + 1].start() if i + 1 < len(headings) else len(text)]
    return ""


def _names(section: str, count: int) -> tuple[str, ...]:
    """A name for each number from 0 to count - 1; empty unless each occurs exactly once."""
    if not 0 < count <= _MOST:
        return ()
    for pattern in (_ROW, _ITEM):
        found = [(int(number), _plain(name, number)) for number, name in pattern.findall(section)]
        if [number for number, _ in found] == list(range(count)) and all(name for _, name in found):
            return tuple(name for _, name in found)
    return ()


def _meanings(env: Any, count: int) -> tuple[str, ...]:
    """The names that the Arcade Learning Environment gives its actions; empty for other environments."""
    with contextlib.suppress(Exception):  # the environment's own code may raise anything
        names = tuple(_plain(str(name), "") for name in env.get_action_meanings())
        return names if len(names) == count and all(names) else ()
    return ()


def _plain(name: str, unnamed: str) -> str:
    """A name without markup, on one line, cut to the longest length; `unnamed` for a dash."""
    plain = " ".join(_MARKUP.sub(r"\1", name).split())
    plain = "".join(c for c in plain if c.isprintable())
    plain = unnamed if plain in ("-", "–", "—") else plain
    return plain if len(plain) <= _LONGEST else f"{plain[: _LONGEST - 1]}…"


def _step_seconds(env: Any) -> float | None:
    """`dt` of MuJoCo, Pendulum and Acrobot, `tau` of CartPole, else one frame as it is rendered."""
    for name in ("dt", "tau"):
        with contextlib.suppress(Exception):  # a property may do anything
            value = getattr(env, name)
            if isinstance(value, int | float) and 0 < value < math.inf:
                return float(value)
    with contextlib.suppress(Exception):
        fps = env.metadata["render_fps"]
        if isinstance(fps, int | float) and 0 < fps < math.inf:
            return 1 / float(fps)
    return None
