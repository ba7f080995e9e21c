"""What of a rollout Rerun shows: a plot for each leaf, images, reward and return, and how episodes went."""

from __future__ import annotations

from typing import Any

import numpy as np

from tupli_mcap.messages.decoder import MessageDecoder
from tupli_mcap.messages.layout import BODY, RECORD_HEADER
from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording.watching import NewSteps, Watcher

__all__ = ["LivePicture", "draw"]

Array = np.ndarray[Any, Any]
_STEPS = 2000  # at a time: the newest
_DECODED = 50  # where each message is decoded on its own
_IMAGES = 3
_WIDEST = 64  # elements of a leaf that is shown as lines
_CDR = BODY - RECORD_HEADER.size


def draw(watcher: Watcher) -> LivePicture:
    """The picture of a rollout whose layout is known."""
    layout = watcher.layout
    if layout is None:
        raise RuntimeError("expected a layout, found no step yet")
    return LivePicture(layout, watcher.is_vector)


class LivePicture:
    """The first sub-environment of `layout`, on the timelines `step` (its rows, through all episodes) and `time`."""

    def __init__(self, layout: StepLayout, is_vector: bool) -> None:
        import rerun.blueprint as rrb

        self._layout = layout
        self._decoder = None if layout.constant else MessageDecoder(layout)
        self._leaves = [
            leaf for leaf in layout.step_leaves if leaf.dtype is not None and 0 < leaf.size <= _WIDEST
        ]
        self.application = "tupli-mcap live"
        plots = [
            rrb.TimeSeriesView(name=leaf.path, origin=entity_of(leaf))
            for leaf in self._leaves
            if leaf.path != "reward"
        ]
        images = [rrb.Spatial2DView(name=leaf.path, origin=entity_of(leaf)) for leaf in layout.images]
        rewards = rrb.TimeSeriesView(name="reward and return", origin="/", contents=["/reward", "/return"])
        self.blueprint = rrb.Blueprint(
            rrb.Horizontal(rrb.Vertical(*plots), rrb.Vertical(*images, rewards)),
            rrb.TimePanel(state=rrb.PanelState.Collapsed, timeline="step"),
        )

    def declare(self, stream: Any) -> None:
        import rerun as rr

        for name in ("reward", "return"):
            stream.log(f"/{name}", rr.SeriesLines(names=[name]), static=True)

    def send(self, stream: Any, watcher: Watcher) -> None:
        steps, _ = watcher.look(1)
        for new in steps:
            shown = new.newest(_STEPS if self._decoder is None else _DECODED)
            self._send_steps(stream, shown)
            self._send_images(stream, watcher, shown)

    def _send_steps(self, stream: Any, steps: NewSteps) -> None:
        import rerun as rr

        times = self._times(np.arange(steps.first, steps.first + len(steps)), steps.times)
        for leaf, values in zip(self._leaves, self._values(steps), strict=True):
            column = rr.Scalars.columns(scalars=np.ascontiguousarray(values, np.float64).reshape(-1))
            stream.send_columns(entity_of(leaf), times, column.partition([leaf.size] * len(steps)))

    def _values(self, steps: NewSteps) -> list[Array]:
        if steps.rows is not None:
            return [steps.rows[leaf.name] for leaf in self._leaves]
        decoder = self._decoder or MessageDecoder(self._layout)
        decoded = [decoder.step(memoryview(message)[_CDR:]) for _, message in steps.messages]
        return [np.array([step[leaf.name] for step in decoded]) for leaf in self._leaves]

    def _send_images(self, stream: Any, watcher: Watcher, steps: NewSteps) -> None:
        import rerun as rr

        stop = steps.first + len(steps)
        for number, leaf in enumerate(self._layout.images):
            found = watcher.images(number, steps.env, range(max(steps.first, stop - _IMAGES), stop))
            for row, record in found.items():
                image = record["data"]
                stream.set_time("step", sequence=row)
                stream.set_time("time", timestamp=np.datetime64(int(record["#log_time"]), "ns"))
                stream.log(entity_of(leaf), rr.Image(image[..., 0] if leaf.shape[2] == 1 else image))

    @staticmethod
    def _times(rows: Array, times: Array) -> list[Any]:
        import rerun as rr

        return [
            rr.TimeColumn("step", sequence=rows),
            rr.TimeColumn("time", timestamp=times.astype("datetime64[ns]")),
        ]


def entity_of(leaf: Leaf) -> str:
    """The entity path of a leaf."""
    return "/" + "/".join([leaf.path.partition("[")[0], *(str(key) for key in leaf.keys)])
