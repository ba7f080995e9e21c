"""Sends one sub-environment of a running rollout to the panels of a replay."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.mcap.records import BODY, RECORD_HEADER
from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.episodes import INTERRUPTED, TERMINAL, TIMEOUT
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.blocks import Block, Piece
from tupli_mcap.viewer.live.follow import Follower
from tupli_mcap.viewer.live.new_rows import NewInfo, NewSteps
from tupli_mcap.viewer.panels import Camera, HeatMap, LiveInfos, Panel, Rewards, Root, Series, value_range
from tupli_mcap.viewer.scene import Scene
from tupli_mcap.viewer.sending import Times, send_scalars

_STEPS = 1000  # at a time, the newest, of all sub-environments together
_DECODED = 200  # the same where each message is decoded on its own
MOST_INFOS = 300
_IMAGES = 3
_MAP_STEPS = 400
_CDR = BODY - RECORD_HEADER.size
_NOTHING: Any = None  # in place of a recording: panels that ask for one are not sent blocks of a live view


class _Columns(NamedTuple):
    states: Any
    actions: Any
    rewards: Any


class _NewestMap:
    """A heat map of the newest steps, across episodes. (In a replay, each heat map is of one episode.)"""

    def __init__(self, panel: HeatMap) -> None:
        self._panel = panel
        self._values = np.empty((0, panel.leaf.size), np.float32)

    def take(self, columns: _Columns) -> None:
        values = self._panel.leaf.get(getattr(columns, self._panel.column))
        new = values.reshape(len(values), -1)[-_MAP_STEPS:].astype(np.float32)
        self._values = np.concatenate([self._values, new])[-_MAP_STEPS:]
        panel, (low, high) = self._panel, value_range(new)
        self._panel = replace(panel, low=np.minimum(panel.low, low), high=np.maximum(panel.high, high))

    def send(self, place: Root, times: Times) -> None:
        self._panel.send_map(place, self._values, times)


class LiveEnv:
    """Sends the steps of sub-environment `env`, numbered through all its episodes, to the panels of `scene` below
    `place`, which `on` gives a stream. share: how many sub-environments are shown, which share what is sent at a time.
    """

    def __init__(
        self, layout: StepLayout, seconds: float | None, scene: Scene, env: int, place: Root, share: int
    ) -> None:
        self._env = env
        self._place = place
        self._layout = layout
        self._decoder = None if layout.constant else MessageDecoder(layout)
        self._seconds = seconds
        self._most = max(1, (_STEPS if layout.constant else _DECODED) // share)
        self._images = max(1, _IMAGES // share)
        self._rows = 0  # known of
        self._shift = 0  # from the number of a row to its place on the timeline
        self._next = 0  # the number after the last one sent
        self._missed = False  # steps were left out since the last infos
        self._rewards = Rewards(layout.reward)  # one for each sub-environment: it keeps the running return
        shown = [*scene.states, *scene.actions, *scene.beside]
        # cameras, infos and heat maps are not sent with blocks of steps
        self._panels = [
            self._rewards,
            *(panel for panel in shown if not isinstance(panel, HeatMap | Camera | LiveInfos)),
        ]
        self._cameras = [panel for panel in shown if isinstance(panel, Camera)]
        self._infos = next((panel for panel in shown if isinstance(panel, LiveInfos) and not env), None)
        self._maps = [_NewestMap(panel) for panel in shown if isinstance(panel, HeatMap)]

    @property
    def _alone(self) -> Root:
        """The place of entities that only the first sub-environment has: at the top, below no root."""
        return Root(self._place.stream)

    @property
    def end(self) -> int:
        """The number after the last row that is known of."""
        return self._rows + self._shift

    def expect(self, new: NewSteps) -> None:
        """Says which steps are sent next."""
        self._rows = new.first + len(new)

    def catch_up(self, end: int) -> None:
        """Numbers rows from here on so that the last one known of is before `end`. A sub-environment with shorter
        episodes has fewer rows, since a reset makes none."""
        self._shift = max(self._shift, end - self._rows)

    def on(self, stream: Any) -> None:
        self._place = self._place._replace(stream=stream)

    def declare(self) -> None:
        """Sends what does not change."""
        for panel in self._panels:
            panel.declare(self._place)
        if self._infos is not None:
            self._infos.declare(self._alone)

    def send(self, follower: Follower, new: NewSteps) -> None:
        """Sends the newest of new steps."""
        shown = new.newest(self._most).moved(self._shift)
        if shown.first != self._next:
            self._leave_out(shown)
        self._next = shown.first + len(shown)
        self._send_steps(shown)
        self._send_images(follower, shown)
        newest = self._times(np.array([self._next - 1]), shown.facts.time[-1:])
        for heat_map in self._maps:
            heat_map.send(self._place, newest)

    def send_infos(self, found: Sequence[NewInfo]) -> None:
        if not found or self._infos is None:
            return
        rows = np.array([info.row for info in found]) + self._shift
        self._infos.send_numbers(
            self._alone,
            [info.values for info in found],
            self._times(rows, np.array([info.time_ns for info in found])),
            missed=self._missed or len(found) >= MOST_INFOS,
        )
        self._missed = False

    def _leave_out(self, after: NewSteps) -> None:
        """Breaks the lines before `after`: steps ahead of it are not sent."""
        self._rewards.miss()
        self._missed = True
        times = self._times(np.array([after.first - 1]), after.facts.time[:1])
        lines = [(panel.entity, len(panel.dims)) for panel in self._panels if isinstance(panel, Series)]
        for entity, width in (*lines, ("/reward", 1)):
            send_scalars(self._place.stream, self._place.root + entity, times, np.full((1, width), np.nan))

    def _send_steps(self, steps: NewSteps) -> None:
        columns = columns_of(self._layout, self._decoder, steps)
        for heat_map in self._maps:
            heat_map.take(columns)
        block = _block(steps, columns)
        times = Times(block.number, block.times, self._seconds, block.seams)
        for panel in self._panels:
            if not _is_apart(panel):
                panel.send(self._place, block, times)

    def _send_images(self, follower: Follower, steps: NewSteps) -> None:
        stop = steps.first + len(steps)
        first = max(steps.first, stop - self._images)
        wanted = range(first - self._shift, stop - self._shift)
        for number, leaf in enumerate(self._layout.images):
            records = follower.images(number, self._env, wanted)
            for panel in self._panels:
                if records and getattr(panel, "leaf", None) is leaf:
                    rows = np.array(sorted(records))
                    images = np.stack([leaf.as_values(records[row]["data"]) for row in rows.tolist()])
                    rows += self._shift
                    times = steps.facts.time[rows - steps.first]
                    only = [images if other is leaf else None for other in self._layout.state]
                    part: Any = _Columns(self._layout.nest_state(only), None, None)
                    block = Block(_NOTHING, part, [], rows, times)
                    panel.send(self._place, block, self._times(rows, times))

    def send_frames(self, follower: Follower) -> None:
        for panel in self._cameras:
            found = follower.frames(self._env, self._images)
            if found:
                rows = np.array([row for row, _ in found]) + self._shift
                frames = [frame for _, frame in found]
                times = self._times(rows, np.array([frame.time_ns for frame in frames]))
                panel.send_frames(self._place, frames, times)

    def _times(self, rows: Array, times: Array) -> Times:
        return Times(rows, times, self._seconds)


def columns_of(layout: StepLayout, decoder: MessageDecoder | None, steps: NewSteps) -> _Columns:
    """States, actions and rewards of some steps; `decoder` is None if the layout is constant."""
    if steps.rows is not None:
        named: dict[str, Any] = {leaf.name: steps.rows[leaf.name] for leaf in layout.step_leaves if leaf.size}
    else:
        decoder = decoder or MessageDecoder(layout)
        decoded = [decoder.step(memoryview(message)[_CDR:]) for _, message in steps.messages]
        named = {
            leaf.name: [step[leaf.name] for step in decoded]
            if leaf.dtype is None
            else np.array([step[leaf.name] for step in decoded])
            for leaf in layout.step_leaves
            if leaf.dtype is None or leaf.size
        }
    states, actions, rewards = (
        [named.get(leaf.name) for leaf in leaves] for leaves in (layout.state, layout.action, layout.reward)
    )
    return _Columns(layout.nest_state(states), layout.nest_action(actions), layout.nest_reward(rewards))


def _block(steps: NewSteps, columns: Any) -> Block:
    """The steps as a block, with a piece for each episode or part of one; the last may go on after the last row."""
    facts, count = steps.facts, len(steps)
    bounds = [0, *(np.flatnonzero(np.diff(facts.episode)) + 1).tolist(), count]
    pieces = []
    for i, (begin, end) in enumerate(itertools.pairwise(bounds)):
        how_ended = INTERRUPTED if end < count else None
        if facts.terminal[end - 1] or facts.timeout[end - 1]:
            how_ended = TERMINAL if facts.terminal[end - 1] else TIMEOUT
        pieces.append(Piece(begin, end, i, int(facts.step[begin]), how_ended))
    return Block(_NOTHING, columns, pieces, np.arange(steps.first, steps.first + count), facts.time)


def _is_apart(panel: Panel) -> bool:
    """Whether a panel shows values that are not in the rows of steps."""
    leaf = getattr(panel, "leaf", None)
    return isinstance(leaf, Leaf) and leaf.apart
