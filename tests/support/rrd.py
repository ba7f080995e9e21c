"""Reads a `.rrd` file with the SDK."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rerun.chunk import RrdReader

from tupli_mcap.recording import Episode

__all__ = ["Rrd", "joined_rows", "states_of"]


def joined_rows(lengths: np.ndarray) -> tuple[list[int], list[int]]:
    """Rows of episodes on one timeline: of their steps, and of their final states, each after its last step."""
    finals = np.cumsum(np.asarray(lengths, np.int64) + 1) - 1
    return np.delete(np.arange(finals[-1] + 1), finals).tolist(), finals.tolist()


def states_of(episode: Episode) -> np.ndarray:
    """All states: one for each step, and the final one."""
    return np.concatenate([episode.states, [episode.final_state]])


def _values(column: pa.Array) -> list[Any]:
    """The values of a column; times as nanoseconds, which Python's own have not."""
    return (column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column).to_pylist()


class Rrd:
    """The content of a `.rrd` file: for each of its recordings, the rows of an entity's component."""

    def __init__(self, path: Path) -> None:
        reader = RrdReader(str(path))
        self.recordings = sorted(reader.recordings(), key=lambda entry: entry.recording_id)
        self.blueprints = reader.blueprints()
        self._batches: list[dict[str, list[Any]]] = []
        for entry in self.recordings:
            found: dict[str, list[Any]] = {}
            for chunk in reader.stream(store=entry):
                found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
            self._batches.append(found)

    def entities(self, recording: int = 0) -> set[str]:
        return set(self._batches[recording])

    def columns(self, entity: str, recording: int = 0) -> set[str]:
        """The names of an entity's components and timelines."""
        return {name for batch in self._batches[recording][entity] for name in batch.schema.names}

    def rows(self, entity: str, component: str, recording: int = 0) -> list[Any]:
        """Of a component or a timeline, in the order they were sent, without those that break lines."""
        rows = self._sent(entity, component, recording)
        breaks = set(self.breaks(entity, recording))
        return [row for i, row in enumerate(rows) if i not in breaks or component.startswith("Series")]

    def _sent(self, entity: str, component: str, recording: int) -> list[Any]:
        batches = [b for b in self._batches[recording][entity] if component in b.schema.names]
        batches.sort(key=lambda batch: batch.column("rerun.controls.RowId")[0].as_py())
        return [row for batch in batches for row in _values(batch.column(component))]

    def breaks(self, entity: str, recording: int = 0) -> list[int]:
        """The rows of numbers that break lines: of NaN, at the time of the next row."""
        values = self._sent(entity, "Scalars:scalars", recording)
        steps = self._sent(entity, "step", recording)
        return [
            i
            for i in range(min(len(values), len(steps)) - 1)
            if steps[i] == steps[i + 1] and np.isnan(values[i]).all()
        ]

    def scalars(self, entity: str, recording: int = 0) -> np.ndarray:
        return np.array(self.rows(entity, "Scalars:scalars", recording))

    def held(self, entity: str, rows: int, recording: int = 0) -> list[str]:
        """The state of a lane at each step: what was sent last."""
        sent = dict(
            zip(
                self.rows(entity, "step", recording),
                self.rows(entity, "StateChange:state", recording),
                strict=True,
            )
        )
        states: list[str] = []
        for step in range(rows):
            states.append(sent[step][0] if step in sent else states[-1])
        return states
