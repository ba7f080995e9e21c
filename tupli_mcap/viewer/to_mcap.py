"""`replay --to-mcap`: a copy of a recording that stock viewers plot as it is, and a layout for Foxglove."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.dataset.which import Source, chosen_from
from tupli_mcap.errors import RecordingError
from tupli_mcap.messages.topics import EPISODE_END, Topics
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.replacing import replacing
from tupli_mcap.spaces.labels import Labels
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.companion_channels import WIDEST, companion_topics, write_companions
from tupli_mcap.viewer.names import dimension_names
from tupli_mcap.viewer.targets import check_new

__all__ = ["Copies", "foxglove_layout", "to_mcap", "write_layout"]

_MOST_LINES = 12  # in a plot
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


class Copies(NamedTuple):
    """The files that were written."""

    recording: Path
    layout: Path


def to_mcap(
    sources: Source | Sequence[Source],
    target: str | os.PathLike[str],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    layout: str | os.PathLike[str] | None = None,
    force: bool = False,
) -> Copies:
    """Writes a copy with companion channels, and beside it (or at `layout`) a layout to import into Foxglove.

    Args:
        sources, episodes, filter: as `tupli_mcap.viewer.save` has them, of one recording.
        force: replace files that exist.

    Raises:
        RecordingError: more than one recording, no such episode, or a file that exists, is the recording itself, has
            another ending than `.mcap`, or cannot be written.
        FormatError: the recording is damaged.
    """
    target = Path(target)
    place = target.with_suffix(".foxglove-layout.json") if layout is None else Path(layout)
    if target.suffix != ".mcap":
        raise RecordingError(
            f"expected a name that ends in .mcap, by which viewers know such files, found {str(target)!r}"
        )
    for goal in (target, place):  # neither is written if the other cannot be
        check_new(goal, force=force)
    with chosen_from(sources, episodes, filter) as chosen:
        if len(chosen) != 1:
            raise RecordingError(f"expected one recording to copy, found {len(chosen)}; copy them one by one")
        ((recording, positions),) = chosen
        if recording.path is not None and any(_is_same(goal, recording.path) for goal in (target, place)):
            raise RecordingError(
                f"{recording.path} is the recording, which is never written over; give another name"
            )
        everything = len(positions) == len(recording)
        numbers = None if everything else recording.index["episode"][list(positions)].tolist()
        write_companions(recording, target, episodes=numbers, force=force)
        return Copies(target, write_layout(recording, place))


def _is_same(goal: Path, source: Path) -> bool:
    return goal.exists() and goal.samefile(source)


def write_layout(recording: Recording, target: str | os.PathLike[str]) -> Path:
    """Writes the layout of a recording as JSON, which Foxglove imports ("Import from file" in its layouts).

    Raises:
        RecordingError: the system refuses.
    """
    path = Path(target)
    text = json.dumps(foxglove_layout(recording), indent=2, ensure_ascii=False) + "\n"
    with replacing(path) as (_, temporary):
        temporary.write_text(text, encoding="utf-8")
    return path


def foxglove_layout(recording: Recording) -> dict[str, Any]:
    """States and actions on the left, pictures, reward and ends on the right; of the first sub-environment."""
    recorded = Topics.of(0 if recording.is_vector else None)
    top = recorded.top
    layout, labels = recording.layout, recording.labels
    panels: dict[str, dict[str, Any]] = {}
    left: list[str] = []
    right: list[str] = []

    def add(side: list[str], kind: str, name: str, config: Mapping[str, Any]) -> None:
        number = f"{kind}!{name}"
        panels[number] = {**config, "foxglovePanelTitle": name}
        side.append(number)

    topics = companion_topics(layout, top)
    for leaf in [*layout.state, *layout.action]:
        paths = _paths(leaf, top, labels, layout.dtypes.get(leaf.name), topics)
        if leaf.apart:
            add(right, "Image", leaf.path, {"imageMode": {"imageTopic": recorded.image(leaf.name)}})
        elif type(leaf.space) is spaces.Discrete:
            add(left, "StateTransitions", leaf.path, {"isSynced": True, "paths": paths})
        elif type(leaf.space) is spaces.Text:
            add(right, "RawMessages", leaf.path, {"topicPath": f"{topics[leaf.name]}.data"})
        elif paths:
            add(left, "Plot", leaf.path, {**_PLOT, "paths": paths})
    for camera in recording.cameras:
        add(right, "Image", f"camera {camera}", {"imageMode": {"imageTopic": recorded.camera(camera)}})
    rewards = [
        p for leaf in layout.reward for p in _paths(leaf, top, labels, layout.dtypes.get(leaf.name), topics)
    ]
    add(right, "Plot", "return", {**_PLOT, "paths": [_path(f"{top}/plot/return.data[0]", "return")]})
    add(right, "Plot", "reward", {**_PLOT, "paths": rewards})
    add(right, "RawMessages", "last end of an episode", {"topicPath": EPISODE_END})
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", _stack(left), _stack(right), 60),
    }


def _paths(
    leaf: Leaf, top: str, labels: Labels, dtype: np.dtype[Any] | None, topics: Mapping[str, str]
) -> list[dict[str, Any]]:
    """A message path for each dimension; none of a leaf that is no number, or too wide to be plotted."""
    if dtype is None or leaf.apart or not 0 < leaf.size <= WIDEST:
        return []
    names = dimension_names(leaf, labels.dimensions.get(leaf.path))
    # a float16 is stored as its bits, which are no number to plot
    place = f"{topics[leaf.name]}.data" if dtype == np.float16 else f"{Topics(top).step}.{leaf.name}"
    if leaf.shape == () and dtype != np.float16:
        return [_path(place, names[0])]
    return [_path(f"{place}[{i}]", name) for i, name in enumerate(names[:_MOST_LINES])]


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
