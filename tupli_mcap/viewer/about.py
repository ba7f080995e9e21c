"""What there is to say about a recording as a whole: a card of its metadata, and all its episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tupli_mcap.recording import Recording
from tupli_mcap.recording.description import describe, nan_text
from tupli_mcap.spaces.leaves import Leaf
from tupli_mcap.viewer.names import title_of

__all__ = ["card", "plain", "send_about"]

_MOST_BARS = 1000
_MOST_LEAVES = 16
_MOST_CARDS, _MOST_UNSEEN = 5, 20


def send_about(stream: Any, recordings: Sequence[Recording], shown: str, unseen: Sequence[str]) -> None:
    """Sends `/card`, and `/overview/return` and `/overview/length` of all episodes, on the timeline `episode`."""
    import rerun as rr

    from tupli_mcap.viewer.sending import column_of

    texts = [card(recording) for recording in recordings[:_MOST_CARDS]]
    if len(recordings) > _MOST_CARDS:
        texts.append(f"and {len(recordings) - _MOST_CARDS:,} more recordings")
    missing = "".join(f"\n- {plain(line)}" for line in unseen[:_MOST_UNSEEN])
    if len(unseen) > _MOST_UNSEEN:
        missing += f"\n- and {len(unseen) - _MOST_UNSEEN:,} more"
    notes = f"\n\n**Not shown**\n{missing}" if unseen else ""
    document = rr.TextDocument(f"{shown}\n\n" + "\n\n".join(texts) + notes, media_type=rr.MediaType.MARKDOWN)
    stream.log("/card", document, static=True)
    import pyarrow as pa

    for name, column in (("return", "return"), ("length", "length")):
        values = np.concatenate([recording.index[column] for recording in recordings]).astype(np.float64)
        number = rr.TimeColumn("episode", sequence=np.arange(len(values)))
        stream.send_columns(
            f"/overview/{name}", [number], [column_of(rr.Scalars.descriptor_scalars(), pa.array(values))]
        )
        stream.log(f"/overview/{name}", _bars(values), static=True)


def _bars(values: Any) -> Any:
    """At most a thousand bars: means of neighbours where there are more; what is not finite is 0."""
    import rerun as rr

    from tupli_mcap.viewer.sending import tensor_array

    finite = np.where(np.isfinite(values), values, 0.0)
    if len(finite) <= _MOST_BARS:
        return rr.BarChart(tensor_array([finite], ["episode"]))
    edges = np.linspace(0, len(finite), _MOST_BARS + 1).astype(int)
    counts = np.diff(edges)  # a bar is as wide as the episodes it stands for
    means = np.add.reduceat(finite, edges[:-1]) / counts
    bars, places = (tensor_array([found], ["episode"]) for found in (means, edges[:-1]))
    return rr.BarChart(bars, abscissa=places, widths=counts)


def card(recording: Recording) -> str:
    """A recording's facts in Markdown."""
    d = describe(recording)
    rows = [
        ("environment", d.environment or "not recorded"),
        ("episodes", f"{d.episodes:,}, {_ends(d.ends)}"),
    ]
    rows += [("steps", f"{d.steps:,}")]
    for name, spread in (("return", d.returns), ("length", d.lengths)):
        if spread:
            odd = nan_text(spread.nan, d.episodes)
            told = f"mean {spread.mean:.4g}, from {spread.min:.4g} to {spread.max:.4g}{f'; {odd}' if odd else ''}"
            rows.append((name, odd if spread.nan == d.episodes else told))
    rows += _leaf_rows(recording)
    rows += [
        ("benchmark", d.benchmark_id[:12] or "none"),
        ("recorded", _when(d.created_ns)),
        ("file", d.name),
    ]
    lines = [f"| {plain(name)} | {plain(value)} |" for name, value in rows]
    return "\n".join([f"### {plain(Path(d.name).stem)}", "", lines[0], "|---|---|", *lines[1:]])


def _ends(ends: Mapping[str, int]) -> str:
    return ", ".join(f"{number:,} {name}" for name, number in ends.items() if number) or "none has ended"


def _when(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns // 10**9, UTC):%Y-%m-%d %H:%M} UTC"


def _leaf_rows(recording: Recording) -> list[tuple[str, str]]:
    """A row for every leaf of state and action: its space is one line long, however large the whole is."""
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


def plain(text: str) -> str:
    """Text from a file as Markdown that means nothing but itself."""
    kept = "".join(c if c.isprintable() else " " for c in text[:400])
    return "".join(f"\\{c}" if c in r"\`*_{}[]<>()#+!|~" else c for c in kept)
