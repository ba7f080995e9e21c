"""Makes a layout for Foxglove: a JSON file that makes it plot the fields of a recording's `/step` messages.

Foxglove decodes the recording itself; the layout says which panel shows which field. It has no plots of wide leaves,
nor of float16, which messages store as bits.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from tupli_mcap import files
from tupli_mcap.dataset.chosen import Viewable, chosen_from
from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.topics import EPISODE_END, Topics
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.names import dimension_names
from tupli_mcap.viewer.scene import MOST_LINES
from tupli_mcap.viewer.targets import check_new

_WIDEST = 64  # elements of a leaf that is plotted
_PLOT = {
    "isSynced": True,
    "legendDisplay": "floating",
    "showLegend": True,
    "showPlotValuesInLegend": False,
    "showXAxisLabels": True,
    "showYAxisLabels": True,
    "sidebarDimension": 240,
    "xAxisVal": "timestamp",
}


def write_layout(
    sources: Viewable | Sequence[Viewable], target: str | os.PathLike[str], *, overwrite: bool = False
) -> Path:
    """Writes the layout of a recording as JSON, which Foxglove imports ("Import from file" in its layouts).

    Args:
        sources: as for `tupli_mcap.viewer.save`, but one recording.
        overwrite: replace a file that exists.

    Raises:
        RecordingError: `sources` is not one recording; the recording has no steps; the target exists, is the recording
            itself, or cannot be written.
        FormatError: the recording is damaged.
    """
    path = Path(target)
    check_new(path, overwrite=overwrite)
    with chosen_from(sources, None, None) as chosen:
        if len(chosen) != 1:
            raise RecordingError(
                f"expected one recording to make a layout for, found {len(chosen)}; give them one by one"
            )
        recording = chosen[0].recording
        if files.is_same(path, recording.path):
            raise RecordingError(
                f"{path} is the recording itself, which is never overwritten; give another name"
            )
        layout = foxglove_layout(recording)
    text = json.dumps(layout, indent=2) + "\n"  # in ASCII: keys of a space may hold lone surrogates
    with replacing(path, overwrite=overwrite) as (_, temporary):
        temporary.write_text(text, encoding="utf-8")
    return path


def foxglove_layout(recording: Recording) -> dict[str, Any]:
    """A layout with states and actions on the left, pictures, rewards and ends on the right. Of a vector environment,
    it shows the first sub-environment. RecordingError if the recording has no steps."""
    if not recording.n_steps:
        raise RecordingError(f"{recording.name} has no steps to plot")
    topics = Topics.of(0 if recording.is_vector else None)
    layout = recording.layout
    panels: dict[str, dict[str, Any]] = {}
    left: list[str] = []
    right: list[str] = []

    def add(side: list[str], kind: str, name: str, config: Mapping[str, Any]) -> None:
        number = f"{kind}!{name}"
        panels[number] = {**config, "foxglovePanelTitle": name}
        side.append(number)

    for leaf in [*layout.state, *layout.action]:
        paths = _paths(recording, topics, leaf)
        if leaf.apart:
            add(right, "Image", leaf.path, {"imageMode": {"imageTopic": topics.image(leaf.name)}})
        elif type(leaf.space) is spaces.Discrete:
            add(left, "StateTransitions", leaf.path, {"isSynced": True, "paths": paths})
        elif type(leaf.space) is spaces.Text:
            add(right, "RawMessages", leaf.path, {"topicPath": f"{topics.step}.{leaf.name}"})
        elif paths:
            add(left, "Plot", leaf.path, {**_PLOT, "paths": paths})
    for camera in recording.cameras:
        add(right, "Image", f"camera {camera}", {"imageMode": {"imageTopic": topics.camera(camera)}})
    rewards = [path for leaf in layout.reward for path in _paths(recording, topics, leaf)]
    add(right, "Plot", "reward", {**_PLOT, "paths": rewards})
    returns = [_path(f"{EPISODE_END}.episode_return", "return")]
    add(right, "Plot", "return of each episode", {**_PLOT, "paths": returns})
    add(right, "RawMessages", "last end of an episode", {"topicPath": EPISODE_END})
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", _stack(left), _stack(right), 60),
    }


def _paths(recording: Recording, topics: Topics, leaf: Leaf) -> list[dict[str, Any]]:
    """A message path for each of the first dimensions; none of a leaf that is no number, or too wide to be plotted."""
    dtype = recording.layout.dtypes.get(leaf.name)
    if dtype is None or dtype == np.float16 or leaf.apart or not 0 < leaf.size <= _WIDEST:
        return []
    names = dimension_names(leaf, recording.labels.dimensions.get(leaf.path))
    field = f"{topics.step}.{leaf.name}"
    if leaf.shape == ():
        return [_path(field, names[0])]
    return [_path(f"{field}[{i}]", name) for i, name in enumerate(names[:MOST_LINES])]


def _path(value: str, label: str) -> dict[str, Any]:
    return {"value": value, "label": label, "enabled": True, "timestampMethod": "receiveTime"}


def _stack(panels: Sequence[str]) -> Any:
    """Panels below each other, of equal heights."""
    if len(panels) <= 1:
        return panels[0] if panels else None
    return _split("column", panels[0], _stack(panels[1:]), 100 / len(panels))


def _split(direction: str, first: Any, second: Any, percentage: float) -> Any:
    if first is None or second is None:
        return first or second
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}
