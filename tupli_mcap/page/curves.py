"""The tracks of an episode: one for each number of its states, actions, rewards and infos, over its steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import FormatError
from tupli_mcap.jsonvalue import spelled
from tupli_mcap.messages.infos import named_entries
from tupli_mcap.messages.topics import INFO
from tupli_mcap.plots.measure import drawable_infos, number_columns, thinned_to
from tupli_mcap.plots.statistics import LeafValues, drawable_numbers
from tupli_mcap.recording import Episode, Recording
from tupli_mcap.recording.blocks import step_bytes
from tupli_mcap.spaces.labels import Labels
from tupli_mcap.spaces.leaves import Leaf

_T = TypeVar("_T")

SO_FAR: Final = "return so far"
_POINTS: Final = 800  # most points of a track
_READ_BYTES: Final = 64 << 20  # most bytes of steps that are read of an episode
_MOST_TRACKS: Final = 48  # most tracks of a leaf
_MOST_INFOS: Final = 50_000  # most infos of a recording: those of one episode take reading all of them
_MOST_KEYS: Final = 24


@dataclass(frozen=True)
class Track:
    """One number over the steps of an episode.

    field: "state", "action", "reward" or "info". at, values: steps and values to draw (float64; NaN is a gap).
    names: the names of discrete values, of which the first is `start`.
    """

    field: str
    name: str
    at: Array
    values: Array
    names: Sequence[str] = ()
    start: int = 0

    @property
    def ends(self) -> tuple[float, float]:
        """The smallest and the largest value; NaN if there is none."""
        known = self.values[np.isfinite(self.values)]
        return (float(known.min()), float(known.max())) if len(known) else (np.nan, np.nan)


@dataclass(frozen=True)
class Curves:
    """The tracks of an episode. read: how many of its steps they show. notes: sentences about what is left out."""

    tracks: Sequence[Track]
    read: int
    notes: Sequence[str]

    def of(self, field: str) -> list[Track]:
        return [track for track in self.tracks if track.field == field]


def curves_of(episode: Episode) -> Curves:
    """Reads an episode, or the beginning of a long one. What is damaged has no tracks, and a note says so."""
    recording, layout = episode.recording, episode.recording.layout
    most = max(1, _READ_BYTES // step_bytes(layout, images=False))
    read = min(len(episode), most)
    tracks: list[Track] = []
    notes: list[str] = []
    fields = ("states", "actions", "rewards")
    columns = readable(
        "steps", lambda: recording.read_steps(episode.position, 0, read, fields, images=False), notes
    )
    for field, leaf, column in () if columns is None else number_columns(layout, columns):
        tracks += _tracks(field, leaf, recording.labels, column, notes)
        if field == "reward" and leaf.size == 1:
            with np.errstate(over="ignore", invalid="ignore"):  # returns beyond all floats are not drawn
                so_far = drawable_numbers(column[:, 0].astype(np.float64).cumsum())
            tracks.append(_track("reward", SO_FAR, np.arange(read, dtype=np.float64), so_far))
    tracks += readable("infos", lambda: list(_info_tracks(recording, episode, read, notes)), notes) or ()
    if read < len(episode):
        notes.append(f"Of its {len(episode):,} steps, the first {read:,} are shown.")
    return Curves(tracks, read, notes)


def readable(what: str, read: Callable[[], _T], notes: list[str]) -> _T | None:
    """What `read` returns; None if that is damaged, which becomes one of the notes."""
    try:
        return read()
    except FormatError:
        notes.append(
            f"Its {what} cannot be read: the recording is damaged. Save the rest: tupli-mcap recover"
        )
        return None


def values_at(episode: Episode, step: int) -> dict[str, dict[str, str]]:
    """The values at a step as texts, by field and name. A value that has a track has the track's name. What is damaged
    is left out."""
    told = readable("steps", lambda: _step_values(episode, step), []) or {}
    if _few_infos(episode.recording):
        info = (readable("infos", lambda: episode.infos, []) or [None] * len(episode))[step] or {}
        told["info"] = {
            f"info.{name}": f"{value:.5g}" if isinstance(value, float | np.floating) else spelled(value)
            for name, value in named_entries(info).items()
        }
    return told


def _step_values(episode: Episode, step: int) -> dict[str, dict[str, str]]:
    recording, layout = episode.recording, episode.recording.layout
    columns = recording.read_steps(episode.position, step, step + 1, images=False)
    told = {
        "reward": _told(layout.reward, recording.labels, columns.rewards),
        "action": _told(layout.action, recording.labels, columns.actions),
        "state": _told(layout.state, recording.labels, columns.states),
    }
    if layout.reward[0].size == 1:
        rewards = recording.read_steps(episode.position, 0, step + 1, ("rewards",)).rewards
        with np.errstate(over="ignore", invalid="ignore"):
            told["reward"][SO_FAR] = f"{np.asarray(rewards, np.float64).sum():.5g}"
    if columns.terminals[0] or columns.timeouts[0]:
        told["end"] = {"end": "terminal" if columns.terminals[0] else "timeout"}
    return told


def _told(leaves: Sequence[Leaf], labels: Labels, columns: Any) -> dict[str, str]:
    told = {}
    for leaf in leaves:
        if leaf.kind == "variable":
            told[leaf.path] = spelled(leaf.get(columns)[0])
        elif not leaf.apart:
            values = LeafValues(leaf, labels, np.asarray(leaf.get(columns)).reshape(1, leaf.size))
            for name, value in zip(values.names, values.values, strict=False):
                told[name] = _value_text(value[0], values)
    return told


def _value_text(value: Any, of: LeafValues) -> str:
    if of.counts and of.value_names:
        place = int(value) - int(of.starts[0])
        if 0 <= place < len(of.value_names):
            return f"{of.value_names[place]} ({int(value)})"
    return f"{value:.5g}" if isinstance(value, np.floating) else str(value)


def _tracks(field: str, leaf: Leaf, labels: Labels, column: Array, notes: list[str]) -> Iterator[Track]:
    values = LeafValues(leaf, labels, column)
    if values.kind == "picture":
        notes.append(f"{leaf.path} is a picture ({' x '.join(map(str, leaf.shape))}) and has no curves.")
        return
    notes += values.notes()
    if len(values.elements) > _MOST_TRACKS:
        notes.append(f"Of {leaf.path}, {_MOST_TRACKS} curves are shown.")
    at = np.arange(column.shape[0], dtype=np.float64)
    start = int(values.starts[0]) if values.counts and values.value_names else 0
    for i, name in enumerate(values.names[:_MOST_TRACKS]):
        yield _track(field, name, at, drawable_numbers(values.values[i]), values.value_names, start)


def _track(
    field: str, name: str, at: Array, values: Array, names: Sequence[str] = (), start: int = 0
) -> Track:
    return Track(field, name, thinned_to(_POINTS, at), thinned_to(_POINTS, values), names, start)


def _few_infos(recording: Recording) -> bool:
    channel = recording.file.topics.get(INFO)
    return channel is None or recording.file.store.count(channel) <= _MOST_INFOS


def _info_tracks(recording: Recording, episode: Episode, read: int, notes: list[str]) -> Iterator[Track]:
    if not _few_infos(recording):
        notes.append(f"Infos are not drawn: the recording has more than {_MOST_INFOS:,}.")
        return
    at = np.arange(read, dtype=np.float64)
    infos = [info or {} for info in (episode.infos or [])[:read]]
    for _, name, values in drawable_infos(infos)[:_MOST_KEYS]:
        yield _track("info", name, at, values)
