"""A storage in a directory with these files:

benchmarks/<id>.json, <id>.cloudpickle     the environment, as data or as trusted code
artifacts/<sha256>, <sha256>.json          bytes, and their metadata
recordings/<benchmark id>/<name>.mcap      episodes; `<name>.mcap.json` notes deletions and publications
storage.json                               declared keys
deleting.json                              a deletion from several recordings, while it goes on

file_storage            `FileStorage`: the contract of a storage
benchmarks, artifacts   the files of these
recordings              the files of recordings: publishes, deletes and restores episodes, frees space
sync                    updates the catalog, which is elsewhere, before each query
"""

from tupli_mcap.storage.files.file_storage import FileStorage

__all__ = ["FileStorage"]
