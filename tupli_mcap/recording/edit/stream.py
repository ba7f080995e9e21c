"""Yields the bytes of a recording of some episodes while it is made."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Generator, Sequence
from contextlib import AbstractContextManager

from tupli_mcap.mcap.container import COMPRESSIONS, Container
from tupli_mcap.progress import alone
from tupli_mcap.recording.about.described import MADE_OF_NAME
from tupli_mcap.recording.edit.merge import Excerpt, merge_excerpts
from tupli_mcap.recording.edit.rewrite import kept_metadata, write

_PIECE = 1 << 16  # bytes that a pipe holds


def stream_excerpts(
    opening: AbstractContextManager[Sequence[Excerpt]], without: Collection[str] = ()
) -> Generator[bytes]:
    """The bytes of a recording of these episodes, made as fast as the caller takes them; no excerpt may be empty.

    Episodes of one recording keep their numbers, and the recording its UUID. Excerpts of several recordings, or
    `without` some fields ("states", "actions", "infos", "frames"), are merged as by `merge_recordings`. A separate
    thread opens the recordings, writes, and closes them; it ends when the iterator is closed.

    Raises:
        SpaceError, RecordingError: the recordings cannot be merged.
        FormatError: a recording is damaged.
    """

    def send(fd: int) -> None:
        with alone(), opening as excerpts:  # a server's terminal shows no bars of its downloads
            first = excerpts[0]
            source, rows = first.recording, first.rows
            # the source's compression, so that chunks can be copied as they are
            compression = COMPRESSIONS[int(source.file.store.table["compression"][0])]
            container = Container(fd, source.name, compression)
            if len(excerpts) > 1 or without:
                merge_excerpts(excerpts, container, without)
                return
            whole = len(rows) == len(source)
            numbers = None if whole else rows["episode"].tolist()
            metadata = {**kept_metadata(source), "next_episode": str(first.next_episode)}
            # what it was made of tells how many others there are
            left_out = (MADE_OF_NAME,) if first.alone else ()
            write(source, container, metadata, numbers, {}, signed=whole, left_out=left_out)

    return _through_a_pipe(send)


def _through_a_pipe(write: Callable[[int], None]) -> Generator[bytes]:
    """The bytes that `write` writes to a descriptor on a separate thread; its errors are raised here."""
    reading, writing = os.pipe()
    failed: list[BaseException] = []

    def work() -> None:
        try:
            write(writing)
        except BaseException as err:  # noqa: BLE001 - raised where the pieces are taken
            failed.append(err)
        finally:
            os.close(writing)

    thread = threading.Thread(target=work, name="tupli-stream", daemon=True)
    try:
        thread.start()
        while piece := os.read(reading, _PIECE):
            yield piece
    finally:
        os.close(reading)  # a thread that still writes gets an error
    thread.join()
    if failed:
        raise failed[0]
