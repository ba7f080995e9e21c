"""What records: Gymnasium wrappers, `RecordEpisodes` for one environment and its vector twin for many, and
`EpisodeWriter` and `write_rollout`, for episodes that come from no environment."""

from tupli_mcap.wrappers.episode_writer import EpisodeWriter
from tupli_mcap.wrappers.from_arrays import write_rollout
from tupli_mcap.wrappers.single import RecordEpisodes

__all__ = ["EpisodeWriter", "RecordEpisodes", "write_rollout"]
