"""An environment as data: captured from a live one, rebuilt from a record, executed only where trusted.

_capture, _build             from an environment to an `EnvironmentRecord` (`_record`), and back
_changes, _local_code        whether an environment is as its constructors left it; which code is the user's own
_pickling                    pickles of environments
_docs                        names of dimensions and actions"""

from tupli_mcap.environment._build import (
    build,
    entry_point_name,
    more_than_data,
    packages_named_by,
    reasons_for_distrust,
)
from tupli_mcap.environment._capture import (
    Snapshot,
    autoresets_of,
    capture,
    fingerprint,
    first_of,
    name_of,
    note,
    versions_of,
)
from tupli_mcap.environment._docs import documented_labels
from tupli_mcap.environment._pickling import rebuild_ezpickled
from tupli_mcap.environment._record import (
    DOCUMENT_NAME,
    MAX_PICKLE,
    PICKLE_NAME,
    EnvironmentRecord,
    canonical_json,
    sha256,
)

__all__ = [
    "DOCUMENT_NAME",
    "MAX_PICKLE",
    "PICKLE_NAME",
    "EnvironmentRecord",
    "Snapshot",
    "autoresets_of",
    "build",
    "canonical_json",
    "capture",
    "documented_labels",
    "entry_point_name",
    "fingerprint",
    "first_of",
    "more_than_data",
    "name_of",
    "note",
    "packages_named_by",
    "reasons_for_distrust",
    "rebuild_ezpickled",
    "sha256",
    "versions_of",
]
