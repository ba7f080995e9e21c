"""A rollout that goes on, in the panels of a replay: what `RecordEpisodes(live="rerun")` sends."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.live.follow import Follower, NewInfo, NewSteps
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.recording.description import nan_text, spread_of
from tupli_mcap.viewer.about import plain
from tupli_mcap.viewer.arrange import blueprint_of
from tupli_mcap.viewer.live_env import MOST_INFOS, LiveEnv, columns_of
from tupli_mcap.viewer.panels import PALETTE, Place
from tupli_mcap.viewer.scene import live_scene
from tupli_mcap.viewer.sending import tensor_array
from tupli_mcap.viewer.words import numbers_in

__all__ = ["LivePicture", "Sketch"]

_SAMPLE, _PATIENCE = 100, 1.0  # steps, and seconds to wait for them, before it is decided what shares an axis
_BARS = 500
_EVERY = 2.0  # seconds between two overviews
_APART = 100  # rows that a sub-environment may be behind the first on the timeline
_MOST_KEYS = 6  # of infos


class _Gathered:
    """What was seen of a rollout, and is to be sent."""

    def __init__(self) -> None:
        self.steps: list[NewSteps] = []
        self.ended: list[Array] = []
        self.infos: list[NewInfo] = []

    def look(self, follower: Follower) -> None:
        steps, ended = follower.look()
        self.steps += steps
        self.ended.append(ended)
        self.infos += follower.infos(MOST_INFOS)


class Sketch:
    """Makes the picture of a rollout once there are enough steps to see how large values get.

    title: what the rollout is called.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._gathered = _Gathered()
        self._began = 0.0

    def __call__(self, follower: Follower) -> LivePicture | None:
        """None while there are too few."""
        self._began = self._began or time.monotonic()
        gathered = self._gathered
        gathered.look(follower)
        gathered.steps = gathered.steps[-_SAMPLE:]
        found = sum(map(len, gathered.steps))
        waited = time.monotonic() - self._began
        if not found or (found < _SAMPLE and waited < _PATIENCE and not follower.is_over):
            return None
        return LivePicture(self._title, follower, gathered)


class LivePicture:
    """The steps of the first sub-environments, and the episodes of all of them."""

    def __init__(self, title: str, follower: Follower, gathered: _Gathered) -> None:
        self._title = title
        self._gathered = gathered
        self._returns: list[float] = []
        self._lengths: list[int] = []
        self._episodes = 0
        self._next_overview = 0.0
        count = len(follower.steps)
        infos = numbers_in([info.values for info in gathered.infos])[:_MOST_KEYS]
        layout, labels = follower.layout, follower.labels
        decoder = None if layout.constant else MessageDecoder(layout)
        sample = [columns_of(layout, decoder, steps.newest(_SAMPLE)) for steps in gathered.steps]
        scene = live_scene(layout, labels, sample, follower.camera, infos, apart=count > 1)
        roots = [f"/env_{i}" for i in range(count)] if count > 1 else [""]
        self._envs = [
            LiveEnv(layout, labels.step_seconds, scene, i, _place(root, i if count > 1 else None), count)
            for i, root in enumerate(roots)
        ]
        looks = hashlib.sha256(repr((layout.to_metadata(), roots, scene.looks)).encode()).hexdigest()[:6]
        self.application = f"{re.sub(r'[^0-9A-Za-z_-]+', '-', title)[:40]} live {looks}"
        self.blueprint = blueprint_of(scene, roots)

    def declare(self, stream: Any) -> None:
        """Sends what does not change."""
        for env in self._envs:
            env.on(stream)
            env.declare()
        self._next_overview = 0.0

    def send(self, stream: Any, follower: Follower) -> None:
        """Sends what is new."""
        gathered, self._gathered = self._gathered, _Gathered()
        gathered.look(follower)
        self._align(gathered.steps)
        for new in gathered.steps:
            self._envs[new.env].send(follower, new)
        for env in self._envs:
            env.send_frames(follower)
        self._envs[0].send_infos(gathered.infos)
        for ended in gathered.ended:
            self._returns = [*self._returns, *ended["return"].tolist()][-_BARS:]
            self._lengths = [*self._lengths, *ended["length"].tolist()][-_BARS:]
        self._episodes = follower.episodes
        if time.monotonic() >= self._next_overview or follower.is_over:
            self._send_overview(stream, "recorded" if follower.is_over else "being recorded")
            self._next_overview = time.monotonic() + _EVERY

    def _align(self, steps: Sequence[NewSteps]) -> None:
        """Keeps what happens at one time at about one place of the timeline."""
        for new in steps:
            self._envs[new.env].expect(new)
        end = max(env.end for env in self._envs)
        for env in self._envs:
            if end - env.end > _APART:
                env.catch_up(end)

    def _send_overview(self, stream: Any, state: str) -> None:
        import rerun as rr

        lines = [f"### {plain(self._title)}", "", state, ""]
        if self._episodes:
            spread = spread_of(np.array(self._returns))
            if spread is not None:
                odd = nan_text(spread.nan, len(self._returns))
                told = f"mean return {spread.mean:.4g}{f' ({odd})' if odd else ''}"
                told = f"return {odd}" if spread.nan == len(self._returns) else told
                lines.append(f"{self._episodes:,} episodes; the last {len(self._returns):,}: {told}")
            for name, values in (("return", self._returns), ("length", self._lengths)):
                finite = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
                stream.log(f"/overview/{name}", rr.BarChart(tensor_array([finite], ["episode"])), static=True)
        document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
        stream.log("/card", document, static=True)


def _place(root: str, env: int | None) -> Place:
    if env is None:
        return Place(None)
    return Place(None, root, f"env {env}", PALETTE[env % len(PALETTE)])
