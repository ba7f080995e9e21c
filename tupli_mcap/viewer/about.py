"""What there is to say about a recording as a whole: a card of its metadata, and all its episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from tupli_mcap.recording import Recording
from tupli_mcap.recording.describe import describe

__all__ = ["card", "send_about"]

_MOST_BARS = 1000


def send_about(stream: Any, recordings: Sequence[Recording], shown: str, unseen: Sequence[str]) -> None:
    """Sends `/card`, and `/overview/return` and `/overview/length` of all episodes, on the timeline `episode`."""
    import rerun as rr

    from tupli_mcap.viewer.sending import column_of

    texts = [card(recording) for recording in recordings]
    missing = "".join(f"\n- {line}" for line in unseen)
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
        stream.log(f"/overview/{name}", rr.BarChart(_binned(values)), static=True)


def _binned(values: Any) -> Any:
    """At most a thousand bars: means of neighbours where there are more; what is not finite is 0."""
    finite = np.where(np.isfinite(values), values, 0.0)
    if len(finite) <= _MOST_BARS:
        return finite
    edges = np.linspace(0, len(finite), _MOST_BARS + 1).astype(int)
    return np.add.reduceat(finite, edges[:-1]) / np.diff(edges)


def card(recording: Recording) -> str:
    """A recording's facts in Markdown."""
    d = describe(recording)
    rows = [
        ("environment", d.environment or "not recorded"),
        ("episodes", f"{d.episodes:,}"),
        ("steps", f"{d.steps:,}"),
        *(
            [("return", f"mean {d.returns.mean:.4g}, {d.returns.min:.4g} to {d.returns.max:.4g}")]
            if d.returns
            else []
        ),
        *(
            [("length", f"mean {d.lengths.mean:.4g}, {d.lengths.min:.4g} to {d.lengths.max:.4g}")]
            if d.lengths
            else []
        ),
        ("observation", d.observation_space or ""),
        ("action", d.action_space or ""),
        ("benchmark", d.benchmark_id[:12] or "none"),
    ]
    return f"### {_plain(d.name)}\n\n| | |\n|---|---|\n" + "\n".join(
        f"| {name} | {_plain(value)} |" for name, value in rows
    )


def _plain(text: str) -> str:
    """Text from a file as Markdown that means nothing but itself."""
    kept = "".join(c if c.isprintable() else " " for c in text[:400])
    return "".join(f"\\{c}" if c in r"\`*_{}[]<>()#+!|~" else c for c in kept)
