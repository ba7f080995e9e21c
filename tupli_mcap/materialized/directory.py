"""The directory of columns: replaced as a whole, under a lock, so that nobody takes half of it for all.

A writer fills `.writing-*` beside the columns. Then it takes the old manifest away, moves its files over the old ones,
and its manifest last. Columns without a manifest are none: a writer that is killed leaves the old ones, or none. Who
has mapped the old files keeps them.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tupli_mcap import files
from tupli_mcap.errors import FormatError, StorageError
from tupli_mcap.materialized.manifest import MANIFEST, Manifest
from tupli_mcap.recording.lock import drop_private
from tupli_mcap.storage.atomic import locked
from tupli_mcap.system import refused

__all__ = ["Stage", "exclusive", "published"]

_LOCK = ".tupli_mcap.lock"
_WRITING = ".writing-"
_THREADS = 8
_COLUMN = re.compile(r"[a-z0-9_]+(\.offsets)?\.npy|[a-z0-9_]+\.values\.bin")


@contextlib.contextmanager
def exclusive(directory: Path) -> Iterator[None]:
    """Keeps other writers (processes and threads) of a directory out, which is made if it is missing.

    Raises:
        StorageError: the directory holds something else, or the system refuses.
    """
    with _refusals_told(directory):
        directory.mkdir(parents=True, exist_ok=True)
        _check_ours(directory)
        fd = locked(directory / _LOCK)
    try:
        yield
    finally:
        drop_private(fd)


def _check_ours(directory: Path) -> None:
    names = {path.name for path in directory.iterdir()}
    if names and not names & {_LOCK, MANIFEST}:
        raise StorageError(
            f"expected an empty directory or one of columns at {directory}, found {sorted(names)[0]!r:.80} in it; "
            "choose another one"
        )
    if _LOCK not in names and MANIFEST in names:
        try:
            Manifest.read(directory)
        except FormatError as err:
            raise StorageError(
                f"{directory} holds a {MANIFEST} of something else; choose another directory ({err})"
            ) from err


class Stage:
    """A directory to write columns to, that `published` puts into place once it has a manifest."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest: Manifest | None = None


@contextlib.contextmanager
def published(directory: Path) -> Iterator[Stage]:
    """A stage, whose columns are those of the directory once the block ends without an error. Within `exclusive`.

    Raises:
        StorageError: the system refuses: a full disk, for example. The directory is as it was.
    """
    with _refusals_told(directory):
        for left in directory.glob(f"{_WRITING}*"):  # of killed writers: a living one holds the lock
            shutil.rmtree(left, ignore_errors=True)
        path = Path(tempfile.mkdtemp(prefix=_WRITING, dir=directory))
    stage = Stage(path)
    try:
        with _refusals_told(directory):
            yield stage
            if stage.manifest is None:
                raise StorageError(f"the columns of {directory} have no manifest")
            _publish(directory, path, stage.manifest)
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _publish(directory: Path, stage: Path, manifest: Manifest) -> None:
    staged = stage / MANIFEST
    staged.write_bytes(manifest.to_bytes())
    with ThreadPoolExecutor(_THREADS) as pool:  # a disk writes many files in the time of one
        list(pool.map(files.sync, stage.iterdir()))
    (directory / MANIFEST).unlink(missing_ok=True)
    files.sync(directory)
    for path in list(directory.iterdir()):
        if path.name not in manifest.files and _COLUMN.fullmatch(path.name):
            path.unlink()
    for name in manifest.files:
        (stage / name).replace(directory / name)
    files.sync(directory)  # no manifest before its columns, after a power loss either
    staged.replace(directory / MANIFEST)
    files.sync(directory)


@contextlib.contextmanager
def _refusals_told(directory: Path) -> Iterator[None]:
    try:
        yield
    except OSError as err:
        raise StorageError(f"columns cannot be written to {directory}: {refused(err)}") from err
