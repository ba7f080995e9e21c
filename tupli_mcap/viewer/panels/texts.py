"""Panels of texts, values of variable size, infos, and lanes of states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tupli_mcap.jsonvalue import shown
from tupli_mcap.messages.infos import is_number, named_entries
from tupli_mcap.recording import Episode
from tupli_mcap.viewer.blocks import Block
from tupli_mcap.viewer.names import escaped
from tupli_mcap.viewer.panels.panel import PALETTE, LeafPanel, Root, named, plot
from tupli_mcap.viewer.sdk import rr, rrb
from tupli_mcap.viewer.sending import Times, send_scalars, send_texts

_LONGEST = 2000  # characters of a text that is shown
_NO_STATE = ""  # the viewer shows this as a gap in the lane


@dataclass(frozen=True)
class Lanes(LeafPanel):
    """A Discrete leaf as a lane of states, each value with its label and colour."""

    labels: Sequence[str]  # of the values from `start` on

    def declare(self, place: Root) -> None:
        colors = np.resize(np.array(PALETTE, np.uint32), len(self.labels))
        style = rr.StateConfiguration(values=list(self.labels), labels=list(self.labels), colors=colors)
        place.stream.log(place.root + self.entity, style, static=True)

    def send(self, place: Root, block: Block, times: Times) -> None:
        values = self.values(block).astype(np.int64)
        changed = np.ones(len(values), np.bool_)
        changed[1:] = values[1:] != values[:-1]
        changed[[piece.begin for piece in block.pieces]] = True
        rows = np.flatnonzero(changed)
        which = values[rows] - int(self.leaf.space.start)  # type: ignore[attr-defined]
        known = (which >= 0) & (which < len(self.labels))
        which = np.where(known, which, len(self.labels))
        at = times.at(rows)
        if block.finals is not None:  # a lane ends where its episode does
            before = np.searchsorted(rows, block.finals.before)
            which = np.insert(which, before, len(self.labels) + 1)
            at = at.inserted(before, block.finals.number, block.finals.times)
        known_texts = [*self.labels, None, _NO_STATE]
        texts = [known_texts[i] for i in which.tolist()]
        send_texts(place.stream, place.root + self.entity, at, rr.StateChange.descriptor_state(), texts)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        return rrb.StateTimelineView(
            name=self.title, origin="/", contents=[root + self.entity for root in roots], time_view=axis
        )


@dataclass(frozen=True)
class Words(LeafPanel):
    """A leaf of variable size: a text as it is, anything else as Python would print it."""

    def send(self, place: Root, block: Block, times: Times) -> None:
        texts = [_shown(value) for value in self.values(block)]
        entity = place.root + self.entity
        send_texts(place.stream, entity, times, rr.TextDocument.descriptor_text(), texts)
        send_texts(place.stream, entity, times, rr.TextLog.descriptor_text(), texts)

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        title, entity = self.title, self.entity
        moments = [rrb.TextDocumentView(name=named(title, root), origin=root + entity) for root in roots]
        log = rrb.TextLogView(name=f"{title}: log", origin="/", contents=[root + entity for root in roots])
        return rrb.Tabs(*moments, log, name=title)


def _shown(value: Any) -> str:
    text = value if isinstance(value, str) else shown(value)
    text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]} … ({len(text):,} characters)"
    return text.encode("utf-8", "replace").decode()


@dataclass(frozen=True)
class Infos:
    """Infos of steps: a series for each number, a log for each text."""

    numbers: Mapping[str, str]  # key -> entity
    texts: Mapping[str, str]
    title: str = "infos"
    column: str = "infos"

    def declare(self, place: Root) -> None:
        for i, (key, entity) in enumerate(self.numbers.items()):
            place.declare_series(entity, [place.series_name(key, alone=False)], place.colors(1, i))

    def send(self, place: Root, block: Block, times: Times) -> None:
        pairs_of: dict[str, list[tuple[int, Any]]] = {key: [] for key in (*self.numbers, *self.texts)}
        seams = set(times.seams)
        breaking: set[str] = set()  # keys whose next value is of another episode than the one before
        for piece in block.pieces:
            if piece.begin in seams:
                breaking = set(self.numbers)
            stop = piece.step + piece.end - piece.begin
            infos = block.recording.infos_of_steps(piece.position, piece.step, stop) or []
            for row, info in enumerate(infos, piece.begin):
                for key, value in named_entries(info or {}).items():
                    if key in pairs_of and (
                        isinstance(value, str) if key in self.texts else _is_number(value)
                    ):
                        if key in breaking:
                            breaking.remove(key)
                            pairs_of[key].append((row, np.nan))
                        pairs_of[key].append((row, value))
        for key, pairs in pairs_of.items():
            if not pairs:
                continue
            at = times.at(np.array([row for row, _ in pairs]))
            if key in self.numbers:
                values = np.array([_number(value) for _, value in pairs])
                send_scalars(place.stream, place.root + self.numbers[key], at, values[:, None])
            else:
                texts = [_shown(value) for _, value in pairs]
                send_texts(
                    place.stream, place.root + self.texts[key], at, rr.TextLog.descriptor_text(), texts
                )

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        views = []
        if self.numbers:
            views.append(
                plot(self.title, [root + entity for root in roots for entity in self.numbers.values()], axis)
            )
        if self.texts:
            entities = [root + entity for root in roots for entity in self.texts.values()]
            views.append(rrb.TextLogView(name=f"{self.title}: texts", origin="/", contents=entities))
        return views[0] if len(views) == 1 else rrb.Tabs(*views, name=self.title)


class LiveInfos(Infos):
    """The numbers in infos of the first sub-environment of a running rollout; below no root."""

    def send_numbers(
        self, place: Root, infos: Sequence[Mapping[str, Any]], times: Times, *, missed: bool
    ) -> None:
        """Sends the numbers of `infos`, one for each row of `times`. `missed`: infos before them were not sent, so the
        lines break."""
        for key, entity in self.numbers.items():
            rows = [row for row, info in enumerate(infos) if _is_number(info.get(key))]
            if not rows:
                continue
            values = np.array([_number(infos[row][key]) for row in rows])
            if missed:
                before = times.at(np.array(rows[:1])).moved(-1)
                send_scalars(place.stream, place.root + entity, before, np.full((1, 1), np.nan))
            send_scalars(place.stream, place.root + entity, times.at(np.array(rows)), values[:, None])

    def view(self, roots: Sequence[str], axis: Any) -> Any:
        return super().view([""], axis)


def panel_of_infos(episodes: Sequence[Episode], most: int) -> tuple[Infos | None, list[str]]:
    """The panel of the infos of the given episodes, and notes on infos that are not shown."""
    kinds: dict[str, str] = {}
    for episode in episodes:
        for info in episode.infos or ():
            for key, value in named_entries(info or {}).items():
                kind = "text" if isinstance(value, str) else "number" if _is_number(value) else "other"
                kinds[key] = kind if kinds.get(key, kind) == kind else "other"
    numbers = [key for key, kind in kinds.items() if kind == "number"]
    texts = [key for key, kind in kinds.items() if kind == "text"]
    left = numbers[most:] + texts[most:] + [key for key, kind in kinds.items() if kind == "other"]
    unseen = [f"info {key!r:.60}" for key in left]
    if not numbers and not texts:
        return None, unseen
    entities = {key: f"/info/{escaped(key)}" for key in (*numbers[:most], *texts[:most])}
    return Infos({k: entities[k] for k in numbers[:most]}, {k: entities[k] for k in texts[:most]}), unseen


def number_keys(infos: Sequence[Mapping[str, Any]]) -> list[str]:
    """Keys whose values are all numbers."""
    kinds: dict[str, bool] = {}
    for info in infos:
        for key, value in info.items():
            kinds[key] = kinds.get(key, True) and _is_number(value)
    return [key for key, numeric in kinds.items() if numeric]


def _is_number(value: Any) -> bool:
    if is_number(value):
        return not isinstance(value, int) or abs(value) < 2**1000
    return isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "biuf"


def _number(value: Any) -> float:
    return float(np.asarray(value).reshape(()))
