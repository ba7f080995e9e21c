"""Panels about recordings as a whole: a card of their metadata, returns and lengths of all their episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.dataset.chosen import Chosen
from tupli_mcap.recording import Recording
from tupli_mcap.recording.about.run import name_after
from tupli_mcap.recording.about.success import success_text
from tupli_mcap.recording.describe.description import describe, nan_text
from tupli_mcap.schema.times import local_text
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.names import plain, title_of
from tupli_mcap.viewer.panels import PALETTE
from tupli_mcap.viewer.sdk import pa, rr
from tupli_mcap.viewer.sending import column_of, pooled, tensor_array

_MOST_BARS = 1000
_MOST_MARKS = 200
_BAR, _MARK = PALETTE[:2]
_MOST_LEAVES = 16
_LONGEST_TITLE = 80  # characters
_MOST_CARDS, _MOST_UNSEEN = 5, 20


def send_about(
    stream: Any,
    recordings: Sequence[Recording],
    among: Sequence[Recording],
    chosen: Sequence[Chosen],
    shown: str,
    unseen: Sequence[str],
) -> None:
    """Sends `/card` about recordings, and `/overview/return` and `/overview/length` of all episodes of those `among`
    which they are, on the timeline `episode`. The bars of the `chosen` ones are marked."""
    texts = [card(recording) for recording in recordings[:_MOST_CARDS]]
    if len(recordings) > _MOST_CARDS:
        texts.append(f"and {len(recordings) - _MOST_CARDS:,} more recordings")
    missing = "".join(f"\n- {plain(line)}" for line in unseen[:_MOST_UNSEEN])
    if len(unseen) > _MOST_UNSEEN:
        missing += f"\n- and {len(unseen) - _MOST_UNSEEN:,} more"
    notes = f"\n\n**Not shown**\n{missing}" if unseen else ""
    document = rr.TextDocument(f"{shown}\n\n" + "\n\n".join(texts) + notes, media_type=rr.MediaType.MARKDOWN)
    stream.log("/card", document, static=True)
    for name in ("return", "length"):
        values = np.concatenate([recording.index[name] for recording in among]).astype(np.float64)
        number = rr.TimeColumn("episode", sequence=np.arange(len(values)))
        stream.send_columns(
            f"/overview/{name}", [number], [column_of(rr.Scalars.descriptor_scalars(), pa.array(values))]
        )
        stream.log(f"/overview/{name}", _bars(values), static=True)
    if chosen:
        stream.log("/overview/shown", _marks(among, chosen), static=True)


def _marks(recordings: Sequence[Recording], chosen: Sequence[Chosen]) -> Any:
    """Bars of the chosen episodes in front of the others, wide enough to be seen among many."""
    sizes = [len(recording.index) for recording in recordings]
    first = dict(zip(map(id, recordings), np.cumsum([0, *sizes]).tolist(), strict=False))
    pairs = [(item.recording, position) for item in chosen for position in item.positions]
    at = np.array([first[id(recording)] + position for recording, position in pairs], np.float64)
    values = np.array([recording.index["return"][position] for recording, position in pairs], np.float64)
    finite = np.where(np.isfinite(values), values, 0.0)
    width = max(1.0, sum(sizes) / _MOST_MARKS)
    bars, places = (tensor_array([column], ["episode"]) for column in (finite, at + 0.5 - width / 2))
    return rr.BarChart(bars, abscissa=places, widths=np.full(len(at), width), color=_MARK)


def _bars(values: Any) -> Any:
    """At most a thousand bars, means of neighbours if there are more values; NaN and infinities count as 0."""
    finite = np.where(np.isfinite(values), values, 0.0)
    if len(finite) <= _MOST_BARS:
        return rr.BarChart(tensor_array([finite], ["episode"]), color=_BAR)
    means, bounds = pooled(finite, _MOST_BARS)
    bars, places = (tensor_array([column], ["episode"]) for column in (means, bounds[:-1]))
    # a bar is as wide as the episodes that it averages
    return rr.BarChart(bars, abscissa=places, widths=np.diff(bounds), color=_BAR)


def card(recording: Recording) -> str:
    """A recording's facts in Markdown."""
    d = describe(recording)
    ends = ", ".join(f"{number:,} {name}" for name, number in d.ends.items() if number)
    rows = [
        ("environment", d.environment or "not recorded"),
        ("episodes", f"{d.episodes:,}, {ends or 'none has ended'}"),
        ("steps", f"{d.steps:,}"),
    ]
    for name, spread in (("return", d.returns), ("length", d.lengths)):
        if spread:
            odd = nan_text(spread.nan, d.episodes)
            text = f"mean {spread.mean:.4g}, from {spread.min:.4g} to {spread.max:.4g}{f'; {odd}' if odd else ''}"
            rows.append((name, odd if spread.nan == d.episodes else text))
    if d.success is not None:
        rows.append(("success", success_text(d.success, d.success_known, d.episodes)))
    rows += _leaf_rows(recording)
    rows += [
        ("benchmark", d.benchmark_id[:12] or "none"),
        ("recorded", local_text(d.created_ns)),
        ("file", d.name),
    ]
    lines = [f"| {plain(name)} | {plain(value)} |" for name, value in rows]
    return "\n".join([f"### {plain(run_title(recording))}", "", lines[0], "|---|---|", *lines[1:]])


def run_title(recording: Recording, position: int | None = None) -> str:
    """The name of an episode's run, or of the only run of a recording, else of the file; shortened, and without
    unprintable characters."""
    runs = recording.readable_runs
    place = 0 if position is None else recording.readable_places[position]
    known = position is not None or len(runs) == 1
    name = (known and runs[place].name) or name_after(recording.name)
    return "".join(char for char in name[:_LONGEST_TITLE] if char.isprintable())


def _leaf_rows(recording: Recording) -> list[tuple[str, str]]:
    """A row for each of the first leaves of state and action."""
    if not recording.index.size:
        return []
    leaves = [*recording.layout.state, *recording.layout.action]
    rows = [(title_of(leaf), _short(leaf)) for leaf in leaves[:_MOST_LEAVES]]
    more = len(leaves) - len(rows)
    return rows if not more else [*rows, ("…", f"{more:,} more")]


def _short(leaf: Leaf) -> str:
    """A leaf's space in a few words."""
    kind = type(leaf.space).__name__
    if isinstance(leaf.space, gym.spaces.Discrete):
        return f"{kind}, {leaf.space.n} values"
    if leaf.dtype is None:
        return kind
    return f"{kind}, {' × '.join(map(str, leaf.shape)) or 'one'} {leaf.dtype}"
