"""Chooses the panels for the spaces of a recording: its scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces

from tupli_mcap.arrays import Array
from tupli_mcap.dataset.chosen import Chosen
from tupli_mcap.messages.step import StepLayout
from tupli_mcap.recording import Columns, Episode
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.recording.describe.description import by_scale
from tupli_mcap.spaces.labels import Labels, distinct
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.names import dimension_names, entity_of, escaped, title_of
from tupli_mcap.viewer.panels import (
    Camera,
    Grid,
    HeatMap,
    Lanes,
    LiveInfos,
    Panel,
    Picture,
    Rewards,
    Series,
    Words,
    is_image,
    panel_of_infos,
    value_range,
)

MOST_LINES: Final = 12  # most lines in one plot; more cannot be told apart
_MOST_SMALL: Final = 48  # up to so many dimensions get small plots besides their heat map
_LINES_SMALL: Final = 6
_MOST_LANES: Final = 12  # values of a Discrete leaf that get a colour each
_MOST_LANE_ROWS: Final = 20_000  # the state timeline draws every change, however narrow
_MOST_INFOS: Final = 12
_MOST_LINKED: Final = 1000  # rows
_TITLED: Final = 4  # most dimensions that a title names
_MOST_FRAMES: Final = 16  # of a stack that is not declared as one
_LEAST_FRAME: Final = 16  # pixels of each of its sides
_RATIO: Final = 30.0  # magnitudes further apart than this do not share an axis
_SAMPLE_EPISODES, _SAMPLE_STEPS, _SAMPLE_BYTES = 8, 512, 8 << 20
_INFO_EPISODES: Final = 16  # whose infos are read for the keys


@dataclass
class Scene:
    """Panels by their place in the window, and notes on what is not shown."""

    states: list[Panel] = field(default_factory=list)
    actions: list[Panel] = field(default_factory=list)
    rewards: list[Rewards] = field(default_factory=list)
    beside: list[Panel] = field(default_factory=list)  # images, texts and infos, next to the plots
    unseen: list[str] = field(default_factory=list)
    rows: int = 0
    grows: bool = False  # whether rows are added while it is shown

    @property
    def panels(self) -> list[Panel]:
        return [*self.states, *self.actions, *self.rewards, *self.beside]

    @property
    def linked(self) -> bool:
        """Whether plots move together in time. They begin with a window around the cursor, too small for many rows."""
        return self.rows <= _MOST_LINKED

    @property
    def looks(self) -> str:
        """The panels and what they show, as text: scenes with the same text can share a blueprint."""
        facts = ("title", "entity", "numbers", "texts")
        panels = [
            (type(panel).__name__, *(getattr(panel, fact, None) for fact in facts)) for panel in self.panels
        ]
        return repr((panels, self.linked))


class _Material(NamedTuple):
    """The facts by which panels are chosen: labels, a sample of columns, the number of rows, and `apart`."""

    labels: Labels
    sample: Sequence[Any]
    rows: int
    apart: bool

    def values(self, leaf: Leaf, column: str) -> Array:
        parts = [leaf.get(getattr(part, column)).reshape(-1, leaf.size) for part in self.sample]
        return np.concatenate(parts).astype(np.float64)


def scene_of(chosen: Sequence[Chosen], *, apart: bool = False) -> Scene:
    """The panels for episodes of recordings of the same spaces: every camera and info that one of them has. apart: give
    each dimension its own view, in which several episodes are overlaid."""
    recording = chosen[0].recording
    episodes = [item.recording.episodes[position] for item in chosen for position in item.positions]
    rows = sum(map(len, episodes))
    material = _Material(recording.labels, _sample(_spread(episodes, _SAMPLE_EPISODES)), rows, apart)
    cameras = dict.fromkeys(camera for item in chosen for camera in item.recording.cameras)
    scene = _scene(recording.layout, material, cameras)
    infos, unseen = panel_of_infos(_spread(episodes, _INFO_EPISODES), _MOST_INFOS)
    if infos is not None:
        scene.beside.append(infos)
    scene.unseen += unseen
    return scene


def live_scene(
    layout: StepLayout,
    labels: Labels,
    sample: Sequence[Any],
    camera: str | None,
    infos: Sequence[str],
    *,
    apart: bool,
) -> Scene:
    """The panels for a running rollout. sample: columns of its first steps. infos: keys of numbers in infos. apart:
    give each dimension its own view, in which several sub-environments are overlaid."""
    material = _Material(labels, sample, _MOST_LANE_ROWS + 1, apart)
    scene = _scene(layout, material, () if camera is None else [camera])
    scene.grows = True
    if infos:
        title = "infos of env 0" if apart else "infos"
        entities = {key: f"/info/{escaped(key)}" for key in infos}
        scene.beside.append(LiveInfos(entities, {}, title))
    return scene


def _scene(layout: StepLayout, material: _Material, cameras: Iterable[str]) -> Scene:
    scene = Scene(rewards=[Rewards(layout.reward)], rows=material.rows)
    scene.beside += [Camera(name, f"/camera/{escaped(name)}", f"camera {name}") for name in cameras]
    for leaf in layout.state:
        _add(scene, scene.states, leaf, "states", material)
    for leaf in layout.action:
        _add(scene, scene.actions, leaf, "actions", material)
    return scene


def _add(scene: Scene, panels: list[Panel], leaf: Leaf, column: str, material: _Material) -> None:
    entity, title = entity_of(leaf), title_of(leaf)
    if leaf.dtype is None:
        scene.beside.append(Words(leaf, column, entity, title))
    elif not leaf.size:
        scene.unseen.append(f"{title} has no values")
    elif picture := _picture(leaf, column, material):
        scene.beside.append(picture)
    elif type(leaf.space) is spaces.Discrete:
        panels.append(_discrete(leaf, column, material))
    elif leaf.size <= MOST_LINES:
        panels += _series(leaf, column, material, 1 if material.apart else MOST_LINES)
    elif len(leaf.shape) in (2, 3):
        panels.append(Grid(leaf, column, entity, title))
    else:
        panels += _many(scene, leaf, column, material)


def _picture(leaf: Leaf, column: str, material: _Material) -> Picture | None:
    """The picture panel of an image, or of an array with the shape of an image or a stack of frames; None for others.

    Values that are not uint8 are scaled between the bounds of the space, or of the sample if the space has none.
    """
    entity, title = entity_of(leaf), title_of(leaf)
    if leaf.apart:
        return Picture(leaf, column, entity, title)
    shape = leaf.shape
    if leaf.dtype is None or not (leaf.dtype == np.uint8 or (leaf.dtype.kind == "f" and len(shape) > 2)):
        return None
    if not (is_image(shape) or len(shape) == 2):
        if len(shape) not in (3, 4) or not 2 <= shape[0] <= _MOST_FRAMES:
            return None
        shape = shape[1:]
    if min(shape[:2]) < _LEAST_FRAME or not (is_image(shape) or len(shape) == 2):
        return None
    if all(leaf.get(getattr(part, column)).dtype == np.uint8 for part in material.sample):
        return Picture(leaf, column, entity, title)
    space: Any = leaf.space
    low, high = float(np.min(space.low)), float(np.max(space.high))
    if not np.isfinite([low, high]).all():
        lows, highs = value_range(material.values(leaf, column))
        low, high = float(lows.min()), float(highs.max())
    return Picture(leaf, column, entity, title, low, high) if np.isfinite(high - low) and low < high else None


def _discrete(leaf: Leaf, column: str, material: _Material) -> Panel:
    space: Any = leaf.space
    n, start = int(space.n), int(space.start)
    entity, title = entity_of(leaf), title_of(leaf)
    names = material.labels.values.get(leaf.path)
    if (n <= _MOST_LANES or names is not None) and material.rows <= _MOST_LANE_ROWS:
        # the viewer would take equal labels for one state
        labels = distinct([str(start + i) for i in range(n)] if names is None else names)
        return Lanes(leaf, column, entity, title, labels)
    return Series(leaf, column, entity, title, (0,), (title,), stepped=True)


def _series(leaf: Leaf, column: str, material: _Material, most: int) -> list[Panel]:
    names = dimension_names(leaf, material.labels.dimensions.get(leaf.path))
    groups = by_scale(_magnitudes(material.values(leaf, column)), _RATIO, most)
    stepped = column == "actions" or (leaf.dtype is not None and leaf.dtype.kind in "iub")
    panels: list[Panel] = []
    for dims in groups:
        names_here, entity, title = [names[i] for i in dims], entity_of(leaf), title_of(leaf)
        if len(groups) > 1:
            entity += f"/dims_{'_'.join(map(str, dims))}"
            title += f": {', '.join(names_here[:_TITLED])}{', …' if len(dims) > _TITLED else ''}"
        panels.append(Series(leaf, column, entity, title, dims, names_here, stepped))
    return panels


def _magnitudes(values: Array) -> list[float]:
    """The typical size of each column of `values`: the 95th percentile of its finite absolute values."""
    found = []
    for column in values.T:
        finite = np.abs(column[np.isfinite(column)])
        found.append(float(np.percentile(finite, 95)) if len(finite) else 0.0)
    return found


def _many(scene: Scene, leaf: Leaf, column: str, material: _Material) -> list[Panel]:
    """A heat map, and small plots if there are few enough dimensions to tell apart."""
    values = material.values(leaf, column)
    low, high = (np.where(np.isfinite(ends), ends, 0.0) for ends in value_range(values))
    title = f"{title_of(leaf)}: {leaf.size:,} dimensions, each from its lowest to its highest"
    panels: list[Panel] = [HeatMap(leaf, column, f"{entity_of(leaf)}/heat_map", title, low, high)]
    if leaf.size > _MOST_SMALL or material.apart:
        scene.unseen.append(
            f"{title_of(leaf)}: {leaf.size:,} dimensions are in the heat map only, without their values"
        )
        return panels
    return panels + _series(leaf, column, material, _LINES_SMALL)


def _spread(episodes: Sequence[Episode], most: int) -> list[Episode]:
    """A few of the episodes, evenly spaced."""
    chosen = np.unique(np.linspace(0, len(episodes) - 1, most).astype(int))
    return [episodes[i] for i in chosen]


def _sample(episodes: Sequence[Episode]) -> list[Columns]:
    """A few steps from the middle of a few episodes, without images, to measure how large values get."""
    at_once = _SAMPLE_BYTES // _SAMPLE_EPISODES // step_bytes(episodes[0].recording.layout, images=False)
    most = max(1, min(_SAMPLE_STEPS, at_once))
    sample = []
    for episode in episodes:
        start = max(0, (len(episode) - most) // 2)
        stop = min(len(episode), start + most)
        fields = ("states", "actions")
        sample.append(episode.recording.read_steps(episode.position, start, stop, fields, images=False))
    return sample
