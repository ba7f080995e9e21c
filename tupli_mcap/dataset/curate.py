"""A recording of the episodes that a filter is true of."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from tupli_mcap.dataset.which import candidates
from tupli_mcap.errors import RecordingError
from tupli_mcap.recording import Recording, rewrite_recording
from tupli_mcap.schema import BaseFilter, parse_filter

__all__ = ["FilterReport", "filter_recording"]


class FilterReport(NamedTuple):
    """What a filter kept of a recording, or would keep; `size` in bytes, 0 where nothing was written."""

    path: Path
    episodes: int
    steps: int
    left_out: int
    size: int = 0


def filter_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    filter: BaseFilter | str,
    *,
    compression: str = "zstd",
    overwrite: bool = False,
    dry_run: bool = False,
) -> FilterReport:
    """Writes the episodes that a filter (or its text, such as "metadata.score > 3") is true of to `target`.

    They keep their ids, and all that belongs to them comes along; a signature is left out.

    Raises:
        FilterError: the filter names what episodes do not have.
        RecordingError: it is true of no episode; the target exists (and not `overwrite`) or cannot be written.
        FormatError: the source is damaged.
    """
    target = Path(target)
    wanted = parse_filter(filter) if isinstance(filter, str) else filter
    with Recording(source) as recording:
        if target.exists():
            if recording.path is not None and target.samefile(recording.path):
                raise RecordingError(f"{target} is the recording itself; write to another path")
            if not overwrite:
                raise RecordingError(f"{target} exists; choose another path, or overwrite it")
        positions = candidates(recording, wanted)
        if not len(positions):
            raise RecordingError(f"{recording.name} has no episode that {wanted} is true of")
        rows = recording.index[positions]
        steps, left_out = int(rows["length"].sum()), len(recording) - len(rows)
        report = FilterReport(target, len(rows), steps, left_out)
        if dry_run:
            return report
        rewrite_recording(recording, target, episodes=rows["episode"].tolist(), compression=compression)
    return report._replace(size=target.stat().st_size)
