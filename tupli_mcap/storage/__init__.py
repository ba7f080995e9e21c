"""Storages of benchmarks, artifacts and recordings.

base             the contract of a storage, and groups that see its items
files/, api/     `FileStorage`: a directory; `TupliAPIClient`: a server
at, exchange     opens the storage at a path or URL; copies between storages
bundles/         a benchmark with everything that it needs in one file
catalog/         the database that finds episodes
listing          finds, lists and reads recordings below any directory
sidecar          notes beside recordings: deletions, publications
benchmark_json   a benchmark as text
from_values      episodes made from values: infers their spaces, and fits the values to these
downloads        a cache of downloaded files
verify           verifies a storage
atomic, texts    atomic writes, the lock between processes, and the texts in files
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tupli_mcap.lazy import imported_on_use

if TYPE_CHECKING:
    from tupli_mcap.storage.api import TupliAPIClient
    from tupli_mcap.storage.at import storage_at
    from tupli_mcap.storage.base import TupliStorage, TupliStorageError
    from tupli_mcap.storage.files import FileStorage

# Imported on first use: what reads files needs no database and no client.
__getattr__ = imported_on_use(
    globals(),
    {
        "api": "TupliAPIClient",
        "at": "storage_at",
        "base": "TupliStorage TupliStorageError",
        "files": "FileStorage",
    },
)

__all__ = ["FileStorage", "TupliAPIClient", "TupliStorage", "TupliStorageError", "storage_at"]
