"""Where benchmarks, artifacts and recordings live."""

from tupli_mcap.storage.base import TupliStorage, TupliStorageError
from tupli_mcap.storage.files import FileStorage

__all__ = ["FileStorage", "TupliStorage", "TupliStorageError"]
