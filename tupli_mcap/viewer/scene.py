"""The scene of a recording: which panels its spaces ask for, and the blueprint that arranges them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tupli_mcap.messages.leaves import Leaf
from tupli_mcap.recording import Recording
from tupli_mcap.viewer.names import by_scale, dimension_names, entity_of, magnitudes, title_of
from tupli_mcap.viewer.panels import Panel, Rewards, Series

__all__ = ["Scene", "scene_of"]

MOST_LINES = 12  # in one plot; more cannot be told apart
_RATIO = 30.0  # magnitudes further apart than this do not share an axis
_SAMPLE_EPISODES, _SAMPLE_STEPS = 8, 512


@dataclass
class Scene:
    """Panels by their place in the window, and what is not shown."""

    states: list[Panel] = field(default_factory=list)
    actions: list[Panel] = field(default_factory=list)
    rewards: list[Panel] = field(default_factory=list)
    beside: list[Panel] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)

    @property
    def panels(self) -> list[Panel]:
        return [*self.states, *self.actions, *self.rewards, *self.beside]


def scene_of(recording: Recording, positions: Sequence[int], *, apart: bool = False) -> Scene:
    """The panels for some episodes of a recording.

    Args:
        apart: each dimension gets a view of its own, for several episodes to be in it.
    """
    layout = recording.layout
    scene = Scene(rewards=[Rewards(layout.reward)])
    sample = _sample(recording, positions)
    most = 1 if apart else MOST_LINES
    for leaf in layout.state:
        _add(scene, scene.states, leaf, "states", sample, recording, most)
    for leaf in layout.action:
        _add(scene, scene.actions, leaf, "actions", sample, recording, most)
    return scene


def _add(
    scene: Scene, panels: list[Panel], leaf: Leaf, column: str, sample: Any, recording: Recording, most: int
) -> None:
    if leaf.dtype is None or not leaf.size or leaf.kind == "image":
        scene.unseen.append(f"{title_of(leaf)}: {leaf.space}")
        return
    labels = getattr(recording, "labels", None)
    names = dimension_names(leaf, None if labels is None else labels.dimensions.get(leaf.path))
    values = np.concatenate([leaf.get(getattr(part, column)).reshape(-1, leaf.size) for part in sample])
    groups = by_scale(magnitudes(values.astype(np.float64)), _RATIO, most)
    entity = entity_of(leaf)
    for dims in groups:
        told = [names[i] for i in dims]
        alone = len(groups) == 1
        title = title_of(leaf) if alone else f"{title_of(leaf)}: {_some(told)}"
        path = entity if alone else f"{entity}/dims_{'_'.join(map(str, dims))}"
        panels.append(Series(leaf, column, path, title, dims, told, stepped=column == "actions"))


def _some(names: Sequence[str], most: int = 4) -> str:
    """The first names, as a title has room for."""
    return ", ".join(names[:most]) + ("" if len(names) <= most else ", …")


def _sample(recording: Recording, positions: Sequence[int]) -> list[Any]:
    """A few steps from all over the episodes: for how large the values get."""
    chosen = np.unique(np.linspace(0, len(positions) - 1, _SAMPLE_EPISODES).astype(int))
    found = []
    for position in (positions[i] for i in chosen):
        length = int(recording.index["length"][position])
        start = max(0, (length - _SAMPLE_STEPS) // 2)
        stop = min(length, start + _SAMPLE_STEPS)
        found.append(recording.read_steps(position, start, stop, ("states", "actions")))
    return found
