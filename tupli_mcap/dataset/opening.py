"""`open`: the dataset of a path, a pattern, a URL, a storage, a recording, or a list of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, TypeAlias

from tupli_mcap.dataset.dataset import Dataset
from tupli_mcap.dataset.sources import DatasetError, FilesSource, StorageSource, files_at, place_of
from tupli_mcap.errors import asking
from tupli_mcap.files import is_directory
from tupli_mcap.recording import Recording
from tupli_mcap.remote import in_home, is_server, is_url, path_of, shown
from tupli_mcap.storage import TupliStorage
from tupli_mcap.storage.listing import is_storage, recordings_at

if TYPE_CHECKING:
    from tupli_mcap.dataset.tupli import TupliDataset

Openable: TypeAlias = "str | os.PathLike[str] | Recording | TupliStorage | Dataset | TupliDataset"


def open(source: Openable | Iterable[Openable]) -> Dataset:  # noqa: A001 - as in gzip.open
    """The episodes of a file, a pattern ("runs/*.mcap"), a directory, a storage, a recording, a `TupliDataset`, a URL
    of a file, of a pattern in a bucket ("s3://lab/runs/*.mcap") or of a server ("http://lab:8080"), or a list of them,
    without servers and datasets, which `+` joins.

    An episode that is in two of the files counts once, with a warning: that of the file with more episodes, if they are
    copies of one recording that differ. A recording that was made of others has episodes of its own, which count beside
    theirs, also with a warning. An episode that is still being recorded has the steps so far, and ends as interrupted.

        ds = tupli_mcap.open("runs/")
        best = ds.filter("return > 100").sort("return", descending=True).head(10)

    Files are opened when their episodes are needed; their errors are raised then.

    Raises:
        RecordingError: there is no such file.
        DatasetError: it is none of these.
        StorageError: the directory cannot be read.
    """
    if isinstance(source, Dataset):
        return source
    if isinstance(source, TupliStorage):
        return Dataset(StorageSource(source))
    if isinstance(source, Recording):
        return Dataset(FilesSource([place_of(source)]))
    if isinstance(source, str | os.PathLike):
        name = os.fspath(source)
        folder = in_home(path_of(name))
        if is_server(name):
            from tupli_mcap.storage import TupliAPIClient

            return Dataset(StorageSource(TupliAPIClient(name)))
        if is_url(name) or not is_directory(folder):
            return Dataset(FilesSource(source))
        files = recordings_at(folder)
        if is_storage(folder) or not files:
            from tupli_mcap.storage import FileStorage  # and with it a database, which files do not need

            return Dataset(StorageSource(FileStorage(folder)))
        return Dataset(FilesSource(files, of_directory=True))
    from tupli_mcap.dataset.tupli import TupliDataset

    if isinstance(source, TupliDataset):  # before other iterables: it iterates over its steps
        return source.dataset
    if not isinstance(source, Iterable):
        raise DatasetError(
            f"expected a path, a pattern, a URL, a storage, or a list of those, found {source!r:.80}"
        )
    return Dataset(FilesSource([name for item in source for name in _files_in(item)]))


def _files_in(source: Openable) -> Sequence[str]:
    """The recordings of one source."""
    if isinstance(source, Recording):
        return [place_of(source)]
    if isinstance(source, str | os.PathLike):
        if isinstance(source, str) and is_server(source):
            joined = asking("join datasets with +", "fetch its recordings with tupli-mcap pull")
            raise DatasetError(
                f"expected paths, patterns, and URLs of files in a list, found the server {shown(source)}; "
                f"open a server by itself, and {joined}"
            )
        return files_at(source)
    from tupli_mcap.storage import FileStorage

    if isinstance(source, FileStorage):
        return recordings_at(source.root)
    raise DatasetError(
        f"expected paths, patterns, URLs and recordings in a list, found {source!r:.80}; "
        "open a server by itself, and join datasets with +"
    )
