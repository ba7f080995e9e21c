"""Plans the Rerun recordings of chosen episodes: all on one timeline, one for each, or all overlaid."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from tupli_mcap.dataset.chosen import Chosen, extremes
from tupli_mcap.environment import DOCUMENT_NAME
from tupli_mcap.errors import RecordingError, asking
from tupli_mcap.jsonvalue import shown
from tupli_mcap.recording import Recording
from tupli_mcap.recording.about.success import KEYS
from tupli_mcap.viewer.about import run_title, send_about
from tupli_mcap.viewer.blocks import Block, blocks_of, row_counts
from tupli_mcap.viewer.blueprints import blueprint_of
from tupli_mcap.viewer.names import plain
from tupli_mcap.viewer.panels import PALETTE, Root
from tupli_mcap.viewer.scene import Scene, scene_of
from tupli_mcap.viewer.sdk import rerun_sdk
from tupli_mcap.viewer.sending import Times

Form = Literal["joined", "apart", "compare"]
_MOST_APART = 200
_MOST_COMPARED = 16
_FEW = 10  # up to so many episodes are all shown, and described one by one
_EACH = 3  # up to so many runs, episodes are chosen from each


class ShownEpisodes(NamedTuple):
    """Episodes whose panels are below one root; their rows are numbered from `first`."""

    chosen: Chosen
    scene: Scene
    root: str = ""
    title: str = ""
    color: int | None = None
    first: int = 0

    @property
    def steps(self) -> int:
        """How many steps its episodes have."""
        return int(self.chosen.recording.index["length"][list(self.chosen.positions)].sum())

    @property
    def rows(self) -> int:
        """How many rows its episodes take: their steps and final states."""
        return int(row_counts(*self.chosen).sum())


class Plan(NamedTuple):
    """One Rerun recording: its name, its parts, its blueprint. The returns of all episodes are those of `among`, by
    default of the recordings of its parts."""

    name: str
    identity: str
    parts: Sequence[ShownEpisodes]
    shown: str
    listed: bool = False  # it is one of several, so the viewer shows its list of recordings
    among: Sequence[Recording] = ()

    @property
    def blueprint(self) -> Any:
        roots = list(dict.fromkeys(part.root for part in self.parts))
        return blueprint_of(self.parts[0].scene, roots, listed=self.listed, overview=self._shows_some_of_many)

    @property
    def _shows_some_of_many(self) -> bool:
        total = sum(len(recording.index) for recording in self.among or self.recordings)
        return total > max(_FEW, sum(len(part.chosen.positions) for part in self.parts))

    @property
    def recordings(self) -> list[Recording]:
        return list({id(part.chosen.recording): part.chosen.recording for part in self.parts}.values())

    @property
    def application(self) -> str:
        """The Rerun application. Plans that look alike share one, since a viewer keeps a blueprint for each."""
        first = self.parts[0]
        recording = first.chosen.recording
        looks = _spaces_of(recording) + repr([part.root for part in self.parts] if first.root else "")
        looks += first.scene.looks + "listed" * self.listed + "overview" * self._shows_some_of_many
        name = re.sub(r"[^0-9A-Za-z_-]+", "-", name_of(recording))  # the viewer warns of other characters
        return f"{name} {hashlib.sha256(looks.encode()).hexdigest()[:6]}"

    def new_stream(self) -> Any:
        """A Rerun recording stream without a sink."""
        rr = rerun_sdk()
        # a new id each time, so that a viewer that is sent the plan twice shows it twice
        identity = f"{self.identity}-{uuid.uuid4().hex[:8]}"
        return rr.RecordingStream(self.application, recording_id=identity, send_properties=True)

    def send(self, stream: Any) -> None:
        """Sends everything, a block of steps at a time."""
        stream.send_recording_name(self.name)
        chosen = [part.chosen for part in self.parts] if self._shows_some_of_many else []
        among = self.among or self.recordings
        send_about(stream, self.recordings, among, chosen, self.shown, self.parts[0].scene.unseen)
        steps: dict[str, int] = {}
        for part in self.parts:
            steps[part.root] = steps.get(part.root, 0) + part.steps
        for part in self.parts:
            place = Root(stream, part.root, part.title, part.color, single=steps[part.root] == 1)
            for panel in part.scene.panels:
                panel.declare(place)
            for block in blocks_of(*part.chosen, part.first):
                _send_block(place, part.scene, block)


def _send_block(place: Root, scene: Scene, block: Block) -> None:
    states = block.with_finals()
    times, state_times = times_of(block), times_of(states)
    for panel in scene.panels:
        if panel.column == "states":
            panel.send(place, states, state_times)
        else:
            panel.send(place, block, times)


def times_of(block: Block) -> Times:
    """The positions of a block's rows on the timelines."""
    return Times(block.number, block.times, block.recording.labels.step_seconds, block.seams)


