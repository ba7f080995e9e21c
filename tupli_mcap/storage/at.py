"""Opens the storage at a path or URL."""

from __future__ import annotations

import glob
import os
from pathlib import Path

from tupli_mcap.errors import StorageError
from tupli_mcap.files import is_directory
from tupli_mcap.remote import in_home, is_url, shown
from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.base import TupliStorage
from tupli_mcap.storage.files import FileStorage


def storage_at(place: TupliStorage | str | os.PathLike[str], *, existing: bool = False) -> TupliStorage:
    """The storage at the address of a server, or in a directory, which need not exist unless `existing`; a storage is
    returned as it is.

    Raises:
        StorageError: `place` is none of these, is the path of recordings, or has to exist and does not.
    """
    if isinstance(place, TupliStorage):
        return place
    if not isinstance(place, str | os.PathLike) or not os.fspath(place):
        raise StorageError(f"expected a storage, or the path of its directory, found {place!r:.80}")
    name = os.fspath(place)
    of_recordings = glob.has_magic(name) or name.endswith(".mcap")
    if name.startswith(("http://", "https://")) and not of_recordings:
        return TupliAPIClient(name)
    if is_url(name) or of_recordings:
        raise StorageError(
            f"expected the directory of a storage, found {shown(name)!r:.80}, which is no address of a server either; "
            "recordings are opened with tupli_mcap.open(...)"
        )
    path = in_home(Path(place))
    if existing and not is_directory(path):
        raise StorageError(f"there is no storage at {name!r:.200}; give the directory of one")
    return FileStorage(path)
