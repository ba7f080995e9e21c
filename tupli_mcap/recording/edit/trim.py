"""Writes a recording whose episodes begin later or end earlier; everything else stays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from tupli_mcap.errors import RecordingError
from tupli_mcap.mcap.container import Container
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.copy_episodes import Trim
from tupli_mcap.recording.edit.merge import Excerpt, check_target, merge_excerpts
from tupli_mcap.recording.edit.rewrite import return_of
from tupli_mcap.recording.episode import Episode
from tupli_mcap.recording.index import chosen_numbers
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.write.rows.variable import final_encoder


class TrimReport(NamedTuple):
    """The result of a trim, or of a dry run: `left_out` steps; `size` of the file (bytes), 0 if none was written."""

    path: Path
    episodes: int
    steps: int
    left_out: int
    size: int = 0


def trim_recording(
    source: Recording,
    target: Path,
    steps: Mapping[int, slice],
    *,
    episodes: Sequence[int] | None = None,
    overwrite: bool = False,
    made: Mapping[str, Any] = MappingProxyType({}),
) -> TrimReport:
    """Writes `target` with only some consecutive steps of some episodes.

    An episode that loses its end ends as interrupted, and the state that followed is its final state; whether it
    succeeded is not known, so its recorded metadata have no `success`. An episode that loses its beginning has no seed,
    no options and no reset info, because no reset leads to its first state. Steps are numbered from 0, returns are
    those of the steps that stay; other metadata, and annotations, stay. The recording has a new UUID and no signature.

    Args:
        source: the recording to read.
        target: path of the new one.
        steps: by number of the episode, the steps that stay; other episodes stay whole.
        episodes: numbers of the episodes to keep (all by default).
        overwrite: replace a target that exists.
        made: further facts for `made_of.json`.

    Raises:
        RecordingError: there is no such episode, none of its steps would stay, or they are not consecutive; the target
            exists (and not `overwrite`), or cannot be written.
    """
    check_target(target, [source], overwrite=overwrite)
    trims = trims_of(source, steps)
    chosen = chosen_numbers(source.index, episodes, source.name)
    rows = source.index[np.isin(source.index["episode"], chosen)]
    if not len(rows):
        raise RecordingError(f"{source.name}: expected episodes to trim, found none")
    lengths = dict(zip(rows["episode"].tolist(), rows["length"].tolist(), strict=True))
    left_out = sum(
        lengths[number] - (trim.stop - trim.start) for number, trim in trims.items() if number in lengths
    )
    with replacing(target, overwrite=overwrite) as (fd, _):
        made = {**made, "how": "trim"}
        merge_excerpts([Excerpt(source, rows, trims)], Container(fd, str(target), "zstd"), made=made)
    return TrimReport(target, len(rows), sum(lengths.values()) - left_out, left_out, target.stat().st_size)


def trims_of(source: Recording, steps: Mapping[int, slice]) -> dict[int, Trim]:
    """The trims of those episodes of which not all steps stay. Raises RecordingError as `trim_recording` does."""
    numbers = chosen_numbers(source.index, steps, source.name)
    places = np.searchsorted(source.index["episode"], numbers).tolist()
    found = {n: _trim(source, source.episodes[i], steps[n]) for n, i in zip(numbers, places, strict=True)}
    return {number: trim for number, trim in found.items() if trim is not None}


def _trim(source: Recording, episode: Episode, kept: slice) -> Trim | None:
    """The trim of an episode; None if all steps stay."""
    try:
        start, stop, stride = kept.indices(len(episode))
    except (TypeError, ValueError) as err:
        raise RecordingError(f"expected a slice of steps, found {kept}: {err}") from err
    if stride != 1:
        raise RecordingError(f"expected consecutive steps, found a stride of {stride}")
    if stop <= start:
        raise RecordingError(
            f"{source.name}: no step of episode {episode.number} would stay, which has {len(episode)}; "
            "leave it out, or keep more"
        )
    if (start, stop) == (0, len(episode)):
        return None
    layout = source.layout
    total = return_of(layout, episode[start:stop].rewards, stop - start)
    final = None if stop == len(episode) else final_encoder(layout)(episode[stop].state)
    return Trim(start, stop, total, final)