def name_of(recording: Recording) -> str:
    """The environment's name, else the file's."""
    carried = DOCUMENT_NAME in recording.attachments
    return (carried and recording.benchmark.record.name) or Path(recording.name).stem


def runs_apart(chosen: Sequence[Chosen]) -> list[Chosen]:
    """The same episodes in the same order, those of each run of a recording by themselves."""
    return [
        Chosen(recording, list(same))
        for recording, positions in chosen
        for _, same in itertools.groupby(positions, recording.readable_places.__getitem__)
    ]


def extremes_of(chosen: Sequence[Chosen]) -> tuple[list[Chosen], str]:
    """The last, the best and the worst of many episodes, and a sentence about this choice; all episodes and "" if few.

    They are chosen in each run; if there are more than three runs, among all.
    """
    total = sum(len(item.positions) for item in chosen)
    if total <= _FEW:
        return list(chosen), ""
    groups = [[item] for item in chosen] if len(chosen) <= _EACH else [chosen]
    some: list[Chosen] = []
    told: list[str] = []
    for group in groups:
        found, words = extremes(group, _title)
        some += found
        of = f" of {_title(group[0])}" if len(groups) > 1 else ""
        told.append(", ".join(words) + of)
    number = sum(len(item.positions) for item in some)
    others = asking('episodes="3,7" or "all"', "--episodes 3,7 or all")
    return some, f"{number} of {total:,} episodes: {'; '.join(told)}. Others: {others}"


def plans_of(chosen: Sequence[Chosen], form: Form, among: Sequence[Chosen] = ()) -> Iterator[Plan]:
    """The Rerun recordings that show the chosen episodes; together they show the returns of all recordings that they
    were chosen from, as far as those have the same spaces. RecordingError if there are too many for this form."""
    if form not in get_args(Form):
        raise RecordingError(f"form: expected one of {', '.join(get_args(Form))}, found {form!r:.80}")
    total = sum(len(item.positions) for item in chosen)
    if form == "apart":
        if total > _MOST_APART:
            raise RecordingError(
                f"expected at most {_MOST_APART} episodes for --apart, found {total}; "
                "choose some with --episodes, or leave out --apart"
            )
        yield from _apart(chosen)
    elif form == "compare":
        if total > _MOST_COMPARED:
            raise RecordingError(
                f"expected at most {_MOST_COMPARED} episodes to compare, found {total}; choose some of them"
            )
        yield _compared(chosen)._replace(among=_alike(chosen[0], among))
    else:
        alike: dict[str, list[Chosen]] = {}
        for item in chosen:
            alike.setdefault(_spaces_of(item.recording), []).append(item)
        for group in alike.values():  # recordings of different spaces need different plots
            yield _joined(group)._replace(listed=len(alike) > 1, among=_alike(group[0], among))


def _alike(chosen: Chosen, among: Sequence[Chosen]) -> list[Recording]:
    """The recordings that have the same spaces, each once."""
    spaces = _spaces_of(chosen.recording)
    return [each for each in {item.recording: None for item in among} if _spaces_of(each) == spaces]


def _apart(chosen: Sequence[Chosen]) -> Iterator[Plan]:
    several = sum(len(item.positions) for item in chosen) > 1
    for item in chosen:
        scene = scene_of([item])
        scene.rows = int(row_counts(*item).max())
        for position in item.positions:
            number = item.recording.episodes[position].number
            # the number first: the viewer's list shows only the beginning
            name = f"episode {number} · {run_title(item.recording, position)}"
            part = ShownEpisodes(Chosen(item.recording, [position]), scene)
            text = _episode_told(item.recording, position)
            yield Plan(name, f"{item.recording.uuid}-{number}", [part], text, listed=several)


