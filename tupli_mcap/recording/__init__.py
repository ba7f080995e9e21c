"""One recording, one `.mcap` file: written, appended to, read, recovered."""

from tupli_mcap.recording.episode import Episode, Episodes, Step
from tupli_mcap.recording.journal import journal_path
from tupli_mcap.recording.reader import RecordedBenchmark, Recording

__all__ = ["Episode", "Episodes", "RecordedBenchmark", "Recording", "Step", "journal_path"]
