"""One recording, one `.mcap` file: written, appended to, read, recovered, rewritten.

recording, episode, frames    `Recording`, and what it gives; `verbs` are those it shares with a dataset
opened, contents              what `Recording` is built on: an open file, and everything that is known of it then
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
    from tupli_mcap.recording.check.report import Problem, VerifyReport
    from tupli_mcap.recording.check.verify import verify_recording
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
    "check.report": "Problem VerifyReport",
    "check.verify": "verify_recording",
    "edit.annotate": "annotate_episodes edit_run undo_annotation undo_edit",
    "edit.made_of": "made_of say_made_of",
    "edit.merge": "MergeReport merge_recordings",
    "edit.relabel": "relabel_recording",
    "edit.repair.recover": "RecoveryReport finish_recording recover_recording",
    "edit.rewrite": "rewrite_recording",
    "edit.split": "Part split_recording",
    "edit.trim": "trim_recording",
    "write.from_values": "EpisodeData write_recording",
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names.split()}

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
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value
