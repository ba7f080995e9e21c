"""One recording, one `.mcap` file: written, appended to, read, recovered, rewritten."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tupli_mcap.journal.file import journal_path
from tupli_mcap.recording.columns.read import Columns
from tupli_mcap.recording.episode import Episode, Episodes, Step
from tupli_mcap.recording.recording import RecordedBenchmark, Recording

if TYPE_CHECKING:
    from tupli_mcap.recording.check.verify import Problem, VerifyReport, verify_recording
    from tupli_mcap.recording.edit.merge import MergeReport, Part, merge_recordings, split_recording
    from tupli_mcap.recording.edit.repair import RecoveryReport, recover_recording
    from tupli_mcap.recording.edit.rewrite import rewrite_recording
    from tupli_mcap.recording.write.from_values import EpisodeData, write_recording

# Imported on first use: who records or reads needs none of them.
_HOMES = {
    "EpisodeData": "handmade",
    "MergeReport": "merge",
    "Part": "merge",
    "Problem": "verify",
    "RecoveryReport": "repair",
    "VerifyReport": "verify",
    "merge_recordings": "merge",
    "recover_recording": "repair",
    "rewrite_recording": "rewrite",
    "split_recording": "merge",
    "verify_recording": "verify",
    "write_recording": "handmade",
}

__all__ = [
    "Columns",
    "Episode",
    "EpisodeData",
    "Episodes",
    "MergeReport",
    "Part",
    "Problem",
    "RecordedBenchmark",
    "Recording",
    "RecoveryReport",
    "Step",
    "VerifyReport",
    "journal_path",
    "merge_recordings",
    "recover_recording",
    "rewrite_recording",
    "split_recording",
    "verify_recording",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
