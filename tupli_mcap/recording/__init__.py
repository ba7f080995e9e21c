"""One recording, one `.mcap` file: written, appended to, read, recovered, rewritten.

recording, episode, frames    `Recording`, its episodes and frames; `verbs` are the methods it shares with a dataset
opened, contents              an open file, and its contents from the summary or from recovery
index                         the episode index, and its checks against the file
channels                      the channels that a layout needs
blocks                        whole episodes in bounded memory
signature_file                the attachment with a signature
about/                        runs, annotations, success of episodes
columns/, recover/            turns rows into columns; turns what a killed process left into episodes
write/, edit/, check/, sign/  makes recordings; makes them of others; verifies them; signs them
describe/                     the facts that `info` shows
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tupli_mcap.journal.file import journal_path
from tupli_mcap.lazy import imported_on_use
from tupli_mcap.recording.about.run import Run
from tupli_mcap.recording.columns.read import Columns
from tupli_mcap.recording.episode import Episode, Episodes, Step
from tupli_mcap.recording.opened import RecordedBenchmark
from tupli_mcap.recording.recording import Recording

if TYPE_CHECKING:
    from tupli_mcap.recording.check.report import Problem, VerifyReport
    from tupli_mcap.recording.check.verify import verify_recording
    from tupli_mcap.recording.edit.annotate import annotate_episodes, edit_runs, undo_annotation, undo_edit
    from tupli_mcap.recording.edit.merge import MergeReport, merge_recordings
    from tupli_mcap.recording.edit.repair.recover import RecoveryReport, finish_recording, recover_recording
    from tupli_mcap.recording.edit.rewrite import rewrite_recording, say_made_of
    from tupli_mcap.recording.edit.split import Part, split_recording
    from tupli_mcap.recording.write.from_values import EpisodeData, write_recording

# Imported on first use: recording and reading need none of them.
__getattr__ = imported_on_use(
    globals(),
    {
        "check.report": "Problem VerifyReport",
        "check.verify": "verify_recording",
        "edit.annotate": "annotate_episodes edit_runs undo_annotation undo_edit",
        "edit.merge": "MergeReport merge_recordings",
        "edit.repair.recover": "RecoveryReport finish_recording recover_recording",
        "edit.rewrite": "rewrite_recording say_made_of",
        "edit.split": "Part split_recording",
        "write.from_values": "EpisodeData write_recording",
    },
)

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
    "edit_runs",
    "finish_recording",
    "journal_path",
    "merge_recordings",
    "recover_recording",
    "rewrite_recording",
    "say_made_of",
    "split_recording",
    "undo_annotation",
    "undo_edit",
    "verify_recording",
    "write_recording",
]
