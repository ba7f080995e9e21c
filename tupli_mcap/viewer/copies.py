"""`replay --to-mcap`: a copy of a recording that stock viewers plot at once, and the layout Foxglove needs for it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tupli_mcap.dataset.which import Source, chosen_from
from tupli_mcap.errors import RecordingError
from tupli_mcap.viewer.companions import write_companions
from tupli_mcap.viewer.foxglove_layout import write_layout

__all__ = ["Copies", "to_mcap"]


class Copies(NamedTuple):
    """The files that were written."""

    recording: Path
    layout: Path


def to_mcap(
    sources: Source | Sequence[Source],
    target: str | os.PathLike[str],
    episodes: str | Sequence[int] | None = None,
    *,
    filter: Any = None,
    layout: str | os.PathLike[str] | None = None,
    force: bool = False,
) -> Copies:
    """Writes a copy with companion channels, and beside it (or at `layout`) a layout to import into Foxglove.

    Args:
        sources, episodes, filter: as `tupli_mcap.viewer.save` has them, of one recording.
        force: replace files that exist.

    Raises:
        RecordingError: more than one recording, no such episode, or a file that exists, is the recording itself, has
            another ending than `.mcap`, or cannot be written.
        FormatError: the recording is damaged.
    """
    target = Path(target)
    place = target.with_suffix(".foxglove-layout.json") if layout is None else Path(layout)
    if target.suffix != ".mcap":
        raise RecordingError(
            f"expected a name that ends in .mcap, by which viewers know such files, found {str(target)!r}"
        )
    if place.exists() and not force:
        raise RecordingError(f"{place} exists already; choose another name, or replace it with --force")
    for goal in (target, place):  # neither is written if the other cannot be
        if not goal.parent.is_dir():
            raise RecordingError(
                f"{goal} cannot be written: there is no directory {str(goal.parent)!r}; make it first"
            )
    with chosen_from(sources, episodes, filter) as chosen:
        if len(chosen) != 1:
            raise RecordingError(f"expected one recording to copy, found {len(chosen)}; copy them one by one")
        ((recording, positions),) = chosen
        if recording.path is not None and any(_is_same(goal, recording.path) for goal in (target, place)):
            raise RecordingError(
                f"{recording.path} is the recording, which is never written over; give another name"
            )
        everything = len(positions) == len(recording)
        numbers = None if everything else recording.index["episode"][list(positions)].tolist()
        write_companions(recording, target, episodes=numbers, force=force)
        return Copies(target, write_layout(recording, place))


def _is_same(goal: Path, source: Path) -> bool:
    return goal.exists() and goal.samefile(source)
