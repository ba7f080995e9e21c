"""One recording, one `.mcap` file: written, appended to, read, recovered, rewritten.

recording, episode, frames    `Recording`, and what it gives; `verbs` are those that it has in common with a dataset
opened                        what `Recording` is built on: an open file whose structure is checked
open, contents                opening a file: everything that is known of it then
index, limits                 the episode index, and whether it can be true
channels                      the channels that a layout needs
description, series           what `info` shows
blocks                        whole episodes in bounded memory
signature_file                the attachment that a signature is
about/                        what is said of the run, and of episodes afterwards
columns/, recover/            from rows to columns; from what a killed process left to episodes
write/, edit/, check/, sign/  new recordings; out of others; whether they are right; who vouches for them
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tupli_mcap.journal.file import journal_path
from tupli_mcap.recording.about.run import Run
from tupli_mcap.recording.columns.read import Columns
from tupli_mcap.recording.episode import Episode, Episodes, Step
from tupli_mcap.recording.opened import RecordedBenchmark
from tupli_mcap.recording.recording import Recording

if TYPE_CHECKING:
    from tupli_mcap.recording.check.verify import Problem, VerifyReport, verify_recording
    from tupli_mcap.recording.edit.annotate import annotate_episodes, edit_run, undo_annotation, undo_edit
    from tupli_mcap.recording.edit.made_of import made_of, say_made_of
    from tupli_mcap.recording.edit.merge import MergeReport, merge_recordings
    from tupli_mcap.recording.edit.relabel import relabel_recording
    from tupli_mcap.recording.edit.repair.recover import RecoveryReport, finish_recording, recover_recording
    from tupli_mcap.recording.edit.rewrite import rewrite_recording
    from tupli_mcap.recording.edit.split import Part, split_recording
    from tupli_mcap.recording.edit.trim import trim_recording
    from tupli_mcap.recording.write.from_values import EpisodeData, write_recording

# Imported on first use: who records or reads needs none of them.
_HOMES = {
    "EpisodeData": "write.from_values",
    "MergeReport": "edit.merge",
    "Part": "edit.split",
    "Problem": "check.verify",
    "RecoveryReport": "edit.repair.recover",
    "VerifyReport": "check.verify",
    "annotate_episodes": "edit.annotate",
    "edit_run": "edit.annotate",
    "finish_recording": "edit.repair.recover",
    "made_of": "edit.made_of",
    "merge_recordings": "edit.merge",
    "recover_recording": "edit.repair.recover",
    "relabel_recording": "edit.relabel",
    "rewrite_recording": "edit.rewrite",
    "say_made_of": "edit.made_of",
    "split_recording": "edit.split",
    "trim_recording": "edit.trim",
    "undo_annotation": "edit.annotate",
    "undo_edit": "edit.annotate",
    "verify_recording": "check.verify",
    "write_recording": "write.from_values",
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
    "Run",
    "Step",
    "VerifyReport",
    "annotate_episodes",
    "edit_run",
    "finish_recording",
    "journal_path",
    "made_of",
    "merge_recordings",
    "recover_recording",
    "relabel_recording",
    "rewrite_recording",
    "say_made_of",
    "split_recording",
    "trim_recording",
    "undo_annotation",
    "undo_edit",
    "verify_recording",
    "write_recording",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value
