"""The topic scheme: builds the topics of a recording, and parses them.

A recording of a single environment has `/step`, `/image/<leaf>`, `/camera/<name>` and `/frame/<name>`; one of several
has those of each below `/env_<i>`. The topics of episodes and infos are those of all sub-environments.
"""

from __future__ import annotations

import re
from typing import NamedTuple

EPISODE_START = "/episode_start"
EPISODE_END = "/episode_end"
FINAL_STATE = "/final_state"
INFO = "/info"

_TOPIC = re.compile("((?:/env_(0|[1-9][0-9]*))?)/(?:(step)|(image|camera|frame)/(.+))", re.DOTALL)


class Topics(NamedTuple):
    """The topics of one environment: `top` is what all of them begin with, empty in a recording of a single one."""

    top: str

    @classmethod
    def of(cls, env: int | None) -> Topics:
        """`env` is the sub-environment of a vector recording, None in one of a single environment."""
        return cls("" if env is None else f"/env_{env}")

    @classmethod
    def of_step(cls, step: str) -> Topics:
        """Those of the environment whose steps have the topic `step`."""
        return cls(step.removesuffix("/step"))

    @property
    def is_vector(self) -> bool:
        """Whether they are those of a sub-environment."""
        return bool(self.top)

    @property
    def step(self) -> str:
        return f"{self.top}/step"

    def image(self, leaf: str) -> str:
        """Where the images of a leaf of the observations are."""
        return f"{self.top}/image/{leaf}"

    def camera(self, name: str) -> str:
        """Where the frames of a camera are."""
        return f"{self.top}/camera/{name}"

    def frame(self, name: str) -> str:
        """Which state of which episode the row of the same number in `camera` shows."""
        return f"{self.top}/frame/{name}"


class Topic(NamedTuple):
    """What a topic says: `kind` is "step", "image", "camera" or "frame", `name` that of a leaf or a camera."""

    topics: Topics
    env: int
    kind: str
    name: str


def parse(topic: str) -> Topic | None:
    """None for a topic that belongs to no single environment, or is not of a recording."""
    match = _TOPIC.fullmatch(topic)
    if match is None:
        return None
    return Topic(Topics(match[1]), int(match[2] or 0), match[3] or match[4], match[5] or "")
