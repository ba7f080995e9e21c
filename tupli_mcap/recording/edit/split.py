"""Splits a recording into several."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tupli_mcap.arrays import Array
from tupli_mcap.errors import RecordingError
from tupli_mcap.mcap.container import Container
from tupli_mcap.recording.edit.assemble import replacing
from tupli_mcap.recording.edit.merge import Excerpt, merge_excerpts
from tupli_mcap.recording.edit.rewrite import warn_of_signatures
from tupli_mcap.recording.recording import Recording
from tupli_mcap.recording.write.options import check_name
from tupli_mcap.recording.write.rotation import series


class Part(NamedTuple):
    """One of the files that a recording is split into; it has the episodes with the numbers `first` to `last`."""

    path: Path
    episodes: int
    steps: int
    first: int
    last: int
    copied: int = 0
    size: int = 0


def split_recording(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    *,
    episodes: int | None = None,
    max_bytes: int | None = None,
    compression: str = "zstd",
    dry_run: bool = False,
    positions: Callable[[Recording], Array] | None = None,
) -> list[Part]:
    """Writes the episodes of a recording to `target`, and to target_0001, … beside it, each with a new UUID.

    Episodes keep their numbers and everything else but signature and certificate, which would not fit.

    Args:
        source: the recording.
        target: path of the first file.
        episodes: number of episodes in each file.
        max_bytes: size of each file, assuming that all steps take the same number of bytes; at least one episode.
        compression: "zstd", "lz4" or "none".
        dry_run: only report.
        positions: returns the positions of the episodes to write; by default of all.

    Raises:
        RecordingError: neither limit is given, or both; the source cannot be read; a target exists or cannot be
            written.
        FormatError: the source is damaged.
    """
    limit = episodes if max_bytes is None else max_bytes
    if (episodes is None) == (max_bytes is None) or not isinstance(limit, int | np.integer) or limit < 1:
        raise RecordingError(
            "expected either a number of episodes or of bytes for each file, at least 1, found "
            f"episodes={episodes!r:.40} and max_bytes={max_bytes!r:.40}"
        )
    check_name(target)
    target = Path(target)
    with Recording(source) as recording:
        rows = recording.index if positions is None else recording.index[positions(recording)]
        groups = _groups(recording, rows, episodes, max_bytes)
        paths = [target.with_stem(f"{target.stem}_{i:04}") if i else target for i in range(len(groups))]
        taken = [path for path in (target, *series(target)[1].values()) if os.path.lexists(path)]
        if taken:
            raise RecordingError(f"{taken[0]} exists; choose another path")
        warn_of_signatures([recording])
        parts: list[Part] = []
        with _none_if_one_fails([] if dry_run else parts):
            for path, some in zip(paths, groups, strict=True):
                first, last = some["episode"][[0, -1]].tolist()
                part = Part(path, len(some), int(some["length"].sum()), first, last)
                parts.append(part if dry_run else _write_part(recording, some, part, compression))
    return parts


@contextlib.contextmanager
def _none_if_one_fails(parts: Sequence[Part]) -> Iterator[None]:
    """Removes the parts that were written if the block fails: without the others, they would be taken for all."""
    try:
        yield
    except BaseException:
        for part in parts:
            with contextlib.suppress(OSError):  # the first error says more
                part.path.unlink()
        raise


def _groups(recording: Recording, rows: Array, episodes: int | None, max_bytes: int | None) -> list[Array]:
    """The index rows of the episodes in `rows`, by file."""
    if not len(rows):
        raise RecordingError(f"{recording.name} has no episodes to split")
    if episodes is not None:
        return [rows[at : at + episodes] for at in range(0, len(rows), episodes)]
    attached = sum(info.size for info in recording.attachments.values())
    share = max(1, recording.size - attached) / int(recording.index["length"].sum())
    room, groups, begin, filled = max(1, (max_bytes or 0) - attached), [], 0, 0.0
    for i, size in enumerate((rows["length"] * share).tolist()):
        if filled and filled + size > room:
            groups.append(rows[begin:i])
            begin, filled = i, 0.0
        filled += size
    return [*groups, rows[begin:]]


def _write_part(recording: Recording, rows: Array, part: Part, compression: str) -> Part:
    with replacing(part.path, overwrite=False) as (fd, _):
        container = Container(fd, str(part.path), compression)
        copied = merge_excerpts([Excerpt(recording, rows)], container, made={"how": "split"}).copied
    return part._replace(copied=copied, size=part.path.stat().st_size)
