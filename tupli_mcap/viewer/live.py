"""A rollout that goes on, in the panels of a replay: what `RecordEpisodes(live="rerun")` sends."""

from __future__ import annotations

import hashlib
import itertools
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY, RECORD_HEADER
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.watching import NewSteps, Watcher
from tupli_mcap.viewer.about import plain
from tupli_mcap.viewer.arrange import blueprint_of
from tupli_mcap.viewer.blocks import Array, Block, Piece
from tupli_mcap.viewer.panels import Panel, Place, Series
from tupli_mcap.viewer.pictures import Camera, HeatMap
from tupli_mcap.viewer.scene import live_scene
from tupli_mcap.viewer.sending import Times, send_scalars

__all__ = ["LivePicture", "Sketch"]

_STEPS = 1000  # of the newest, at a time
_DECODED = 200  # where each message is decoded on its own
_IMAGES = 3
_SAMPLE, _PATIENCE = 100, 1.0  # steps, and seconds to wait for them, before it is decided what shares an axis
_BARS = 500
_MAP_STEPS = 400
_EVERY = 1.0  # seconds between two overviews
_CDR = BODY - RECORD_HEADER.size
_TERMINAL, _TIMEOUT, _INTERRUPTED = range(3)


class Sketch:
    """Makes the picture of a rollout once there are enough steps to see how large values get.

    title: what the rollout is called.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._steps: list[NewSteps] = []
        self._began = 0.0

    def __call__(self, watcher: Watcher) -> LivePicture | None:
        """None while there are too few; the rollout has a layout."""
        layout = watcher.layout
        if layout is None:
            return None
        self._began = self._began or time.monotonic()
        self._steps = (self._steps + watcher.look(1)[0])[-_SAMPLE:]
        found = sum(map(len, self._steps))
        waited = time.monotonic() - self._began
        if not found or (found < _SAMPLE and waited < _PATIENCE and not watcher.is_over):
            return None
        return LivePicture(self._title, layout, watcher, self._steps)


class _Columns(NamedTuple):
    states: Any
    actions: Any
    rewards: Any


@dataclass(frozen=True)
class _Ends:
    """What panels ask a recording: how its episodes ended, by position."""

    index: dict[str, Array]


class _NewestMap:
    """The heat map of the newest steps, whatever their episodes: those of a replay are of whole episodes."""

    def __init__(self, panel: HeatMap) -> None:
        self._panel = panel
        self._values = np.empty((0, panel.leaf.size), np.float32)

    def take(self, columns: _Columns) -> None:
        values = self._panel.leaf.get(getattr(columns, self._panel.column))
        new = values.reshape(len(values), -1)[-_MAP_STEPS:].astype(np.float32)
        self._values = np.concatenate([self._values, new])[-_MAP_STEPS:]
        finite = np.isfinite(new)
        panel = self._panel
        low = np.minimum(panel.low, np.where(finite, new, np.inf).min(axis=0, initial=np.inf))
        high = np.maximum(panel.high, np.where(finite, new, -np.inf).max(axis=0, initial=-np.inf))
        self._panel = replace(panel, low=low, high=high)

    def send(self, stream: Any, times: Times) -> None:
        self._panel.send_map(Place(stream), self._values, times)


class LivePicture:
    """The steps of the first sub-environment, numbered through all episodes, and the episodes of all of them."""

    def __init__(self, title: str, layout: StepLayout, watcher: Watcher, first: Sequence[NewSteps]) -> None:
        self._title = title
        self._layout = layout
        self._decoder = None if layout.constant else MessageDecoder(layout)
        self._seconds = watcher.labels.step_seconds
        self._waiting = list(first)
        self._next_row = 0
        self._returns: list[float] = []
        self._lengths: list[int] = []
        self._episodes = 0
        self._next_overview = 0.0
        sample = [self._columns(steps.newest(_DECODED)) for steps in first]
        self._scene = live_scene(layout, watcher.labels, sample, watcher.camera(0))
        # these two come by themselves
        self._panels = [panel for panel in self._scene.panels if not isinstance(panel, HeatMap | Camera)]
        self._cameras = [panel for panel in self._scene.beside if isinstance(panel, Camera)]
        self._maps = [_NewestMap(panel) for panel in self._scene.panels if isinstance(panel, HeatMap)]
        looks = hashlib.sha256(repr(layout.to_metadata()).encode()).hexdigest()[:6]
        self.application = f"{re.sub(r'[^0-9A-Za-z_-]+', '-', title)[:40]} live {looks}"
        self.blueprint = blueprint_of(self._scene)

    def declare(self, stream: Any) -> None:
        """Sends what does not change."""
        for panel in self._panels:
            panel.declare(Place(stream))
        self._next_overview = 0.0

    def send(self, stream: Any, watcher: Watcher) -> None:
        """Sends what is new."""
        steps, ended = watcher.look(1)
        waiting, self._waiting = self._waiting, []
        newest: Times | None = None
        for new in (*waiting, *steps):
            shown = new.newest(_STEPS if self._decoder is None else _DECODED)
            if shown.first != self._next_row:
                self._leave_out(stream, shown)
            self._next_row = shown.first + len(shown)
            self._send_steps(stream, shown)
            self._send_images(stream, watcher, shown)
            newest = self._times(np.array([self._next_row - 1]), shown.times[-1:])
        if newest is not None:
            for heat_map in self._maps:
                heat_map.send(stream, newest)
        self._send_frames(stream, watcher)
        self._episodes += len(ended)
        self._returns = [*self._returns, *ended["return"].tolist()][-_BARS:]
        self._lengths = [*self._lengths, *ended["length"].tolist()][-_BARS:]
        if time.monotonic() >= self._next_overview or watcher.is_over:
            self._send_overview(stream, "recorded" if watcher.is_over else "being recorded")
            self._next_overview = time.monotonic() + _EVERY

    def _leave_out(self, stream: Any, after: NewSteps) -> None:
        """Breaks the lines where steps are missing before those that follow."""
        self._scene.rewards[0].miss()
        times = self._times(np.array([after.first - 1]), after.times[:1])
        lines = [(panel.entity, len(panel.dims)) for panel in self._panels if isinstance(panel, Series)]
        for entity, width in (*lines, ("/reward", 1)):
            send_scalars(stream, entity, times, np.full((1, width), np.nan))

    def _send_steps(self, stream: Any, steps: NewSteps) -> None:
        columns = self._columns(steps)
        for heat_map in self._maps:
            heat_map.take(columns)
        bounds = [0, *(np.flatnonzero(np.diff(steps.episodes)) + 1).tolist(), len(steps)]
        ends = _ends_of(columns, self._flags(steps), bounds)
        # the return goes on from one block to the next only where an episode is alone in its block
        head = bounds[1] if steps.steps[0] else 0
        tail = bounds[-2] if ends[-1] is None else bounds[-1]
        for begin, end in itertools.pairwise(sorted({0, head, tail, len(steps)})):
            self._send_block(stream, steps, columns, (begin, end), bounds, ends)

    def _send_block(
        self,
        stream: Any,
        steps: NewSteps,
        columns: _Columns,
        cut: tuple[int, int],
        bounds: list[int],
        ends: Any,
    ) -> None:
        begin, end = cut
        pieces: list[Piece] = []
        codes: list[int] = []
        for i, (a, b) in enumerate(itertools.pairwise(bounds)):
            if begin <= a < b <= end:
                pieces.append(
                    Piece(a - begin, b - begin, len(pieces), int(steps.steps[a]), ends[i] is not None)
                )
                codes.append(_INTERRUPTED if ends[i] is None else ends[i])
        rows = np.arange(steps.first + begin, steps.first + end)
        part: Any = _Columns(*(_sliced(value, begin, end) for value in columns))
        asked: Any = _Ends({"end": np.array(codes)})
        block = Block(asked, part, pieces, rows, steps.times[begin:end])
        times = self._times(rows, block.times)
        for panel in self._panels:
            if not _is_apart(panel):
                panel.send(Place(stream), block, times)

    def _send_images(self, stream: Any, watcher: Watcher, steps: NewSteps) -> None:
        stop = steps.first + len(steps)
        wanted = range(max(steps.first, stop - _IMAGES), stop)
        for number, leaf in enumerate(self._layout.images):
            found = watcher.images(number, steps.env, wanted)
            for panel in self._panels:
                if found and getattr(panel, "leaf", None) is leaf:
                    rows = np.array(sorted(found))
                    images = np.stack([found[row]["data"] for row in rows.tolist()])
                    times = steps.times[rows - steps.first]
                    part: Any = _Columns(self._nested(leaf, images), None, None)
                    nobody: Any = None  # a picture asks only for its values
                    block = Block(nobody, part, [], rows, times)
                    panel.send(Place(stream), block, self._times(rows, times))

    def _send_frames(self, stream: Any, watcher: Watcher) -> None:
        import rerun as rr

        for panel in self._cameras:
            for row, frame in watcher.frames(0, _IMAGES):
                stream.reset_time()
                stream.set_time("step", sequence=row)
                stream.set_time("time", timestamp=np.datetime64(frame.time_ns, "ns"))
                if self._seconds is not None:
                    stream.set_time("episode_time", duration=row * self._seconds)
                stream.log(
                    panel.entity, rr.EncodedImage(contents=frame.data, media_type=f"image/{frame.form}")
                )

    def _nested(self, leaf: Leaf, values: Array) -> Any:
        """A state of this leaf only."""
        return self._layout.nest_state([values if other is leaf else None for other in self._layout.state])

    def _times(self, rows: Array, times: Array) -> Times:
        return Times(rows, times, self._seconds)

    def _flags(self, steps: NewSteps) -> tuple[Array, Array]:
        if steps.rows is not None:
            return steps.rows["terminal"], steps.rows["timeout"]
        flags = np.array([tuple(message[-2:]) for _, message in steps.messages], np.bool_)
        return flags[:, 0], flags[:, 1]

    def _columns(self, steps: NewSteps) -> _Columns:
        layout = self._layout
        if steps.rows is not None:
            named: dict[str, Any] = {
                leaf.name: steps.rows[leaf.name] for leaf in layout.step_leaves if leaf.size
            }
        else:
            decoder = self._decoder or MessageDecoder(layout)
            decoded = [decoder.step(memoryview(message)[_CDR:]) for _, message in steps.messages]
            named = {
                leaf.name: [step[leaf.name] for step in decoded]
                if leaf.dtype is None
                else np.array([step[leaf.name] for step in decoded])
                for leaf in layout.step_leaves
                if leaf.dtype is None or leaf.size
            }
        states, actions, rewards = (
            [named.get(leaf.name) for leaf in leaves]
            for leaves in (layout.state, layout.action, layout.reward)
        )
        return _Columns(layout.nest_state(states), layout.nest_action(actions), layout.nest_reward(rewards))

    def _send_overview(self, stream: Any, state: str) -> None:
        import rerun as rr

        lines = [f"### {plain(self._title)}", "", state, ""]
        if self._episodes:
            mean = float(np.mean(self._returns))
            lines.append(
                f"{self._episodes:,} episodes; the last {len(self._returns):,}: mean return {mean:.4g}"
            )
            for name, values in (("return", self._returns), ("length", self._lengths)):
                finite = np.nan_to_num(np.array(values, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
                stream.log(f"/overview/{name}", rr.BarChart(finite), static=True)
        document = rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN)
        stream.log("/card", document, static=True)


def _ends_of(columns: _Columns, flags: tuple[Array, Array], bounds: list[int]) -> list[int | None]:
    """How each stretch of an episode ends: None where it goes on after the last row."""
    terminal, timeout = flags
    found: list[int | None] = []
    for end in bounds[1:]:
        if terminal[end - 1] or timeout[end - 1]:
            found.append(_TERMINAL if terminal[end - 1] else _TIMEOUT)
        else:
            found.append(_INTERRUPTED if end < bounds[-1] else None)
    return found


def _sliced(value: Any, begin: int, end: int) -> Any:
    """Rows of a nested column."""
    if isinstance(value, dict):
        return {key: _sliced(item, begin, end) for key, item in value.items()}
    if isinstance(value, tuple):
        return tuple(_sliced(item, begin, end) for item in value)
    return None if value is None else value[begin:end]


def _is_apart(panel: Panel) -> bool:
    """Whether what a panel shows is not in the rows of steps."""
    leaf = getattr(panel, "leaf", None)
    return isinstance(leaf, Leaf) and leaf.apart
