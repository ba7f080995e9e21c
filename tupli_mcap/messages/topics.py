"""Builds and parses the topics of a recording.

A single environment has `/step`, `/image/<leaf>`, `/camera/<name>` and `/frame/<name>`. Each sub-environment of a
vector environment has its own below `/env_<i>`; all share the topics of episodes and infos.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

EPISODE_START = "/episode_start"
EPISODE_END = "/episode_end"
FINAL_STATE = "/final_state"
INFO = "/info"

_TOPIC = re.compile("((?:/env_(0|[1-9][0-9]*))?)/(?:(step)|(image|camera|frame)/(.+))", re.DOTALL)
_CAMERA = re.compile("[a-z](?:_?[a-z0-9]+)*")


class Topics(NamedTuple):
    """The topics of one environment, which all begin with `top`: empty in a recording of a single environment."""

    top: str

    @classmethod
    def of(cls, env: int | None) -> Topics:
        """`env` is the sub-environment of a vector recording, None in one of a single environment."""
        return cls("" if env is None else f"/env_{env}")

    @classmethod
    def of_step(cls, step: str) -> Topics:
        """The topics of the environment whose steps have the topic `step`."""
        return cls(step.removesuffix("/step"))

    @property
    def is_vector(self) -> bool:
        """Whether it is a sub-environment of a vector environment."""
        return bool(self.top)

    @property
    def step(self) -> str:
        return f"{self.top}/step"

    def image(self, leaf: str) -> str:
        """The topic of the images of a leaf of the state."""
        return f"{self.top}/image/{leaf}"

    def camera(self, name: str) -> str:
        """The topic of a camera's pictures."""
        return f"{self.top}/camera/{name}"

    def frame(self, name: str) -> str:
        """The topic that says which state of which episode each picture of a camera shows."""
        return f"{self.top}/frame/{name}"


class Topic(NamedTuple):
    """A parsed topic: `kind` is "step", "image", "camera" or "frame", `name` is that of a leaf or a camera."""

    topics: Topics
    env: int
    kind: str
    name: str


def parse(topic: str) -> Topic | None:
    """Parses a topic; None if it belongs to no single environment, or is no topic of recordings."""
    match = _TOPIC.fullmatch(topic)
    if match is None:
        return None
    return Topic(Topics(match[1]), int(match[2] or 0), match[3] or match[4], match[5] or "")


def camera_names(topics: Iterable[str]) -> tuple[str, ...]:
    """The cameras of a recording with these topics."""
    frames = [topic for topic in map(parse, topics) if topic is not None and topic.kind == "frame"]
    return tuple(sorted(topic.name for topic in frames if topic.env == 0 and _CAMERA.fullmatch(topic.name)))
