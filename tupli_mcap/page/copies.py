"""Chosen episodes as files: one recording, one Rerun recording, one film."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from tupli_mcap.dataset.dataset import Dataset
from tupli_mcap.page.shelf import Shelf
from tupli_mcap.recording import Recording
from tupli_mcap.schema import BaseFilter, BenchmarkHeader, EpisodeHeader

__all__ = ["MOST_COMPARED", "film_file", "recording_file", "replay_file"]

MOST_COMPARED = 8


class _Source:
    """A dataset's source that opens what a shelf shows."""

    def __init__(self, shelf: Shelf) -> None:
        self._shelf = shelf

    def benchmarks(self, filter: BaseFilter | None) -> list[BenchmarkHeader]:
        return []

    def episodes(
        self,
        benchmark_filter: BaseFilter | None,
        episode_filter: BaseFilter | None,
        seen: dict[str, Recording] | None = None,
    ) -> list[EpisodeHeader]:
        return []

    def explain(self, benchmark_filter: BaseFilter | None, episode_filter: BaseFilter | None) -> str:
        return ""

    def open(self, recording: str) -> Recording:
        return self._shelf.open(recording)


def recording_file(shelf: Shelf, headers: Sequence[EpisodeHeader]) -> Path:
    """A recording of exactly these episodes, in a directory of its own that the caller removes.

    Raises:
        RecordingError: they cannot be one recording.
        SpaceError: they have different spaces.
    """
    with _folder() as folder:
        return Dataset(_Source(shelf), headers).save(folder / "episodes.mcap")


def replay_file(shelf: Shelf, headers: Sequence[EpisodeHeader]) -> Path:
    """An episode with its blueprint for the Rerun viewer, or several in the same plots; likewise.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
        RecordingError: they cannot be compared.
    """
    from tupli_mcap.dataset.which import Chosen
    from tupli_mcap.viewer.plan import plans_of
    from tupli_mcap.viewer.targets import to_file

    chosen = []
    for name, group in itertools.groupby(headers, key=lambda header: header.recording):
        recording = shelf.open(name)
        numbers = recording.index["episode"]
        positions = [int(numbers.searchsorted(header.episode)) for header in group]
        chosen.append(Chosen(recording, positions))
    with _folder() as folder:
        return to_file(
            plans_of(chosen, "joined" if len(headers) == 1 else "compare"), folder / "episodes.rrd"
        )


def film_file(shelf: Shelf, header: EpisodeHeader) -> Path:
    """The pictures of an episode as MP4; likewise.

    Raises:
        MissingExtraError: PyAV is not installed.
        RecordingError: there are no pictures.
    """
    from tupli_mcap.replay import film

    recording = shelf.open(header.recording)
    position = int(recording.index["episode"].searchsorted(header.episode))
    with _folder() as folder:
        film([recording.episodes[position]], folder / "episode.mp4")
        return folder / "episode.mp4"


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """A temporary directory, which stays if nothing fails."""
    folder = Path(tempfile.mkdtemp(prefix="tupli-mcap-"))
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
