"""What records: Gymnasium wrappers, `RecordEpisodes` for one environment and its vector twin for many, and
`EpisodeWriter`, for episodes that come from no environment."""

from tupli_mcap.wrappers.episode_writer import EpisodeWriter
from tupli_mcap.wrappers.single import RecordEpisodes

__all__ = ["EpisodeWriter", "RecordEpisodes"]
