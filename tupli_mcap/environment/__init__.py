"""An environment as data: captured from a live one, rebuilt from a record, executed only where trusted."""

from tupli_mcap.environment._build import build, reasons_for_distrust
from tupli_mcap.environment._capture import Snapshot, capture, record_environment
from tupli_mcap.environment._docs import documented_labels
from tupli_mcap.environment._pickling import rebuild_ezpickled
from tupli_mcap.environment._record import EnvironmentRecord, canonical_json, sha256
from tupli_mcap.environment._scan import PickleImport, PickleScan, scan_pickle

__all__ = [
    "EnvironmentRecord",
    "PickleImport",
    "PickleScan",
    "Snapshot",
    "build",
    "canonical_json",
    "capture",
    "documented_labels",
    "reasons_for_distrust",
    "rebuild_ezpickled",
    "record_environment",
    "scan_pickle",
    "sha256",
]
