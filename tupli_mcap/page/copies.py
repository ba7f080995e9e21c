"""Chosen episodes as files: one recording, one Rerun recording, one film."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import tempfile
from collections.abc import Collection, Generator, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from fastapi.responses import FileResponse, StreamingResponse
from starlette.background import BackgroundTask
from starlette.types import Receive, Scope, Send

from tupli_mcap.errors import NotFoundError, RecordingError, SpaceError
from tupli_mcap.page.shelf import Shelf, opened, position_in
from tupli_mcap.recording import Recording
from tupli_mcap.recording.edit.merge import Excerpt, UnmergeableError
from tupli_mcap.recording.edit.stream import stream_excerpts
from tupli_mcap.schema import EpisodeHeader

MOST_COMPARED = 8
MOST_CHOSEN = 1000  # most episodes that an address names
MOST_MERGED = 256
"""Most recordings of an answer: all of them are open at the same time."""
_MEDIA = "application/octet-stream"


def recording_of(shelf: Shelf, numbers_of: Mapping[str, Sequence[int]]) -> StreamingResponse:
    """An answer with one recording of some episodes, by recording and number; see `streamed`."""
    if len(numbers_of) > MOST_MERGED:
        raise UnmergeableError(
            f"expected episodes of at most {MOST_MERGED} recordings, found {len(numbers_of)}; choose fewer"
        )
    excerpts = []
    for name, numbers in numbers_of.items():
        recording = shelf.open(name, of=len(numbers_of))
        excerpts.append(Excerpt(recording, recording.index[np.isin(recording.index["episode"], numbers)]))
    return streamed(contextlib.nullcontext(excerpts))


def streamed(
    opening: AbstractContextManager[Sequence[Excerpt]], without: Collection[str] = (), **headers: str
) -> StreamingResponse:
    """An answer with one recording of these episodes, written while it is sent; see `stream_excerpts`. SpaceError or
    RecordingError if they cannot be merged; a later error ends the connection."""
    return in_pieces(stream_excerpts(opening, without), _MEDIA, **headers)


def in_pieces(pieces: Generator[bytes], media: str, **headers: str) -> StreamingResponse:
    """An answer that is made while it is sent. Errors of its first piece are raised; later ones end the connection."""
    return ClosingResponse(pieces, [next(pieces)], media_type=media, headers=headers)


class ClosingResponse(StreamingResponse):
    """An answer that closes its generator when it ends, also if the client disconnects. first: pieces that the
    generator has given already."""

    def __init__(self, pieces: Generator[bytes], first: Sequence[bytes] = (), **more: Any) -> None:
        super().__init__(itertools.chain(first, pieces), **more)
        self._pieces = pieces

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._pieces.close()


def replay_file(shelf: Shelf, headers: Sequence[EpisodeHeader]) -> Path:
    """Writes a temporary file for the Rerun viewer: one episode with its blueprint, or several in the same plots.
    MissingExtraError without rerun-sdk, SpaceError if the episodes have different spaces, NotFoundError if one is
    gone."""
    from tupli_mcap.dataset.chosen import Chosen
    from tupli_mcap.viewer.plan import plans_of
    from tupli_mcap.viewer.sdk import rerun_sdk
    from tupli_mcap.viewer.targets import to_file

    rerun_sdk()
    chosen = []
    for name, group in itertools.groupby(headers, key=lambda header: header.recording):
        recording = shelf.open(name)
        chosen.append(Chosen(recording, [position_in(recording, header) for header in group]))
    if not have_same_spaces([item.recording for item in chosen]):
        raise SpaceError(
            "expected episodes of the same spaces to compare in Rerun, found different ones; choose others"
        )
    with _folder() as folder:
        return to_file(
            plans_of(chosen, "joined" if len(headers) == 1 else "compare"), folder / "episodes.rrd"
        )


def have_same_spaces(recordings: Sequence[Recording]) -> bool:
    return all(one.layout.to_metadata() == recordings[0].layout.to_metadata() for one in recordings)


def film_file(shelf: Shelf, header: EpisodeHeader) -> Path:
    """Writes the pictures of an episode as a temporary MP4. MissingExtraError without PyAV, NotFoundError if the
    episode is gone, or has no pictures."""
    from tupli_mcap.reexecute import film

    episode = opened(shelf, header)
    with _folder() as folder:
        try:
            film([episode], folder / "episode.mp4")
        except RecordingError as err:
            raise NotFoundError(str(err)) from err
        return folder / "episode.mp4"


def sent(path: Path, name: str, media: str = _MEDIA) -> FileResponse:
    """An answer with a file whose directory is temporary, and removed after sending."""
    gone = BackgroundTask(shutil.rmtree, path.parent, ignore_errors=True)
    return FileResponse(path, media_type=media, filename=name, background=gone)


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """A temporary directory, removed only if the block fails."""
    folder = Path(tempfile.mkdtemp(prefix="tupli-mcap-"))
    try:
        yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
