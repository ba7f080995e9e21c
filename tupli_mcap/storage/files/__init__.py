"""A storage in a directory, which looks so:

benchmarks/<id>.json, <id>.cloudpickle     the environment, as data or as trusted code
artifacts/<sha256>, <sha256>.json          bytes, and what is known of them
recordings/<benchmark id>/<name>.mcap      episodes; `<name>.mcap.json` notes deletions and publications
storage.json                               declared keys
deleting.json                              a deletion from several recordings, while it is done

file_storage            `FileStorage`: the contract of a storage
benchmarks, artifacts   these files, and what is known of them
recordings              where episodes lie; what is noted, deleted and freed of them
sync                    the catalog, which lies elsewhere, brought up to date before each question
"""

from tupli_mcap.storage.files.file_storage import FileStorage

__all__ = ["FileStorage"]
