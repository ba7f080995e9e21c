"""Adds attachments to a finished recording; everything else in it stays unchanged, byte for byte."""

from __future__ import annotations

import contextlib
import errno
import os
import shlex
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path

from mcap.opcode import Opcode

from tupli_mcap.errors import FormatError, RecordingError, no_file, os_reason
from tupli_mcap.files import is_there
from tupli_mcap.mcap.container import Container
from tupli_mcap.mcap.lock import FileLock
from tupli_mcap.mcap.records import RECORD
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
        with replacing(path, held=True) as (fd, _):
            _write(Container(fd, str(path), "zstd"), source, contents, attachments, {*attachments, *without})


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
    """Copies the file without the old attachments that are `gone`, and writes its end anew, with new ones.

    No bytes of theirs stay: a reader that goes through the file, as after a lost end, would find them.
    """
    old = sorted(contents.attachments.values(), key=lambda index: index.offset)
    left_out = [(index.offset, index.length) for index in old if index.name in gone]
    for offset, length in left_out:  # a summary that lies must not have other records left out
        if RECORD.unpack(source.read(offset, RECORD.size)) != (Opcode.ATTACHMENT, length - RECORD.size):
            raise FormatError(f"{source.name}: expected an attachment of {length} bytes at offset {offset}")
    restore_container(container, contents, source, left_out)
    container.attachment_indexes = [index for index in container.attachment_indexes if index.name not in gone]
    start = 0
    for stop, length in [*left_out, (contents.data_end, 0)]:
        for at in range(start, stop, _COPY):
            container.write(source.read(at, min(_COPY, stop - at)))
        start = stop + length
    now = time.time_ns()
    for name, (media_type, data) in attachments.items():
        container.add_attachment(name, media_type, data, now)
    assembler = Assembler(container)
    assembler.index = IndexBuilder(contents.index)
    assembler.finish(now)
