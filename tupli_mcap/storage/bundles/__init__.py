"""Bundles: a recording that carries its benchmark and all artifacts, so that nothing else is needed.

write      writes a benchmark or a recording as a bundle; episodes of a storage as one file
read       imports a bundle into a storage
carried    checks the benchmark, artifacts and signature that a file carries
"""

from tupli_mcap.storage.bundles.carried import carried_artifacts, carried_benchmark, checked_signature
from tupli_mcap.storage.bundles.read import Imported, read_bundle
from tupli_mcap.storage.bundles.write import bundle_recording, export_episodes, write_bundle

__all__ = [
    "Imported",
    "bundle_recording",
    "carried_artifacts",
    "carried_benchmark",
    "checked_signature",
    "export_episodes",
    "read_bundle",
    "write_bundle",
]
