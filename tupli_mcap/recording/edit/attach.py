"""Adds attachments to a finished recording; everything else in it stays unchanged, byte for byte."""

from __future__ import annotations

import contextlib
import errno
import os
import shlex
import stat
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from tupli_mcap.errors import RecordingError, no_file, os_reason
from tupli_mcap.files import is_there
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.lock import FileLock
from tupli_mcap.mcap.source import PathSource, Source
from tupli_mcap.recording.contents import Contents
from tupli_mcap.recording.edit.assemble import Assembler, replacing
from tupli_mcap.recording.index import IndexBuilder
from tupli_mcap.recording.opened import read_contents
from tupli_mcap.recording.write.resume import restore_container

_COPY = 1 << 22


def add_attachments(path: str | os.PathLike[str], attachments: Mapping[str, tuple[str, bytes]]) -> None:
    """Adds attachments (name -> media type, bytes) behind the chunks of a recording, or replaces those of their name.

    The file is replaced in one rename, so that it is always the old one or the new one.

    Raises:
        RecordingError: the recording is not finished, is being written, or cannot be written.
        FormatError: it is damaged.
    """
    with held(path) as place:
        attach(place, attachments)


@contextlib.contextmanager
def held(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Locks the file at a path against other writers for the block; yields the path with symbolic links followed.

    If a new attachment depends on the old one, read the old one within the block, then `attach` the new one.

    RecordingError if there is no file, or another writer holds the lock for longer than a moment.
    """
    # the file that a symbolic link names is replaced, not the link; any other path stays as given, for messages
    place = Path(os.path.realpath(path) if os.path.islink(path) else path)  # noqa: PTH114
    if not is_there(place):
        raise no_file(Path(path), "give the path of a recording (.mcap)")
    lock = FileLock(place, "a")
    try:
        yield place
    finally:
        lock.release()


def attach(path: Path, attachments: Mapping[str, tuple[str, bytes]], *, without: Sequence[str] = ()) -> None:
    """`add_attachments` to a file that is `held`; attachments that `without` names are removed."""
    with contextlib.closing(PathSource(path)) as source:
        contents = read_contents(source)
        check_attachable(path, finished=contents.complete)
        with replacing(path, 0o600, held=True) as (fd, _):
            container = Container(fd, str(path), "zstd")
            restore_container(container, contents, source)
            _write(container, source, contents, attachments, {*attachments, *without})
            os.fchmod(fd, stat.S_IMODE(path.stat().st_mode))


def check_attachable(path: Path, *, finished: bool) -> None:
    """Raises RecordingError if nothing can be attached to a recording: it is not finished, or its directory is not
    writable."""
    if not finished:
        raise RecordingError(
            f"{path} is not finished, so nothing can be attached to it; finish it with: "
            f"tupli-mcap recover --in-place {shlex.quote(str(path))}"
        )
    if not os.access(path.parent, os.W_OK | os.X_OK):
        refused = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        raise RecordingError(f"{path} cannot be written: its directory: {os_reason(refused)}")


def _write(
    container: Container,
    source: Source,
    contents: Contents,
    attachments: Mapping[str, tuple[str, bytes]],
    gone: Collection[str],
) -> None:
    """Copies the file and writes its end anew: without the old attachments that are `gone`, and with new ones."""
    kept = [index for index in container.attachment_indexes if index.name not in gone]
    # if a replaced attachment is the last one its bytes are dropped; otherwise they stay, unreferenced
    last = max(container.attachment_indexes, key=lambda index: index.offset, default=None)
    end = contents.data_end
    if last is not None and last not in kept and last.offset + last.length == end:
        end = last.offset
    container.attachment_indexes = kept
    for start in range(0, end, _COPY):
        container.write(source.read(start, min(_COPY, end - start)))
    now = time.time_ns()
    for name, (media_type, data) in attachments.items():
        container.add_attachment(name, media_type, data, now)
    assembler = Assembler(container)
    assembler.index = IndexBuilder(contents.index)
    assembler.finish(now)