def _joined(chosen: Sequence[Chosen]) -> Plan:
    scene = scene_of(chosen)
    parts: list[ShownEpisodes] = []
    first = 0
    for item in chosen:
        parts.append(ShownEpisodes(item, scene, first=first))
        first += parts[-1].rows
    total = sum(len(item.positions) for item in chosen)
    if total == 1:
        text = _episode_told(chosen[0].recording, chosen[0].positions[0])
    else:
        text = f"{total:,} episodes, {sum(part.steps for part in parts):,} steps, on one timeline"
        text += "".join(_told_in_turn(parts)) if total <= _FEW else ""
    scene.rows = first
    titles = list(dict.fromkeys(map(_title, chosen)))
    name = ", ".join(titles[:_EACH]) + (f" and {len(titles) - _EACH:,} more" if len(titles) > _EACH else "")
    return Plan(name, chosen[0].recording.uuid, parts, text)


def _title(item: Chosen) -> str:
    return run_title(item.recording, item.positions[0])


def _told_in_turn(parts: Sequence[ShownEpisodes]) -> Iterator[str]:
    """For each episode, its first step on the timeline, and its facts."""
    yield "\n"
    for part in parts:
        recording, positions = part.chosen
        of = f" of {plain(_title(part.chosen))}" if len(parts) > 1 else ""
        starts = part.first + np.cumsum([0, *row_counts(recording, positions)])
        for position, start in zip(positions, starts.tolist(), strict=False):
            yield f"\n- from step {start:,}: {_episode_in_short(recording, position, of)}"


def _episode_told(recording: Recording, position: int) -> str:
    """An episode's facts and metadata in Markdown."""
    episode = recording.episodes[position]
    said = () if episode.success is None else KEYS  # in the line before
    others = [(key, value) for key, value in episode.metadata.items() if key not in said]
    lines = "".join(f"\n- {plain(key)}: {plain(shown(value))}" for key, value in others[:20])
    return f"{_episode_in_short(recording, position)}\n{lines}"


def _episode_in_short(recording: Recording, position: int, of: str = "") -> str:
    """An episode's facts in a line of Markdown."""
    episode = recording.episodes[position]
    facts = ["1 step" if len(episode) == 1 else f"{len(episode):,} steps"]
    facts += [f"return {episode.return_:.6g}", episode.end]
    facts += [] if episode.success is None else ["success" if episode.success else "no success"]
    facts += [] if episode.seed is None else [f"seed {episode.seed}"]
    return f"**Episode {episode.number}**{of}: {', '.join(facts)}"


def _spaces_of(recording: Recording) -> str:
    return json.dumps(recording.layout.to_metadata())


def _compared(chosen: Sequence[Chosen]) -> Plan:
    first = chosen[0].recording
    for item in chosen[1:]:
        if _spaces_of(item.recording) != _spaces_of(first):
            raise RecordingError(
                f"expected recordings of the same spaces to compare, found {first.name} and {item.recording.name} "
                "with different ones; show them without --compare"
            )
    scene = scene_of(chosen, apart=True)
    parts: list[ShownEpisodes] = []
    titles = [_title(item) for item in chosen]
    if len(set(titles)) < len(titles):  # files of one run
        titles = [Path(item.recording.name).stem for item in chosen]
    for item, name in zip(chosen, titles, strict=True):
        for position in item.positions:
            number = item.recording.episodes[position].number
            title = f"episode {number}" if len(chosen) == 1 else f"{name} {number}"
            root = "/" + re.sub(r"[^\w-]+", "_", title)
            if root in {part.root for part in parts}:  # files of one name
                root += f"_{len(parts)}"
            color = PALETTE[len(parts) % len(PALETTE)]
            parts.append(ShownEpisodes(Chosen(item.recording, [position]), scene, root, title, color))
    scene.rows = max(int(row_counts(*item).max()) for item in chosen)
    lines = [
        f"\n- {_episode_in_short(item.recording, position, f' of {plain(name)}' if len(chosen) > 1 else '')}"
        for item, name in zip(chosen, titles, strict=True)
        for position in item.positions
    ]
    return Plan("comparison", first.uuid, parts, f"**Compared**\n{''.join(lines)}")
