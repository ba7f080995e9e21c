"""Bundles: one recording that carries its benchmark and all artifacts, so that nothing else is needed.

write      a benchmark or a recording as a bundle; episodes of a storage as one file
read       a bundle into a storage, and what that would bring
carried    the benchmark, artifacts and signature that a file carries, checked
"""

from tupli_mcap.storage.bundles.carried import carried_artifacts, carried_benchmark, checked_signature
from tupli_mcap.storage.bundles.read import ImportPreview, preview_import, read_bundle
from tupli_mcap.storage.bundles.write import bundle_recording, export_episodes, write_bundle

__all__ = [
    "ImportPreview",
    "bundle_recording",
    "carried_artifacts",
    "carried_benchmark",
    "checked_signature",
    "export_episodes",
    "preview_import",
    "read_bundle",
    "write_bundle",
]
