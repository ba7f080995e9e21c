"""Shows a running rollout in the panels of a replay."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.errors import plural
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.recording.describe.description import nan_text, spread_of
from tupli_mcap.viewer.blueprints import blueprint_of
from tupli_mcap.viewer.live.follow import Follower
from tupli_mcap.viewer.live.new_rows import NewInfo, NewSteps
from tupli_mcap.viewer.live.rerun_env import MOST_INFOS, LiveEnv, columns_of
from tupli_mcap.viewer.names import plain
from tupli_mcap.viewer.panels import PALETTE, Root, number_keys
from tupli_mcap.viewer.scene import live_scene
from tupli_mcap.viewer.sdk import rr
from tupli_mcap.viewer.sending import tensor_array

_SAMPLE = 100  # steps that are looked at to decide which panels there are, and which dimensions share an axis
_PATIENCE = 1.0  # seconds to wait for so many
_BARS = 500
_EVERY = 2.0  # seconds between two overviews
_APART = 100  # rows that a sub-environment may be behind the first on the timeline
_MOST_KEYS = 6  # of infos


class LivePanels:
    """The steps of the first sub-environments, and an overview of the episodes of all of them.

    `application` and `blueprint` exist once `decide` has returned True.
    """

    application: str
    blueprint: Any

    def __init__(self, title: str) -> None:
        self._title = title
        self._steps: list[NewSteps] = []  # seen, and not sent yet; the same for infos
        self._infos: list[NewInfo] = []
        self._returns: list[float] = []
        self._successes: list[bool] = []
        self._lengths: list[int] = []
        self._began = 0.0
        self._next_overview = 0.0
        self._envs: list[LiveEnv] = []

    def decide(self, follower: Follower) -> bool:
        """Chooses the panels once there are enough steps to see how large values get; until then, returns False."""
        if self._envs:
            return True
        self._began = self._began or time.monotonic()
        self._look(follower)
        self._steps = self._steps[-_SAMPLE:]
        count = sum(map(len, self._steps))
        waited = time.monotonic() - self._began
        if not count or (count < _SAMPLE and waited < _PATIENCE and not follower.is_over):
            return False
        self._draw(follower)
        return True

    def _look(self, follower: Follower) -> None:
        steps, ended = follower.look()
        self._steps += steps
        self._infos += follower.infos(MOST_INFOS)
        self._returns = [*self._returns, *ended["return"].tolist()][-_BARS:]
        self._successes = [*self._successes, *follower.successes][-_BARS:]
        self._lengths = [*self._lengths, *ended["length"].tolist()][-_BARS:]

    def _draw(self, follower: Follower) -> None:
        count, layout, labels = len(follower.steps), follower.layout, follower.labels
        keys = number_keys([info.values for info in self._infos])[:_MOST_KEYS]
        decoder = None if layout.constant else MessageDecoder(layout)
        sample = [columns_of(layout, decoder, steps.newest(_SAMPLE)) for steps in self._steps]
        scene = live_scene(layout, labels, sample, follower.camera, keys, apart=count > 1)
        places = [Root(None)]
        if count > 1:
            places = [Root(None, f"/env_{i}", f"env {i}", PALETTE[i % len(PALETTE)]) for i in range(count)]
        roots = [place.root for place in places]
        self._envs = [
            LiveEnv(layout, labels.step_seconds, scene, i, place, count) for i, place in enumerate(places)
        ]
        looks = hashlib.sha256(repr((layout.to_metadata(), roots, scene.looks)).encode()).hexdigest()[:6]
        self.application = f"{re.sub(r'[^0-9A-Za-z_-]+', '-', self._title)[:40]} live {looks}"
        self.blueprint = blueprint_of(scene, roots)

    def declare(self, stream: Any) -> None:
        """Sends what does not change; again for every new connection."""
        for env in self._envs:
            env.on(stream)
            env.declare()
        self._next_overview = 0.0

    def send(self, stream: Any, follower: Follower) -> None:
        self._look(follower)
        steps, self._steps, infos, self._infos = self._steps, [], self._infos, []
        self._align(steps)
        for new in steps:
            self._envs[new.env].send(follower, new)
        for env in self._envs:
            env.send_frames(follower)
        self._envs[0].send_infos(infos)
        if time.monotonic() >= self._next_overview or follower.is_over:
            self._send_overview(stream, follower)
            self._next_overview = time.monotonic() + _EVERY

    def _align(self, steps: Sequence[NewSteps]) -> None:
        """Shifts sub-environments so that rows of the same time are near each other on the timeline."""
        for new in steps:
            self._envs[new.env].expect(new)
        end = max(env.end for env in self._envs)
        for env in self._envs:
            if end - env.end > _APART:
                env.catch_up(end)

    def _send_overview(self, stream: Any, follower: Follower) -> None:
        state = "recorded" if follower.is_over else "being recorded"
        lines = [f"### {plain(self._title)}", "", state, ""]
        if follower.episodes:
            spread = spread_of(np.array(self._returns))
            if spread is not None:
                odd = nan_text(spread.nan, len(self._returns))
                text = f"mean return {spread.mean:.4g}{f' ({odd})' if odd else ''}"
                text = f"return {odd}" if spread.nan == len(self._returns) else text
                lines.append(
                    f"{plural(follower.episodes, 'episode')}; the last {len(self._returns):,}: {text}"
                )
            if self._successes:
                share = f"{np.mean(self._successes):.0%} of the last {len(self._successes):,} that say it"
                lines += ["", f"success {share}"]
            for name, values in (("return", self._returns), ("length", self._lengths)):
                finite = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
                stream.log(f"/overview/{name}", rr.BarChart(tensor_array([finite], ["episode"])), static=True)
        document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
        stream.log("/card", document, static=True)
