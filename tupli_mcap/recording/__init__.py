"""One recording, one `.mcap` file: written, appended to, read, recovered, rewritten."""

from tupli_mcap.recording.columns import Columns
from tupli_mcap.recording.episode import Episode, Episodes, Step
from tupli_mcap.recording.handmade import EpisodeData, write_recording
from tupli_mcap.recording.journal import journal_path
from tupli_mcap.recording.reader import RecordedBenchmark, Recording
from tupli_mcap.recording.repair import RecoveryReport, recover_recording
from tupli_mcap.recording.rewrite import rewrite_recording
from tupli_mcap.recording.verify import Problem, VerifyReport, verify_recording

__all__ = [
    "Columns",
    "Episode",
    "EpisodeData",
    "Episodes",
    "Problem",
    "RecordedBenchmark",
    "Recording",
    "RecoveryReport",
    "Step",
    "VerifyReport",
    "journal_path",
    "recover_recording",
    "rewrite_recording",
    "verify_recording",
    "write_recording",
]
