"""Where benchmarks, artifacts and recordings live.

base             the contract of a storage, and who sees what is in it
files/, api/     `FileStorage`: a directory; `TupliAPIClient`: a server
at, exchange     which of them a path or URL stands for; from one to another
bundles/         a benchmark with all that it needs in one file
catalog/         the database that finds episodes
listing          recordings below any directory: found, listed, read by episodes
sidecar          what is noted beside recordings: deletions, publications
benchmark_json   a benchmark as text
from_values      episodes made of values: their spaces, and the form that these ask for
downloads        files fetched from elsewhere, kept for a while
verify           whether all of it is whole
atomic, texts    whole files, the lock between processes, and the texts in files
"""

from tupli_mcap.storage.api import TupliAPIClient
from tupli_mcap.storage.at import storage_at
from tupli_mcap.storage.base import TupliStorage, TupliStorageError
from tupli_mcap.storage.files import FileStorage

__all__ = ["FileStorage", "TupliAPIClient", "TupliStorage", "TupliStorageError", "storage_at"]
